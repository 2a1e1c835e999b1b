"""What touches: one linear-Gaussian model of a skin's scans, and hypotheses about each scan over it.

    log |Z| = log |Z0| + drift + contact impedances + memory of the foam + touches + faults + noise

Pure numerics: arrays in, arrays out; no configuration, no files, no sockets. estimator.py is the way of one scan; what
touches do to the measurements is in models/measurement. Every number that decides stands in values/numbers.py, with its
unit and origin.
"""
