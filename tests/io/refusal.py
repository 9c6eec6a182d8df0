"""The text with which a driver refuses its device."""

from __future__ import annotations

from contextlib import AbstractAsyncContextManager
from typing import Any

import pytest

from companion.io.protocols import DeviceError


async def refusal(driver: AbstractAsyncContextManager[Any]) -> str:
    """Open a driver that must not open; return its one line."""
    with pytest.raises(DeviceError) as caught:
        await driver.__aenter__()
    text = str(caught.value)
    assert "\n" not in text
    return text
