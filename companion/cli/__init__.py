"""The command `companion`, with a module for each of its commands."""

import gc

# The imports create little garbage: the usual threshold of 700 objects makes them a fifth slower.
gc.set_threshold(100_000, 20, 20)
