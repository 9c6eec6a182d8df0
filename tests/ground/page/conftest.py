"""One browser and one page for all tests that can share them, because starting one takes seconds of CPU time.

These tests run in one worker, with no other test between them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.ground.monitor_stub import BROKER, MonitorStub, hello, retained
from tests.ground.page_browser import Page, chromium, watching


@pytest.fixture(scope="package")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="package")
def opened(browser: Any) -> Iterator[tuple[Page, MonitorStub]]:
    """The shared page and its stub."""
    with MonitorStub(retained()) as stub, watching(browser, stub) as page:
        yield page, stub


@pytest.fixture
def stub(opened: tuple[Page, MonitorStub]) -> MonitorStub:
    """The stub of `page`, with its usual greeting."""
    stub = opened[1]
    stub.greeting = [hello(), BROKER, *retained()]
    return stub


@pytest.fixture
def shared(opened: tuple[Page, MonitorStub]) -> Iterator[Page]:
    """The page for a test that loads it itself with `Page.open_anew`."""
    yield opened[0]
    opened[0].check_complaints()


@pytest.fixture
def page(shared: Page, stub: MonitorStub) -> Page:
    """The page, loaded anew for this test."""
    shared.open_anew(stub)
    return shared
