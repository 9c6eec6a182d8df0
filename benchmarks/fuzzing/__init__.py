"""Damaged input for `benchmarks.fuzz` and `tests/fuzz`: how bytes are damaged, and one module per wire."""
