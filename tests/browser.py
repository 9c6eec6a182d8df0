"""A real browser for tests of pages: Debian's chromium, driven by Playwright."""

from __future__ import annotations

import shutil

import pytest

ARGUMENTS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
"""It starts as root and speaks to nobody but the page's own server."""


def missing(what: str, package: str) -> None:
    """Skip the test; the summary of `make test` shows the reason.

    Raises:
        pytest.skip.Exception: always.
    """
    pytest.skip(f"{what} is not installed: apt install {package}")


def chromium() -> str:
    """Path of the browser."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        found = shutil.which(name)
        if found is not None:
            return found
    missing("a browser", "chromium")
    raise AssertionError
