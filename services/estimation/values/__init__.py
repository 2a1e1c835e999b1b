"""What passes between the estimator's parts: scans, judgements, estimates. Frozen; nothing here decides."""
