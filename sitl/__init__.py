"""The simulated world: MuJoCo physics, an autopilot, a servo bus, motion capture and a force sensor behind their real protocols."""

import os

# The world has no display; without GLFW it starts a twelfth faster.
os.environ.setdefault("MUJOCO_GL", "disable")
