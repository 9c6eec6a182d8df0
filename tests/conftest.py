"""Property tests draw anew wherever people work, and draw the same on CI: there the change is judged, not the draw."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator

import pytest
from hypothesis import settings

settings.register_profile("ci", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("ci")


@pytest.fixture(scope="module", autouse=True)
def _nothing_is_hoarded(request: pytest.FixtureRequest) -> Iterator[None]:
    """What a file's tests share by `@cache`, whole flights mostly, goes with its last test: it would weigh on every test after them."""
    yield
    for shared in vars(request.module).values():
        if isinstance(shared, functools._lru_cache_wrapper) and shared.__module__ == request.module.__name__:
            shared.cache_clear()
