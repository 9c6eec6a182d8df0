"""The flight process: opens the devices and runs the control loop."""

import gc

# The imports create little garbage: the usual threshold of 700 objects makes them a twentieth slower.
gc.set_threshold(100_000, 20, 20)
