"""What real skins do, as named worlds: foam, warmth, contact impedances and interference. No estimator is known here."""
