"""Simulated minutes, judged against the truth: `skin bench trust`."""
