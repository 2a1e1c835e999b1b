"""What a frame can be: one linear-Gaussian error model of a skin's frames, and hypotheses about each frame over it.

    d = B x + touch + fault + v      B x: drift of the sheet and of the contacts (drift.py), v: noise (physics.py)

Pure numerics: arrays in, arrays out; no configuration, no files, no sockets. The numbers of drift, touches, start and
evidence for faults are in tuning.py; what one check alone uses stands at the top of its file.

An estimator that is to take over stands beside it: estimator.py (the way of one scan), filter.py, touches.py,
hypotheses.py, learning.py, quick_look.py, values/, first/, faults/, and models/measurement. No stage calls it;
`skin bench shadow --candidate bench.trust.anew:Anew` holds it against this one (docs/reliability.md).
"""
