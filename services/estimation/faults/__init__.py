"""What can be wrong with a board, in the one model: maps of the values, values left out, columns with a prior."""
