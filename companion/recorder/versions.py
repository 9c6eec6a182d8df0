"""Versions of the software that determines a flight."""

from __future__ import annotations

import contextlib
import importlib.metadata
import platform
import subprocess
from pathlib import Path

from companion import __version__
from companion.runtime.subprocesses import captured

_PACKAGES = (
    "mavsdk",
    "pymavlink",
    "dynamixel-sdk",
    "pyserial",
    "numpy",
    "pydantic",
    "msgspec",
    "foxglove-sdk",
    "mcap",
    "mujoco",
)
REVISION_FILE = "revision"
"""File in the package of a compiled build that names the commit from which it was built."""


def versions() -> dict[str, str]:
    """Return the version of the companion, Python, the platform, and each package that a flight depends on."""
    found = {"companion": __version__, "python": platform.python_version(), "platform": platform.platform()}
    for package in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    revision = _git_revision()
    return found if revision is None else {**found, "git": revision}


def _git_revision() -> str | None:
    """Return this working copy's commit (`-dirty` if changed) or the one of the compiled build; None if neither is known."""
    package = Path(__file__).resolve().parents[1]
    root = package.parent
    if (package / REVISION_FILE).exists():
        return (package / REVISION_FILE).read_text(encoding="utf-8") or None
    if not (root / ".git").exists():
        return None
    try:
        command = ("git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
        done = captured(command, timeout_s=5.0)
    except (OSError, subprocess.SubprocessError):
        return None
    return (done.returncode == 0 and done.stdout.strip()) or None
