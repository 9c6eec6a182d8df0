"""Pinocchio, of which there are wheels for x86-64 alone: there its tests must run, elsewhere they are skipped without it."""

from __future__ import annotations

import platform

import pytest

if platform.machine() != "x86_64":
    pytest.importorskip("pinocchio", reason="Pinocchio is not installed: PyPI has it for x86-64 alone")

import pinocchio as pin

__all__ = ["pin"]
