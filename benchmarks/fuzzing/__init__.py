"""What `benchmarks/fuzz.py` and `tests/fuzz` throw at the edges: how bytes are damaged, and one module per wire."""
