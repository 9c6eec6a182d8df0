"""Parts of `benchmarks.broker`."""
