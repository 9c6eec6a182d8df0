"""What tests of campaigns share."""

from __future__ import annotations

import pytest

from companion.analysis import plot_style


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures without a stroke: for tests that are about files and figures."""
    monkeypatch.setattr(plot_style, "write_png", lambda figure, path: path.write_bytes(b"drawn"))
