"""Noise of a scan: what is known of it, what it disturbs, and the factor that whitens a frame."""
