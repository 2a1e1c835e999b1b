"""What an image is made of: which scans, the mean of how many, by which operator, and whether it explains them."""
