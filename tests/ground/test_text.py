"""`companion monitor --text`: its display in a real terminal (a pty) and in a pipe."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import math
import os
import pty
import re
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from rich.console import Console

from companion.ground.protocol.access import broker_access
from companion.ground.protocol.keys import operators_text, write_private
from companion.ground.protocol.messages import Presence, TetherView
from companion.ground.protocol.proof import with_proofs
from companion.ground.station.station import Station
from companion.ground.station.text_monitor import APART_S, CONFIRM_S, KEYS, _Screen
from companion.ground.station.text_view import STALE_S, Notice, StationStatus, render, stale, status_line, status_word
from companion.ground.station.vehicles import Vehicle, VehicleTracker
from companion.model.codec import to_json
from companion.model.types import OperatorCommand
from tests.broker import Broker
from tests.ground.monitor_rig import ANNA, OPERATORS, SIGNER
from tests.ground.vehicle import flight, played_vehicle, state_of
from tests.support import DEADLINE_S, ROOT

AGAIN_S = 5.0
SCREEN_CHARACTERS = 30_000
"""The newest output, two or three screens, in which a text is searched: all output would take longer and longer."""
AROUND = StationStatus("connected to mqtt://127.0.0.1:1883", True, "anna", None)


def known(presence: Presence = Presence.FLYING, heard_s: float = 0.0, event: str = "caught", **values: Any) -> Vehicle:
    """Return the tracked vehicle after it has sent these messages."""
    watch = VehicleTracker()
    events = flight()[2]
    lines = (replace(events.lines[0], text=event),)
    state = state_of("rig", "s", presence=presence, outcome="completed" if presence is Presence.ENDED else None)
    for topic, record in (
        ("state", state),
        ("events", replace(events, session="s", lines=lines)),
        ("stream", replace(flight()[1][-1], session="s", **values)),
    ):
        assert watch.receive(f"companion/rig/{topic}", to_json(record), False, heard_s) is not None
    return watch.vehicles["rig"]


def drawn(vehicle: Vehicle | None, now_s: float = 0.0, around: StationStatus = AROUND) -> str:
    console = Console(width=140, record=True, file=open(os.devnull, "w"), color_system="standard", force_terminal=True)  # noqa: SIM115
    with contextlib.closing(console.file):
        console.print(render(vehicle, now_s, around))
        return console.export_text(styles=True)


def plain(text: str) -> str:
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text)


@pytest.mark.parametrize(
    ("vehicle", "now_s", "expected", "alarm"),
    [
        (known(), 0.0, "FLYING", False),
        (known(kind="ground"), 0.0, "ON THE GROUND", False),
        (known(waits_for_start=True), 0.0, "WAITING FOR START", False),
        (known(action="hold"), 0.0, "HOLD", False),
        (known(action="autopilot_land"), 0.0, "AUTOPILOT LAND", False),
        (known(), STALE_S + 0.1, "NO DATA FOR 0.4 s", True),
        (known(Presence.SILENT), 0.0, "SILENT", True),
        (known(Presence.LOST), 0.0, "LOST", True),
        (known(Presence.ENDED), 100.0, "ENDED: completed", False),
        (known(Presence.ENDED), 0.0, "FLYING", False),  # the stream arrives
    ],
)
def test_the_status_word(vehicle: Vehicle, now_s: float, expected: str, alarm: bool) -> None:
    text, style = status_word(vehicle, now_s)
    assert text == expected
    assert ("on red" in style) is alarm


def test_what_is_shown_of_a_flight() -> None:
    text = plain(drawn(known(progress=0.4321, mission_t_s=9.0)))
    for expected in ("rig", "SIMULATION", "adaptive", " 43 %", "t   9.0 s", "|e_p|", "battery 15.8 V", "motion capture", "caught",
                     "h HOLD", "l LAND", "a ABORT", "r resume   s start", "anna", "connected to"):  # fmt: skip
        assert expected in text, (expected, text)


def test_stale_figures_are_not_green() -> None:
    vehicle = known()
    assert not stale(vehicle, STALE_S - 0.01) and stale(vehicle, STALE_S + 0.01)
    fresh, old = drawn(vehicle, 0.0), drawn(vehicle, 5.0)
    assert "\x1b[32m● " in fresh
    assert "\x1b[32m" not in old.split("caught")[0], "something is still green"


def test_a_taut_tether_is_shown() -> None:
    tether = TetherView(slack_m=0.0, stop_slack_m=0.0, pull_n=3.0, turns=0.0, taut=True, snagged=False)
    assert "TETHER TAUT" in drawn(known(tether=tether))


def test_a_viewer_without_permission_gets_the_reason_and_no_keys() -> None:
    text = plain(
        drawn(
            known(),
            0.0,
            dataclasses.replace(AROUND, operator=None, view_only_reason="nobody shall", notices=(Notice("a note"),)),
        )
    )
    assert "view only: nobody shall" in text and "ABORT" not in text and "a note" in text


def test_text_from_the_network_does_not_steer_the_terminal() -> None:
    hostile = "\x1b[2J\x1b]0;title\x07[red]markup[/red]\r\n\x9b31m"
    vehicle = known(event=hostile, phase=hostile, action=hostile, mode=hostile)
    shown = drawn(vehicle) + status_line(vehicle, 0.0)
    assert "\x1b[2J" not in shown and "\x07" not in shown and "\x9b" not in shown and "\x1b]" not in shown
    assert "[red]markup[/red]" in plain(shown)


class Terminal:
    """`companion monitor --text` in a pty, as SSH gives one."""

    def __init__(self, broker: Broker, keys: Path) -> None:
        self.ours, theirs = pty.openpty()
        self._screen = ""
        termios.tcsetwinsize(theirs, (24, 80))  # as low as terminals are
        self.before = termios.tcgetattr(theirs)
        self._theirs = theirs
        command = [sys.executable, "-m", "companion", "monitor", "--text", "--broker", broker.url]
        self.process = subprocess.Popen(
            [*command, "--operators", str(keys)],
            cwd=ROOT,
            env={**os.environ, "TERM": "xterm-256color", "COLUMNS": "", "LINES": ""},
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
        )

    @property
    def settings(self) -> list[Any]:
        return termios.tcgetattr(self._theirs)

    def press(self, keys: str) -> None:
        os.write(self.ours, keys.encode())

    async def shows(self, text: str, *, on: str = "") -> None:
        """Wait until text is drawn; earlier output does not count. The keys `on` are pressed now, and again after `AGAIN_S`: a command
        that has waited for a core for too long is refused.
        """
        pressed_s, end_s = -math.inf, time.monotonic() + 0.5 * DEADLINE_S
        while text not in plain(self._screen):
            assert time.monotonic() < end_s, f"{text!r} is not drawn: {plain(self._screen)}"
            if on and time.monotonic() - pressed_s > AGAIN_S:
                for key in on:
                    self.press(key)
                    await asyncio.sleep(APART_S + 0.05)
                pressed_s = time.monotonic()
            if (await asyncio.to_thread(select.select, [self.ours], [], [], 1.0))[0]:
                drawn = os.read(self.ours, 65536).decode("utf-8", "replace")
                self._screen = (self._screen + drawn)[-SCREEN_CHARACTERS:]
        self._screen = ""

    async def ended(self) -> int:
        """Return the exit code, reading what is still drawn."""
        drain = asyncio.ensure_future(asyncio.to_thread(self._drain))
        code = await asyncio.to_thread(self.process.wait)
        os.write(self._theirs, b"\x04")
        await drain
        return code

    def _drain(self) -> None:
        while not os.read(self.ours, 65536).endswith(b"\x04"):
            pass

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        os.close(self.ours)
        os.close(self._theirs)


@contextlib.asynccontextmanager
async def terminal_at(broker: Broker, folder: Path) -> AsyncIterator[Terminal]:
    keys = folder / "operators.yaml"
    write_private(keys, operators_text([ANNA]).encode())
    terminal = Terminal(broker, keys)
    try:
        yield terminal
    finally:
        terminal.close()


@pytest.mark.parametrize("after", [{"session": "s2"}, {"hold": 2}, {"vehicle": "second"}], ids=str)
def test_a_confirmation_is_for_what_was_shown(after: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """If vehicle, flight or hold has changed at the second key, the command must be given again; so it must if both were pasted."""
    now_s = 50.0
    monkeypatch.setattr("companion.ground.station.text_monitor.time.monotonic", lambda: now_s)
    access = broker_access("mqtt://127.0.0.1", None, None)
    station = Station(access, SIGNER, None, lambda heard: None, lambda connected, text: None)
    screen = _Screen(Console())

    def shown(vehicle: str = "rig", session: str = "s1", hold: int = 1) -> None:
        stream = replace(
            flight()[1][-1], session=session, hold=hold, action="hold", wall_s=2e9 if session == "s2" else 1e9
        )
        payload = to_json(with_proofs(replace(stream, t_s=stream.t_s + hold), vehicle, [ANNA.key]))
        assert station.tracker.receive(f"companion/{vehicle}/stream", payload, False, time.monotonic()) is not None
        screen._chosen = vehicle

    shown()
    assert screen._command("r", station) is None
    now_s += APART_S
    shown(**after)
    assert [screen._command(key, station) for key in "yyry"] == [None] * 4
    for waited_s, expected in ((CONFIRM_S, None), (APART_S, OperatorCommand.RESUME)):
        assert screen._command("r", station) is None
        now_s += waited_s
        assert screen._command("y", station) is expected
    assert [screen._command(key, station) for key in "rh"] == [None, OperatorCommand.HOLD]
    now_s += APART_S
    assert screen._command("y", station) is None


@pytest.mark.parametrize("key", "rsy")
@pytest.mark.parametrize("delay_s", [0.2, 0.5, 2.0])
def test_a_held_key_gives_no_command_that_needs_confirmation(
    key: str, delay_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 50.0
    monkeypatch.setattr("companion.ground.station.text_monitor.time.monotonic", lambda: now_s)
    access = broker_access("mqtt://127.0.0.1", None, None)
    station = Station(access, SIGNER, None, lambda heard: None, lambda connected, text: None)
    screen = _Screen(Console())
    payload = to_json(with_proofs(replace(flight()[1][-1], session="s1", wall_s=1e9), "rig", [ANNA.key]))
    assert station.tracker.receive("companion/rig/stream", payload, False, now_s) is not None
    for repeat_s in (0.0, delay_s, *[0.033] * 300, 0.5, 1.0):  # and let go, pressed again
        now_s += repeat_s
        assert screen._command(key, station) is None


@pytest.mark.parametrize("key", "sl")
def test_without_a_vehicle_a_key_is_answered_and_asks_for_no_confirmation(key: str) -> None:
    station = Station(broker_access("mqtt://127.0.0.1", None, None), SIGNER, None, lambda _: None, lambda *_: None)
    screen = _Screen(Console())
    assert screen._command(key, station) is None
    (notice,) = screen._notices
    assert notice.text == f"{KEYS[key].value}: not sent, because no vehicle is heard"


async def test_it_shows_commands_and_leaves_the_terminal_as_it_was(broker: Broker, tmp_path: Path) -> None:
    async with played_vehicle(broker.port, OPERATORS) as vehicle, terminal_at(broker, tmp_path) as terminal:
        await terminal.shows("FLYING")
        for key, name in (("h", "hold"), ("L", "land"), ("a", "abort")):
            await terminal.shows(f"rig: {name}: {name}: done (anna)", on=key)
        terminal.press("s")
        await terminal.shows("start? press y")
        terminal.press("r")
        await terminal.shows("resume? press y")
        await terminal.shows("rig: resume: resume: done (anna)", on="ry")
        # One whose answer is late is sent again.
        assert list(dict.fromkeys(heard.command.value for heard in vehicle.accepted)) == [
            "hold",
            "land",
            "abort",
            "resume",
        ]
        vehicle.streams = False
        await terminal.shows("NO DATA FOR")
        vehicle.streams = True
        await terminal.shows("FLYING")
        assert terminal.settings != terminal.before
        terminal.press("q")
        assert await terminal.ended() == 0
        assert terminal.settings == terminal.before


async def test_n_shows_the_next_vehicle_and_ctrl_c_ends_the_display(broker: Broker, tmp_path: Path) -> None:
    async with (
        played_vehicle(broker.port, OPERATORS, "one") as one,
        played_vehicle(broker.port, OPERATORS, "two") as two,
        terminal_at(broker, tmp_path) as terminal,
    ):
        await terminal.shows("n: next of one, two")
        await terminal.shows("FLYING")  # a vehicle whose stream has not come yet gets no commands
        await terminal.shows(": hold: hold: done (anna)", on="h")
        first, second = (one, two) if one.accepted else (two, one)
        terminal.press("n")
        await terminal.shows(f"{second.name}   FLYING")
        await terminal.shows(f"{second.name}: hold: hold: done (anna)", on="h")
        for vehicle in (first, second):  # a HOLD whose answer is late is sent again
            assert {heard.command for heard in vehicle.accepted} == {OperatorCommand.HOLD}
        terminal.process.send_signal(signal.SIGINT)
        assert await terminal.ended() == 0
        assert terminal.settings == terminal.before


async def test_a_pipe_gets_a_line_a_second(broker: Broker) -> None:
    async with played_vehicle(broker.port, OPERATORS):
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "companion", "monitor", "--text", "--view-only", "--broker", broker.url),
            cwd=ROOT,
            stdout=asyncio.subprocess.PIPE,
        )
        assert process.stdout is not None
        lines = [(await process.stdout.readline()).decode() for _ in range(3)]
        process.send_signal(signal.SIGINT)
        await process.communicate()
        assert process.returncode == 0
        assert lines[:2] == [f"no broker at {broker.url} yet, trying\n", f"connected to {broker.url}\n"]
        for text in lines[2:]:
            assert re.match(r"\d\d:\d\d:\d\d rig \| [A-Z .0-9s]+ \| .* \| last event ", text), text
