"""What real skins do, as named worlds: foam, warmth, contact impedances, interference. No estimator is known here."""
