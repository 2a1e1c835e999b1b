"""What a frame can be: one linear-Gaussian error model of a skin's frames, and hypotheses about each frame over it.

    d = B x + touch + fault + v      B x: drift of the sheet and of the contacts (drift.py), v: noise (physics.py)

Pure numerics: arrays in, arrays out; no configuration, no files, no sockets. The numbers of drift, touches, start and
evidence for faults are in tuning.py; what one check alone uses stands at the top of its file.
"""
