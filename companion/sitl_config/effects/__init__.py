"""Sections of the simulated world: one effect of a laboratory each, with its switch and its parameters."""
