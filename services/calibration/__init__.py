"""A skin's own force law and frame, from presses of known force or place."""
