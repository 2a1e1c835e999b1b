"""What the untouched skin measures, and how that is followed while it drifts."""
