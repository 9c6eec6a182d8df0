"""Property tests draw anew wherever people work, and draw the same on CI: there the change is judged, not the draw."""

from __future__ import annotations

import os

from hypothesis import settings

settings.register_profile("ci", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("ci")
