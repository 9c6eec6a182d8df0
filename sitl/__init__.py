"""The simulated world and its devices."""

import os

# Nothing is drawn: MuJoCo need not load GLFW, which takes a twelfth of a world's start.
os.environ.setdefault("MUJOCO_GL", "disable")
