"""What a laboratory does to a flight and the plain simulation leaves out: one effect each."""
