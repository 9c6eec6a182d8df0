"""Simulated time as the launcher sets it up."""

from __future__ import annotations

import errno
import os

import pytest

from companion.launcher.shared_time import SharedTime
from companion.runtime.subprocesses import LaunchError


def test_memory_that_cannot_be_shared_is_one_line_with_a_way_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> int:
        raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))

    monkeypatch.setattr(os, "memfd_create", refused)
    with pytest.raises(LaunchError, match=r"^simulated time: no memory or sockets to share: .*; fly with --real-time$"):
        SharedTime(1.0)
