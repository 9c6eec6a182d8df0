"""Planning that takes long shows how far it is, in a terminal; nowhere else does it show anything."""

from __future__ import annotations

import contextlib
import io
import sys
from collections.abc import Iterator

import pytest
from rich.console import Console

from companion.cli import main as cli
from companion.cli import planning_progress
from companion.cli.planning_progress import SHOW_AFTER_S, PlanningProgress
from tests.sitl.test_campaign import terminal
from tests.support import ROOT

CIRCUIT = ROOT / "configs/missions/circuit.yaml"
"""It has a path, which takes planning."""


class SetClock:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.t_s = 0.0

    def __call__(self) -> float:
        return self.t_s


def shown(*, terminal: bool, until_s: float) -> str:
    """What planning shows that is half done at `until_s`."""
    file, clock = io.StringIO(), SetClock()
    console = Console(file=file, force_terminal=terminal, width=80, _environ={"TERM": "xterm"})
    with PlanningProgress(console, clock) as progress:
        progress(0.1)
        clock.t_s = until_s
        progress(0.5)
    return file.getvalue()


def test_what_takes_long_shows_how_far_it_is() -> None:
    text = shown(terminal=True, until_s=SHOW_AFTER_S + 0.1)
    assert "planning" in text
    assert " 50 %" in text


def test_what_is_quick_shows_nothing() -> None:
    assert shown(terminal=True, until_s=SHOW_AFTER_S - 0.1) == ""


def test_without_a_terminal_nothing_is_shown() -> None:
    assert shown(terminal=False, until_s=SHOW_AFTER_S + 9.0) == ""


@contextlib.contextmanager
def terminal_as_standard_error(monkeypatch: pytest.MonkeyPatch) -> Iterator[bytearray]:
    """What is written to a real terminal meanwhile; complete afterwards."""
    with terminal() as (end, seen), open(end, "w", encoding="utf-8") as stream, monkeypatch.context() as patched:
        patched.setattr(sys, "stderr", stream)
        yield seen


def test_the_commands_show_it_in_a_terminal_and_not_in_a_pipe(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(planning_progress, "SHOW_AFTER_S", 0.0)
    monkeypatch.setenv("TERM", "xterm")
    with terminal_as_standard_error(monkeypatch) as seen:
        assert cli.main(["check", str(CIRCUIT), "--plan-only"]) == 0
    assert b"planning" in seen
    assert "planning" not in capsys.readouterr().out
    assert cli.main(["check", str(CIRCUIT), "--plan-only"]) == 0
    assert capsys.readouterr().err == ""


def test_fly_shows_it_as_check_does(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A mission that is planned, and then refused: nothing is started."""
    monkeypatch.setattr(planning_progress, "SHOW_AFTER_S", 0.0)
    monkeypatch.setenv("TERM", "xterm")
    with terminal_as_standard_error(monkeypatch) as seen:
        assert cli.main(["fly", str(CIRCUIT), "--sitl", "--set", "mission.phases[0].height_m=9"]) == 2
    assert b"planning" in seen
    assert capsys.readouterr().out == ""
