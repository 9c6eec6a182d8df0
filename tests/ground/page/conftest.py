"""One browser for all tests of the page: it takes seconds to start. They run in one worker, where no other test runs between them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.ground.page_browser import chromium


@pytest.fixture(scope="package")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser
