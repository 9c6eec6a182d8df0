"""The simulated world: MuJoCo physics, an autopilot, a servo bus, motion capture and a force sensor behind their real protocols."""

import gc
import os

# The world has no display; without GLFW it starts a twelfth faster.
os.environ.setdefault("MUJOCO_GL", "disable")

# The imports create little garbage: the usual threshold of 700 objects makes them a tenth slower.
gc.set_threshold(100_000, 20, 20)
