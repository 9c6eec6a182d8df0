"""companion: flies an aerial manipulator on PX4 with adaptive impedance control."""

__version__ = "0.2.0"

DISTRIBUTION = "companion-aerial-manipulation"
"""Name of the distribution for pip; on the package index, `companion` is a different project."""
