"""Which files hold tests of a mark: a stage collects these alone, instead of every file in every worker."""

from __future__ import annotations

import functools
from pathlib import Path

MARKS = ("waits", "flight", "alone")
TESTS = Path(__file__).parent


@functools.cache
def files_of(mark: str) -> tuple[Path, ...]:
    """Return the test files whose text contains the mark. `conftest.py` refuses a mark that comes from elsewhere."""
    name = f"mark.{mark}"
    return tuple(path for path in sorted(TESTS.rglob("test_*.py")) if name in path.read_text(encoding="utf-8"))
