"""Foxglove: what it draws and plots, live or in a file."""
