"""One browser and one opened page for all tests that can share them: to start one takes seconds of computing time.

They run in one worker, where no other test runs between them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.ground.monitor_stub import BROKER, Stand, hello, retained
from tests.ground.page_browser import Page, chromium, watching


@pytest.fixture(scope="package")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="package")
def opened(browser: Any) -> Iterator[tuple[Page, Stand]]:
    """The page, with the stand that it is loaded from."""
    with Stand(retained()) as stand, watching(browser, stand) as page:
        yield page, stand


@pytest.fixture
def stand(opened: tuple[Page, Stand]) -> Stand:
    """The stand of `page`; it greets as usual."""
    stand = opened[1]
    stand.greeting = [hello(), BROKER, *retained()]
    return stand


@pytest.fixture
def shared(opened: tuple[Page, Stand]) -> Iterator[Page]:
    """The page for a test that loads it itself, by `Page.open_anew`."""
    yield opened[0]
    opened[0].check_complaints()


@pytest.fixture
def page(shared: Page, stand: Stand) -> Page:
    """The page, loaded anew for this test."""
    shared.open_anew(stand)
    return shared
