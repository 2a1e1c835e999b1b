"""The first baseline of a skin: whether its scans agree, and whether nothing touches while they do.

Not named `baseline`: a folder of that name would hide the file of the estimator that this one succeeds.
"""
