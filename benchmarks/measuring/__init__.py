"""Parts of `python -m benchmarks` and of `benchmarks/wire_latency.py`."""
