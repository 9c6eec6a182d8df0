"""The outcome of a flight from what its processes said, and from how they ended."""

from __future__ import annotations

import signal
import socket
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from companion.launcher.launcher import Launcher
from companion.launcher.reports import FlightReports
from companion.model.exit_codes import EXIT_CODES
from companion.model.launcher_messages import (
    AnyMessage,
    FlightEnded,
    HandedOver,
    Message,
    Recorded,
    Started,
    Status,
    TookOver,
)
from companion.model.types import Outcome, PhaseKind, SafetyAction
from companion.runtime import ipc
from companion.sitl_config.loader import load_sitl
from tests.support import HOVER

STARTED = Started(recorder_pid=1, realtime="", simulated=True)
WHOLE = Recorded(samples=9, dropped=0, error=None)


def status(kind: PhaseKind) -> Status:
    return Status(
        mission_t_s=0.0, phase="", kind=kind, progress=0.0, action=SafetyAction.NOMINAL, error_m=None, position_world_m=None,
        lateness_s=0.0,
    )  # fmt: skip


def guardian(**known: Any) -> Any:
    usual = {"outcome": None, "took_over": False, "takeover": None, "failure": lambda: None, "open": False}
    return SimpleNamespace(**usual | {"channel": None, "receive": tuple, "hangs": bool} | known)


def landed(outcome: Outcome) -> Any:
    return guardian(outcome=outcome, took_over=True, takeover=TookOver(hangs=False))


@pytest.mark.parametrize(
    ("messages", "code", "lands", "outcome"),
    [
        ([STARTED, FlightEnded(Outcome.COMPLETED, WHOLE)], 0, guardian(), Outcome.COMPLETED),
        ([STARTED], EXIT_CODES[Outcome.COMPLETED], guardian(), Outcome.COMPLETED),
        ([STARTED], EXIT_CODES[Outcome.ABORTED], guardian(), Outcome.ABORTED),
        ([STARTED], EXIT_CODES[Outcome.LOST], guardian(), Outcome.LOST),
        ([STARTED], -signal.SIGKILL, guardian(), Outcome.LOST),
        ([STARTED, FlightEnded(Outcome.COMPLETED, WHOLE)], -signal.SIGSEGV, guardian(), Outcome.COMPLETED),
        ([STARTED, FlightEnded(Outcome.ABORTED)], -signal.SIGKILL, guardian(), Outcome.ABORTED),
        ([STARTED, FlightEnded(Outcome.CRASHED)], -signal.SIGKILL, landed(Outcome.ABORTED), Outcome.CRASHED),
        ([STARTED, FlightEnded(Outcome.ABORTED)], -signal.SIGKILL, landed(Outcome.LOST), Outcome.LOST),
        ([STARTED], -signal.SIGKILL, landed(Outcome.ABORTED), Outcome.ABORTED),
        ([], 1, guardian(), Outcome.REFUSED),
        ([HandedOver()], -signal.SIGKILL, guardian(), Outcome.LOST),
    ],
    ids=[
        "completed", "channel-full", "channel-full-aborted", "nothing-said", "killed", "dies-after-the-end", "killed-after-the-end",
        "crashed-and-at-rest", "left-armed-and-lost", "landed-by-the-guardian", "never-started", "killed-while-px4-lands",
    ],
)  # fmt: skip
def test_the_outcome_is_what_is_known_of_the_vehicle(
    messages: Sequence[Message], code: int, lands: Any, outcome: Outcome, tmp_path: Path
) -> None:
    reports, log = FlightReports(), tmp_path / "flight.log"
    log.touch()
    for message in messages:
        reports.take(message)
    assert reports.outcome(code, log, lands, None, stop_requested=False) is outcome
    unexplained = code < 0 or outcome in (Outcome.LOST, Outcome.REFUSED)
    assert bool(reports.failures) == unexplained, "a process that died is named"


@pytest.mark.parametrize(
    ("said", "killed"),
    [
        ([status(PhaseKind.FLIGHT)], "sent nothing for 5 s"),
        ([status(PhaseKind.DONE)], "sent nothing for 30 s"),
        ([status(PhaseKind.FLIGHT), FlightEnded(Outcome.ABORTED)], "sent nothing for 30 s"),
        ([], None),
    ],
    ids=["in-flight", "after-the-flight", "while-the-log-is-closed", "before-the-first-tick"],
)
def test_a_flight_process_that_falls_silent_is_killed_when_its_time_is_over(
    said: Sequence[Message], killed: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard: list[AnyMessage] = []
    watch = Launcher(load_sitl(HOVER), tmp_path, sitl=None, on_message=heard.append)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    now_s, alive, kills = [0.0], [True], list[float]()

    def later() -> list[Message]:
        now_s[0] += 1.0
        alive[0] = alive[0] and now_s[0] < 60.0
        return []

    def kill() -> None:
        kills.append(now_s[0])
        alive[0] = False

    ready = SimpleNamespace(select=lambda r, w, x, s: ([ours] if now_s[0] == 1.0 and said else [], [], []))
    monkeypatch.setattr("companion.launcher.launcher.time", SimpleNamespace(monotonic=lambda: now_s[0]))
    monkeypatch.setattr("companion.launcher.launcher.select", ready)
    process: Any = SimpleNamespace(poll=lambda: None if alive[0] else 0, kill=kill)
    with ours, theirs:
        for message in said:
            ipc.send(theirs, message)
        watch._watch(process, ours, guardian(receive=later), None)
    assert len(kills) == (killed is not None)
    assert [killed in text for text in watch._reports.failures if killed is not None] == [True] * len(kills)
