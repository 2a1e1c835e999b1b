"""The board's end: ports, the link, its clock, what is scanned, and the files that stand in for a board."""
