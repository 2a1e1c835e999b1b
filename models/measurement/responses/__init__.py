"""What touches and the untouched skin do to each measurement: predicted from a bundle, or measured."""
