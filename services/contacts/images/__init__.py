"""Touches in an image of the conductivity drop: which there are, and what each looks like."""
