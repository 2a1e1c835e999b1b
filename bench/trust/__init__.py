"""Simulated minutes of every world, judged against the truth: `skin bench trust`, and two estimators beside each other:
`skin bench shadow`.
"""
