"""Processes that show or translate: ordinary clients, which use protocol/ alone."""
