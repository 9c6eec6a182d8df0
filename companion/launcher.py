"""What the user started: brings the processes of a flight up, watches them, outlives them, and says how it ended.

launcher --starts--> sitl (with --sitl), flight --starts--> recorder
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from companion import status
from companion.children import LaunchError, holds_traceback, how_it_ended, last_line, terminate, write_text
from companion.config.loader import FlightConfig
from companion.exit_codes import EXIT_CODES
from companion.sitl_process import SitlProcess
from companion.types import Outcome, PhaseKind, SafetyAction, Severity

SITL_SETTLE_TIMEOUT_S = 40.0
"""After the flight process is gone: how long the world may take to come to rest."""
SILENT_FLIGHT_S = 5.0
"""A flight process that says nothing for this long hangs; killed, it leaves PX4 to its own offboard-loss landing."""
RECORDER_CLOSE_TIMEOUT_S = 10.0

OnMessage = Callable[[status.Message], None]


@dataclass
class FlightResult:
    """What is known after the flight."""

    outcome: Outcome
    recorder: dict[str, Any] | None = None
    world: dict[str, Any] = field(default_factory=dict)
    """SITL truth: payload_kg, caught, crashed, ..."""
    lines: tuple[str, ...] = ()
    """For the user: why the flight was refused, or which process failed and where its log is."""

    @property
    def exit_code(self) -> int:
        """Exit code of `companion fly`."""
        return EXIT_CODES[self.outcome]


@contextlib.contextmanager
def landing_signals(land: Callable[[], None]) -> Iterator[None]:
    """While inside: SIGINT, SIGTERM and SIGHUP call `land`, and end nothing."""
    handlers = {number: signal.signal(number, lambda *_: land()) for number in _LAND_SIGNALS}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


class Launcher:
    """One flight from start to end, seen from outside.

    Args:
        config: checked configuration; with SITL the device addresses are replaced by the world's.
        out: folder for everything that the flight leaves; exists already.
        sitl: fly in the simulated world.
        on_message: called with every message of the flight process, for the display.
    """

    def __init__(self, config: FlightConfig, out: Path, *, sitl: bool, on_message: OnMessage) -> None:
        self._config = config
        self._out = out
        self._use_sitl = sitl
        self._on_message = on_message
        self._stop_asked = False
        self._channel: socket.socket | None = None
        self._result: dict[str, Any] | None = None
        self._refused: list[str] | None = None
        self._grave: list[tuple[int, str]] = []
        """Events that end a flight, by tick; the first ones are the cause, the others what followed from it."""
        self._px4: list[str] = []
        """What PX4 said since the flight began."""
        self._failures: list[str] = []
        self._recorder_pid: int | None = None
        self._flying = False
        """Ticking, and not over yet: messages come ten times a second."""

    def ask_to_land(self) -> None:
        """Ctrl-C: land; asking again changes nothing."""
        self._stop_asked = True
        if self._channel is not None:
            status.send(self._channel, {"type": "land"})

    def run(self) -> FlightResult:
        """Fly. To be called inside of `landing_signals(launcher.ask_to_land)`.

        Raises:
            LaunchError: a process of the flight could not be started.
        """
        sitl: SitlProcess | None = None
        try:
            config = self._config
            if self._use_sitl:
                sitl = SitlProcess(config, self._out)
                config = with_devices(config, sitl.devices())
            path = self._out / "config.json"
            write_text(path, config.model_dump_json(indent=1))
            outcome = Outcome.ABORTED if self._stop_asked else self._fly(path, sitl)
        except LaunchError:
            if not self._stop_asked:
                raise
            outcome = (
                Outcome.ABORTED
            )  # a child that has not left the terminal's process group yet takes its Ctrl-C, too
        finally:
            if sitl is not None:
                sitl.stop()
        world = sitl.final if sitl is not None else {}
        if world.get("crashed") and outcome is not Outcome.REFUSED:
            outcome = Outcome.CRASHED
        recorder = self._result.get("recorder") if self._result else None
        return FlightResult(outcome, recorder, world, self._lines(outcome))

    def _fly(self, config_path: Path, sitl: SitlProcess | None) -> Outcome:
        log_path = self._out / "flight.log"
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # The flight holds the world's standard input open as well: the world stays until both are gone. Should this process be
        # killed, the flight lands and hears that it has landed.
        shared = () if sitl is None or sitl.process.stdin is None else (sitl.process.stdin.fileno(),)
        with ours:
            ours.setblocking(False)
            with theirs, open(log_path, "wb") as log:
                process = subprocess.Popen(
                    [
                        *(sys.executable, "-m", "companion.app", "--config", str(config_path)),
                        *("--out", str(self._out), "--channel", str(theirs.fileno())),
                    ],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    pass_fds=(theirs.fileno(), *shared),
                    start_new_session=True,
                )
            self._channel = ours
            try:
                write_text(self._out / "flight.pid", str(process.pid))
                if self._stop_asked:
                    self.ask_to_land()
                self._watch(process, ours, sitl)
            finally:
                self._channel = None
                terminate(process, patience_s=30.0 if self._result is None else 10.0)
        self._await_recorder()
        return self._judge(process.returncode, log_path, sitl)

    def _judge(self, code: int, log_path: Path, sitl: SitlProcess | None) -> Outcome:
        """The outcome of a flight process that is gone, by what it said and how it ended."""
        if self._refused is not None:
            outcome, expected = Outcome.REFUSED, EXIT_CODES[Outcome.REFUSED]
        elif self._result is not None and code >= 0:
            outcome = Outcome(self._result["outcome"])
            expected = EXIT_CODES[outcome]
        elif self._recorder_pid is None and self._stop_asked and -code in _LAND_SIGNALS:
            outcome, expected = Outcome.ABORTED, code  # as in `run`
        elif self._recorder_pid is None:
            outcome, expected = Outcome.REFUSED, None  # it never began: nothing can have been armed
        else:
            outcome, expected = Outcome.LOST, None
        if sitl is not None and sitl.ended:
            self._failures.append(sitl.epitaph())
        elif code != expected:
            self._failures.append(
                f"flight: the flight process {how_it_ended(code)}{last_line(log_path)}; see {log_path}"
            )
        elif holds_traceback(log_path):
            self._failures.append(f"flight: an internal error was logged{last_line(log_path)}; see {log_path}")
        if outcome is Outcome.LOST and sitl is not None:
            sitl.wait_at_rest(time.monotonic() + SITL_SETTLE_TIMEOUT_S)
        return outcome

    def _lines(self, outcome: Outcome) -> tuple[str, ...]:
        if outcome is not Outcome.REFUSED:
            return tuple(self._failures)
        reasons = self._refused
        if reasons is None:
            said = "; ".join(dict.fromkeys(self._px4))
            reasons = [
                f"{text}; PX4 said: {said}" if said and "PX4" in text else text
                for tick, text in self._grave
                if tick == self._grave[0][0]
            ]
        return (*reasons, *self._failures)

    def _watch(self, process: subprocess.Popen[bytes], channel: socket.socket, sitl: SitlProcess | None) -> None:
        """Pass the flight's messages on until it closes its channel, or hangs."""
        heard_s = time.monotonic()
        while True:
            readable, _, _ = select.select([channel], [], [], 0.5)
            if sitl is not None:
                for message in sitl.messages(0.0):
                    self._on_message({**message, "source": "sitl"})
                if sitl.ended:
                    process.kill()  # there is nothing left that it could land
                    return
            if not readable:
                if process.poll() is not None:
                    return
                if self._flying and time.monotonic() - heard_s > SILENT_FLIGHT_S:
                    self._failures.append(
                        f"flight: the flight process said nothing for {SILENT_FLIGHT_S:g} s and was killed"
                    )
                    process.kill()
                    return
                continue
            heard_s = time.monotonic()
            with contextlib.suppress(BlockingIOError):
                while True:
                    received = status.receive(channel)
                    if received is None:
                        return
                    self._take(received)

    def _take(self, message: status.Message) -> None:
        kind = message.get("type")
        if kind == "result":
            self._result = message
        elif kind == "refused":
            self._refused = message["lines"]
        elif kind == "started":
            self._recorder_pid = message["recorder_pid"]
        elif kind == "status":
            self._flying = message["kind"] != PhaseKind.DONE.value
        elif kind == "event":
            ends = SafetyAction(message["action"]).rank >= SafetyAction.LAND.rank
            if ends or message["severity"] == Severity.CRITICAL.value:
                self._grave.append((message["tick"], message["text"]))
        elif kind == "px4":
            self._px4.append(message["text"])
        self._on_message(message)

    def _await_recorder(self) -> None:
        """The recorder closes the log after a flight process that was killed; it is no child of ours, so look at its pid."""
        if self._recorder_pid is None or self._result is not None:
            return
        try:
            pidfd = os.pidfd_open(self._recorder_pid)
        except OSError:
            return
        select.select([pidfd], [], [], RECORDER_CLOSE_TIMEOUT_S)
        os.close(pidfd)


_LAND_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def with_devices(config: FlightConfig, addresses: dict[str, dict[str, Any]]) -> FlightConfig:
    """The configuration with some device settings replaced, checked again."""
    data = json.loads(config.model_dump_json())
    for device, settings in addresses.items():
        data["vehicle"]["devices"][device].update(settings)
    return FlightConfig.model_validate_json(json.dumps(data))
