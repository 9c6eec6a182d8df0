"""Sections of the simulated world: one module per effect of a laboratory, with its switch and its parameters."""
