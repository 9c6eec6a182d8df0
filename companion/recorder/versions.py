"""Versions of everything that has a say in what a flight does."""

from __future__ import annotations

import contextlib
import importlib.metadata
import platform
import subprocess
from pathlib import Path

from companion import __version__

_PACKAGES = ("mavsdk", "pymavlink", "dynamixel-sdk", "pyserial", "numpy", "pydantic", "foxglove-sdk", "mcap", "mujoco")


def versions() -> dict[str, str]:
    """Versions of everything that has a say in what the flight does."""
    found = {"companion": __version__, "python": platform.python_version(), "platform": platform.platform()}
    for package in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    revision = _git_revision()
    return found if revision is None else {**found, "git": revision}


def _git_revision() -> str | None:
    """Commit of the working copy that this module is in, with `-dirty`; None outside of one."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    try:
        done = subprocess.run(
            ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=5.0,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None
