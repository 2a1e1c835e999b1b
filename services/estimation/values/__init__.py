"""What passes between the estimator's rooms: scans, judgements, estimates. Frozen; nothing here decides."""
