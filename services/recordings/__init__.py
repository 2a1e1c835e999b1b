"""Frames kept, played again, and files of measurements."""
