"""`companion identify`: finds the parameters of a machine and of its world in the log of one flight."""
