"""Tells which build of the computing modules this process runs: plain Python, or compiled by `make compile`. Both give
bit-identical results.
"""

from __future__ import annotations

from companion.model import frames

COMPILED = not frames.__file__.endswith(".py")
