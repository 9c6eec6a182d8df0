"""The parent process of a flight: starts the processes, watches them, and determines the outcome.

launcher --starts--> sitl (with --sitl), flight --starts--> recorder
         --starts--> guardian, which kills a hung flight process and lands the vehicle
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec

from companion.config.loader import FlightConfig
from companion.launcher.cpu_contention import CpuContention
from companion.launcher.guardian_process import GuardianProcess
from companion.launcher.reports import FlightReports
from companion.launcher.shared_time import SharedTime
from companion.launcher.sitl_process import SitlProcess
from companion.model.exit_codes import EXIT_CODES
from companion.model.launcher_messages import (
    AnyMessage,
    Busy,
    FlightEvent,
    Land,
    Message,
    Pace,
    Status,
    Unreadable,
)
from companion.model.types import Outcome, SafetyAction, Severity
from companion.runtime import ipc
from companion.runtime.cores import keep_off
from companion.runtime.subprocesses import (
    LaunchError,
    remove_file,
    scratch_folder,
    terminate,
    write_text,
)
from companion.sitl_config.loader import SitlConfig

SITL_SETTLE_TIMEOUT_S = 40.0
"""Timeout for the simulated world to come to rest after the flight process has ended."""
FLIGHT_SILENT_TIMEOUT_S = 5.0
"""Silence after which the launcher treats the flight process as hung. The guardian does not act on the ground and may
be dead. Once the flight process is killed, PX4 lands by its own offboard-loss failsafe.
"""
ENDING_TIMEOUT_S = 30.0
"""The same after the flight: closing the log takes 10 s at most."""
GUARDIAN_EXIT_TIMEOUT_S = 5.0
"""Time allowed for a guardian that has not taken over to exit after the flight process has ended."""
RECORDER_CLOSE_TIMEOUT_S = 10.0

OnMessage = Callable[[AnyMessage], None]
Sitl = Literal["stub", "px4"]
"""Autopilot of the simulated world."""


@dataclass
class FlightResult:
    """Outcome of a flight and its data."""

    outcome: Outcome
    recorder: dict[str, Any] | None = None
    world: dict[str, Any] = field(default_factory=dict)
    """True state of the simulated world: payload_kg, caught, crashed, ..."""
    events: tuple[dict[str, Any], ...] = ()
    """Events that the flight process reported, in the format of summary.json; the log has them too, unless the recorder died."""
    guardian_events: tuple[dict[str, Any], ...] = ()
    """Events of the guardian in the format of summary.json; empty if it did not take over."""
    pace: float | None = None
    """Simulated seconds per second of the flight; None in real time, and for a flight without a tick."""
    lines: tuple[str, ...] = ()
    """Lines for the user: why the flight was refused, or which process failed and where its log is."""

    @property
    def exit_code(self) -> int:
        """Exit code of `companion fly`."""
        return EXIT_CODES[self.outcome]


class Launcher:
    """Runs one flight.

    Args:
        config: checked configuration. With SITL, the addresses of the simulated devices replace its device addresses, and only
            the sitl process receives the configuration of the world.
        out: existing folder for all files of the flight.
        sitl: autopilot of the simulated world; None for hardware.
        speed: simulated seconds in a second of real time at most, with SITL; None for a flight in real time.
        world: with SITL, the running world of several vehicles; None to start one.
    """

    def __init__(
        self,
        config: SitlConfig,
        out: Path,
        *,
        sitl: Sitl | None,
        on_message: OnMessage,
        speed: float | None = None,
        world: SitlProcess | None = None,
    ) -> None:
        self._speed = speed if sitl is not None else None
        self._world = world
        self._time: SharedTime | None = None
        self._flown_from: tuple[float, float] | None = None
        """Simulated time and wall time of the first status message."""
        self._pace: float | None = None
        self._config = config
        self._out = out
        self._sitl = sitl
        self._on_message = on_message
        self._stop_requested = False
        self._channel: socket.socket | None = None
        self._reports = FlightReports()
        self._guardian: GuardianProcess | None = None
        self._cpu_contention = CpuContention({})

    @property
    def begun(self) -> bool:
        """Whether the flight process has ticked."""
        return self._reports.begun

    def request_landing(self) -> None:
        """Request a landing (Ctrl-C); repeated requests change nothing."""
        self._stop_requested = True
        if self._channel is not None:
            ipc.send(self._channel, Land())

    def run(self) -> FlightResult:
        """Run the flight. Call it while `LAND_SIGNALS` call `request_landing`.

        This process and its children leave the cores of `computer.cpus`; only the flight process returns to them.

        Raises:
            LaunchError: a process of the flight could not be started.
        """
        sitl = self._world
        keep_off(self._config.vehicle.computer.cpus)
        try:
            config = self._config.flight
            if self._sitl is not None:
                sitl = sitl or SitlProcess.start(self._config, self._out, self._speed, px4=self._sitl == "px4")
                self._time = sitl.time
                config = replace_device_settings(config, sitl.devices(self._on_message, lambda: self._stop_requested))
            path = self._out / "config.json"
            write_text(path, config.model_dump_json(indent=1))
            # TMPDIR of the flight process: MAVSDK keeps folders there, and leaves them when it is killed.
            with scratch_folder(self._out) as tmp:
                outcome = Outcome.ABORTED if self._stop_requested else self._fly(path, sitl, tmp)
        except LaunchError:
            if not self._stop_requested:
                raise
            # A child that has not left the terminal's process group yet receives the Ctrl-C, too.
            outcome = Outcome.ABORTED
        finally:
            if sitl is not None:
                sitl.stop()
        world = sitl.final if sitl is not None else {}
        if world.get("crashed") and outcome is not Outcome.REFUSED:
            outcome = Outcome.CRASHED
        recorded = self._reports.result.recorded if self._reports.result is not None else None
        events = () if self._guardian is None else tuple(event.for_summary() for event in self._guardian.events)
        return FlightResult(
            outcome=outcome,
            recorder=None if recorded is None else msgspec.structs.asdict(recorded),
            world=world,
            events=tuple(self._reports.events),
            guardian_events=events,
            pace=self._pace,
            lines=self._reports.user_lines(outcome, self._cpu_contention.message),
        )

    def _fly(self, config_path: Path, sitl: SitlProcess | None, tmp: Path) -> Outcome:
        log_path = self._out / "flight.log"
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        heartbeats_out, heartbeats_in = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # Flight and guardian also keep the world's standard input open, so that the world runs until all have exited. If this process
        # is killed, the flight process can still land and see that it has landed.
        shared = () if sitl is None else (sitl.told.fileno(),)
        in_time, inherited = ((), ()) if self._time is None else self._time.of("flight")
        with ours, heartbeats_in:
            ours.setblocking(False)
            with theirs, heartbeats_out, open(log_path, "wb") as log:
                process = subprocess.Popen(
                    [
                        *(sys.executable, "-P", "-m", "companion.flight.main"),
                        *("--config", str(config_path), "--out", str(self._out)),
                        *("--channel", str(theirs.fileno()), "--guardian", str(heartbeats_out.fileno())),
                        *(("--sitl",) if sitl is not None else ()),
                        *in_time,
                    ],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    pass_fds=(theirs.fileno(), heartbeats_out.fileno(), *shared, *inherited),
                    start_new_session=True,
                    env={**os.environ, "TMPDIR": str(tmp), **(sitl.flight_environment if sitl is not None else {})},
                )
            self._channel = ours
            try:
                write_text(self._out / "flight.pid", str(process.pid))
                if sitl is not None:
                    sitl.send_flight_pid(process.pid)
                pids = {
                    "flight process": process.pid,
                    **({"simulated world": sitl.process.pid} if sitl is not None else {}),
                }
                if self._time is None:  # else time waits for a busy computer
                    self._cpu_contention = CpuContention(pids)
                in_time, inherited = ((), ()) if self._time is None else self._time.of("guardian")
                shared = (*shared, *inherited)
                self._guardian = guardian = GuardianProcess(
                    config_path, self._out, process.pid, heartbeats_in, shared, in_time, self._now_s
                )
                if self._time is not None:
                    self._time.started("flight")
                    self._time.started("guardian")
                if self._stop_requested:
                    self.request_landing()
                self._watch(process, ours, guardian, sitl)
            finally:
                self._channel = None
                terminate(process, patience_s=30.0 if self._reports.result is None else 10.0)
                remove_file(self._out / "flight.pid")
                if self._guardian is not None:
                    self._guardian.stop(GUARDIAN_EXIT_TIMEOUT_S)
        self._await_recorder()
        outcome = self._reports.outcome(
            process.returncode, log_path, guardian, sitl, stop_requested=self._stop_requested
        )
        # Without an answer from PX4 the vehicle may still be landing.
        if outcome in (Outcome.LOST, Outcome.ABORTED) and sitl is not None:
            sitl.wait_at_rest(time.monotonic() + SITL_SETTLE_TIMEOUT_S)
        return outcome

    def _watch(
        self,
        process: subprocess.Popen[bytes],
        channel: socket.socket,
        guardian: GuardianProcess,
        sitl: SitlProcess | None,
    ) -> None:
        """Forward the messages of flight and guardian until both have closed their channels; kill a process that hangs."""
        flight_open = True
        flight_open_s = guardian_open_s = time.monotonic()
        heard_s = self._now_s()
        while flight_open or guardian.open:
            channels = [channel] * flight_open + [guardian.channel] * guardian.open
            readable, _, _ = select.select(channels, [], [], 0.5)
            if sitl is not None:
                for said in sitl.messages(0.0):
                    self._on_message(said)
                if sitl.ended:  # nothing is left to land
                    guardian.process.kill()
                    process.kill()
                    return
            for message in guardian.receive():
                if isinstance(message, Unreadable):
                    self._reports.failures.append(f"guardian: an internal error: {message.text}")
                self._on_message(message)
                self._check_cpu_contention(message)
            now_s = time.monotonic()
            self._cpu_contention.sample(now_s)
            self._report_pace()
            if flight_open:
                flight_open_s = now_s
            if guardian.open:
                guardian_open_s = now_s
            silent_max_s = FLIGHT_SILENT_TIMEOUT_S if self._reports.flying else ENDING_TIMEOUT_S
            if channel in readable:
                heard_s = self._now_s()
                flight_open = self._receive(channel)
            elif flight_open and process.poll() is not None:
                self._receive(channel)  # its last messages may have come after `select`
                flight_open = False
            elif flight_open and guardian.took_over:
                if now_s - guardian_open_s > GUARDIAN_EXIT_TIMEOUT_S:  # SIGKILL has not ended it either
                    return
            elif flight_open and self._reports.begun and self._now_s() - heard_s > silent_max_s:
                text = f"flight: the flight process sent nothing for {silent_max_s:g} s and was killed"
                self._reports.failures.append(text)
                process.kill()
            alone_s = now_s - flight_open_s
            if guardian.hangs() or (guardian.open and not guardian.took_over and alone_s > GUARDIAN_EXIT_TIMEOUT_S):
                self._reports.failures.append("guardian: the guardian process hung and was killed")
                guardian.process.kill()
                return

    def _now_s(self) -> float:
        """Return the time that the flight lives in."""
        return time.monotonic() if self._time is None else self._time.now_s()

    def _measure_pace(self) -> None:
        if self._time is None:
            return
        now_s, wall_s = self._time.now_s(), time.monotonic()
        if self._flown_from is None:
            self._time.restart_pace()
        from_s, from_wall_s = self._flown_from = self._flown_from or (now_s, wall_s)
        if wall_s > from_wall_s:
            self._pace = (now_s - from_s) / (wall_s - from_wall_s)

    def _report_pace(self) -> None:
        pace = None if self._time is None or not self._reports.flying else self._time.pace()
        if pace is not None and self._speed is not None:
            self._on_message(Pace(pace, self._speed))

    def _receive(self, channel: socket.socket) -> bool:
        """Handle the waiting messages of the flight process; return False if it has closed its channel."""
        with contextlib.suppress(BlockingIOError):
            while True:
                received = ipc.receive(channel)
                if received is None:
                    return False
                self._handle(received)
        return True

    def _handle(self, message: Message) -> None:
        self._reports.take(message)
        if isinstance(message, Status):
            self._measure_pace()
        self._on_message(message)
        self._check_cpu_contention(message)

    def _check_cpu_contention(self, message: Message) -> None:
        """Report a busy computer together with an event that lateness may have caused."""
        text = self._cpu_contention.on_message(message, time.monotonic())
        if text is None:
            return
        self._on_message(Busy(text))
        t_s, mission_t_s = (message.t_s, message.mission_t_s) if isinstance(message, FlightEvent) else (0.0, 0.0)
        busy = FlightEvent(
            tick=0,
            t_s=t_s,
            mission_t_s=mission_t_s,
            id="computer_busy",
            severity=Severity.WARNING,
            action=SafetyAction.WARN,
            text=text,
        )
        self._reports.events.append(busy.for_summary())

    def _await_recorder(self) -> None:
        """Wait for the recorder to close the log if the flight process was killed; its pidfd is polled, as it is no child."""
        result = self._reports.result
        if self._reports.recorder_pid is None or (result is not None and result.recorded is not None):
            return
        try:
            pidfd = os.pidfd_open(self._reports.recorder_pid)
        except OSError:
            return
        select.select([pidfd], [], [], RECORDER_CLOSE_TIMEOUT_S)
        os.close(pidfd)


def replace_device_settings(config: FlightConfig, addresses: dict[str, dict[str, Any]]) -> FlightConfig:
    """Return a validated copy of the configuration with some device settings replaced."""
    data = json.loads(config.model_dump_json())
    for device, settings in addresses.items():
        data["vehicle"]["devices"][device].update(settings)
    return FlightConfig.model_validate_json(json.dumps(data))
