"""What a frame can be: one linear-Gaussian error model of a skin's frames, and hypotheses about each frame over it.

    d = B x + touch + fault + v      B x: drift of the sheet and of the contacts (drift.py), v: noise (errors.py)

Pure numerics: arrays in, arrays out; no configuration, no files, no sockets. All numbers are in tuning.py.
"""
