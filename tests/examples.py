"""How many examples a property test draws that has a great many: all of them on CI and where people ask for that, else some."""

from __future__ import annotations

import os

THOROUGH = bool(os.environ.get("CI")) or os.environ.get("TESTS") == "thorough"
"""`make test TESTS=thorough`."""
_SHARE = 5


def examples(all_of_them: int) -> int:
    """For `max_examples`."""
    return all_of_them if THOROUGH else all_of_them // _SHARE
