"""What touches, drift and noise do to a skin's impedances, linearised: one model for whole scans and parts of them.

No time and no state: a caller brings both. K measurements, E electrodes, F x F pixels of the square [-1, 1]^2. Lengths
are model units, conductivity drops S on a sheet of 1 S, values y = log(|Z| / Z0) unless a name says otherwise.
"""
