"""From what is known of a touch to newtons: the law, its curve, its file, and patches that act as a fitted disc."""
