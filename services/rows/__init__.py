"""Rows of measurements as people have them: files of any kind, columns in any order; what was understood is said."""
