"""What the user started: brings the processes of a flight up, watches them, outlives them, and says how it ended.

launcher --starts--> sitl (with --sitl), flight --starts--> recorder
         --starts--> guardian, which ends the flight process and lands when that hangs or dies
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
from typing import Any, Literal

from companion.config.loader import FlightConfig
from companion.guardian.heartbeat import HANGS
from companion.launcher.cpu_contention import Crowding
from companion.launcher.guardian_process import GuardianProcess
from companion.launcher.sitl_process import SitlProcess
from companion.model.exit_codes import EXIT_CODES
from companion.model.types import Outcome, PhaseKind, SafetyAction, Severity
from companion.runtime import ipc
from companion.runtime.cores import keep_off
from companion.runtime.subprocesses import (
    LaunchError,
    holds_traceback,
    how_it_ended,
    last_line,
    remove_file,
    scratch_folder,
    terminate,
    write_text,
)

SITL_SETTLE_TIMEOUT_S = 40.0
"""After the flight process is gone: how long the world may take to come to rest."""
SILENT_FLIGHT_S = 5.0
"""A flight process that says nothing for this long hangs, and the guardian has not seen to it: on the ground that is not its business,
and it may be dead itself. Killed, the flight process leaves PX4 to its own offboard-loss landing."""
GUARDIAN_LEAVE_TIMEOUT_S = 5.0
"""After the flight process is gone: a guardian that is not needed leaves at once."""
RECORDER_CLOSE_TIMEOUT_S = 10.0

OnMessage = Callable[[ipc.Message], None]
Sitl = Literal["stub", "px4"]
"""Who stands for the autopilot in the simulated world."""


@dataclass
class FlightResult:
    """What is known after the flight."""

    outcome: Outcome
    recorder: dict[str, Any] | None = None
    world: dict[str, Any] = field(default_factory=dict)
    """SITL truth: payload_kg, caught, crashed, ..."""
    events: tuple[dict[str, Any], ...] = ()
    """What the flight process told, as summary.json lists events; the log has them too, unless its recorder died."""
    guardian_events: tuple[dict[str, Any], ...] = ()
    """What the guardian did, as summary.json lists events; empty: it was not needed."""
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
        sitl: fly in the simulated world; "px4": with a real PX4 in it, True or "stub": with the stub.
        on_message: called with every message of the flight process, for the display; those of the world have a "source" of "sitl".
    """

    def __init__(self, config: FlightConfig, out: Path, *, sitl: bool | Sitl, on_message: OnMessage) -> None:
        self._config = config
        self._out = out
        self._sitl_kind = sitl
        self._on_message = on_message
        self._stop_asked = False
        self._channel: socket.socket | None = None
        self._result: dict[str, Any] | None = None
        self._refused: list[str] | None = None
        self._grave: list[tuple[int, str]] = []
        """Events that end a flight, by tick; the first ones are the cause, the others what followed from it."""
        self._events: list[dict[str, Any]] = []
        self._px4: list[str] = []
        """What PX4 said since the flight began."""
        self._failures: list[str] = []
        self._recorder_pid: int | None = None
        self._guardian: GuardianProcess | None = None
        self._crowding = Crowding({})
        self._flying = False
        """Ticking, and not over yet: messages come ten times a second."""

    def ask_to_land(self) -> None:
        """Ctrl-C: land; asking again changes nothing."""
        self._stop_asked = True
        if self._channel is not None:
            ipc.send(self._channel, {"type": "land"})

    def run(self) -> FlightResult:
        """Fly. To be called inside of `landing_signals(launcher.ask_to_land)`.

        From here on this process is off the cores of `computer.cpus`, and with it all that it starts; the flight process alone goes
        there by itself.

        Raises:
            LaunchError: a process of the flight could not be started.
        """
        sitl: SitlProcess | None = None
        keep_off(self._config.vehicle.computer.cpus)
        try:
            config = self._config
            if self._sitl_kind:
                sitl = SitlProcess(config, self._out, px4=self._sitl_kind == "px4")
                config = with_devices(config, sitl.devices(self._on_world_message, lambda: self._stop_asked))
            path = self._out / "config.json"
            write_text(path, config.model_dump_json(indent=1))
            # TMPDIR of the flight process: MAVSDK keeps folders there, and leaves them when it is killed.
            with scratch_folder(self._out) as tmp:
                outcome = Outcome.ABORTED if self._stop_asked else self._fly(path, sitl, tmp)
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
        events = tuple(self._guardian.summary_events()) if self._guardian is not None else ()
        return FlightResult(outcome, recorder, world, tuple(self._events), events, self._lines(outcome))

    def _on_world_message(self, message: dict[str, Any]) -> None:
        self._on_message({**message, "source": "sitl"})

    def _fly(self, config_path: Path, sitl: SitlProcess | None, tmp: Path) -> Outcome:
        log_path = self._out / "flight.log"
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        beats_out, beats_in = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # Flight and guardian hold the world's standard input open as well: the world stays until all are gone. Should this process
        # be killed, the flight lands and hears that it has landed.
        shared = () if sitl is None or sitl.process.stdin is None else (sitl.process.stdin.fileno(),)
        with ours, beats_in:
            ours.setblocking(False)
            with theirs, beats_out, open(log_path, "wb") as log:
                process = subprocess.Popen(
                    [
                        *(
                            sys.executable,
                            "-m",
                            "companion.flight.main",
                            "--config",
                            str(config_path),
                            "--out",
                            str(self._out),
                        ),
                        *("--channel", str(theirs.fileno()), "--guardian", str(beats_out.fileno())),
                        *(("--sitl",) if sitl is not None else ()),
                    ],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    pass_fds=(theirs.fileno(), beats_out.fileno(), *shared),
                    start_new_session=True,
                    env={**os.environ, "TMPDIR": str(tmp), **(sitl.flight_environment if sitl is not None else {})},
                )
            self._channel = ours
            try:
                write_text(self._out / "flight.pid", str(process.pid))
                if sitl is not None:
                    sitl.tell_flight(process.pid)
                pids = {
                    "flight process": process.pid,
                    **({"simulated world": sitl.process.pid} if sitl is not None else {}),
                }
                self._crowding = Crowding(pids)
                self._guardian = guardian = GuardianProcess(config_path, self._out, process.pid, beats_in, shared)
                if self._stop_asked:
                    self.ask_to_land()
                self._watch(process, ours, guardian, sitl)
            finally:
                self._channel = None
                terminate(process, patience_s=30.0 if self._result is None else 10.0)
                remove_file(self._out / "flight.pid")
                if self._guardian is not None:
                    self._guardian.end(GUARDIAN_LEAVE_TIMEOUT_S)
        self._await_recorder()
        return self._judge(process.returncode, log_path, sitl)

    def _judge(self, code: int, log_path: Path, sitl: SitlProcess | None) -> Outcome:
        """The outcome of a flight process that is gone, by what it said and how it ended."""
        guardian = self._guardian
        expected: int | None
        if self._refused is not None:
            outcome, expected = Outcome.REFUSED, EXIT_CODES[Outcome.REFUSED]
        elif guardian is not None and guardian.outcome is not None:
            outcome, expected = guardian.outcome, None
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
        elif guardian is not None and guardian.took_over:
            self._failures.append(self._after_take_over(guardian, code, log_path))
        elif code != expected:
            self._failures.append(
                f"flight: the flight process {how_it_ended(code)}{last_line(log_path)}; see {log_path}"
            )
        elif holds_traceback(log_path):
            self._failures.append(f"flight: an internal error was logged{last_line(log_path)}; see {log_path}")
        trouble = guardian.trouble() if guardian is not None and (sitl is None or not sitl.ended) else None
        if trouble is not None:
            self._failures.append(trouble)
        # A flight that was given up without a word from PX4 may still be landing.
        if outcome in (Outcome.LOST, Outcome.ABORTED) and sitl is not None:
            sitl.wait_at_rest(time.monotonic() + SITL_SETTLE_TIMEOUT_S)
        return outcome

    @staticmethod
    def _after_take_over(guardian: GuardianProcess, code: int, log_path: Path) -> str:
        """One line: what became of the flight process, and of the vehicle."""
        vehicle = {
            Outcome.ABORTED: "the guardian landed the vehicle",
            Outcome.CRASHED: "the vehicle was flipped or tipped over, the guardian had its rotors stopped",
        }.get(guardian.outcome or Outcome.LOST, "the guardian could not confirm a landing")
        hung = guardian.events[0]["text"].startswith(HANGS)
        what = "hung and was killed" if hung else f"{how_it_ended(code)}{last_line(log_path)}"
        return f"flight: the flight process {what}; {vehicle}; see {log_path}"

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
        busy = () if self._crowding.line is None else (self._crowding.line,)
        return (*reasons, *busy, *self._failures)

    def _watch(
        self,
        process: subprocess.Popen[bytes],
        channel: socket.socket,
        guardian: GuardianProcess,
        sitl: SitlProcess | None,
    ) -> None:
        """Pass on what the flight and the guardian say, until both have closed their channels; see to one that hangs."""
        flight_open = True
        heard_s = flight_open_s = time.monotonic()
        while flight_open or guardian.open:
            channels = [channel] * flight_open + [guardian.channel] * guardian.open
            readable, _, _ = select.select(channels, [], [], 0.5)
            if sitl is not None:
                for message in sitl.messages(0.0):
                    self._on_world_message(message)
                if sitl.ended:  # there is nothing left that anybody could land
                    guardian.kill()
                    process.kill()
                    return
            for message in guardian.listen():
                self._on_message(message)
                self._look_for_crowding(message)
            now_s = time.monotonic()
            self._crowding.sample(now_s)
            if channel in readable:
                heard_s = now_s
                flight_open = self._hear(channel)
            elif flight_open and process.poll() is not None:
                flight_open = False
            elif flight_open and self._flying and not guardian.took_over and now_s - heard_s > SILENT_FLIGHT_S:
                text = f"flight: the flight process said nothing for {SILENT_FLIGHT_S:g} s and was killed"
                self._failures.append(text)
                process.kill()
            if flight_open:
                flight_open_s = now_s
            alone_s = now_s - flight_open_s
            if guardian.hangs() or (not guardian.took_over and alone_s > GUARDIAN_LEAVE_TIMEOUT_S):
                self._failures.append("guardian: the guardian process hangs and was killed")
                guardian.kill()
                return

    def _hear(self, channel: socket.socket) -> bool:
        """Take what the flight has said; False: it has closed its channel."""
        with contextlib.suppress(BlockingIOError):
            while True:
                received = ipc.receive(channel)
                if received is None:
                    return False
                self._take(received)
        return True

    def _take(self, message: ipc.Message) -> None:
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
            told = {key: message[key] for key in ("id", "severity", "action", "text")}
            self._events.append({"t_s": message["flight_t_s"], "mission_t_s": message["t_s"], **told})
            ends = SafetyAction(message["action"]).rank >= SafetyAction.LAND.rank
            if ends or message["severity"] == Severity.CRITICAL.value:
                self._grave.append((message["tick"], message["text"]))
        elif kind == "px4":
            self._px4.append(message["text"])
        self._on_message(message)
        self._look_for_crowding(message)

    def _look_for_crowding(self, message: ipc.Message) -> None:
        """What happened may be the doing of other programs: then the operator is told so beside it."""
        text = self._crowding.take(message, time.monotonic())
        if text is None:
            return
        self._on_message({"type": "busy", "text": text})
        stamps = {"t_s": message.get("flight_t_s", 0.0), "mission_t_s": message.get("t_s", 0.0)}
        about = {"id": "computer_busy", "severity": Severity.WARNING.value, "action": SafetyAction.WARN.value}
        self._events.append({**stamps, **about, "text": text})

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
