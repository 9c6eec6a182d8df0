"""The guardian process: watches the flight process and takes over when it hangs or dies while the rotors may turn.

The launcher starts it as `python -m companion.guardian --config FILE --heartbeats FD --channel FD --pidfd FD`. Exit code 0: no
takeover was needed, or the vehicle has landed; 1: the vehicle is lost.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import os
import select
import signal
import socket
import traceback
from collections.abc import Iterator
from pathlib import Path

from companion.guardian import heartbeat
from companion.guardian.flight_process import FlightProcess, HeartbeatReceiver
from companion.guardian.heartbeat import Heartbeat
from companion.guardian.link import Link
from companion.guardian.mocap import GuardianMocap
from companion.guardian.monitors import StallWatch
from companion.guardian.settings import Settings, read_settings
from companion.guardian.takeover_landing import TakeoverLanding, notice
from companion.io.protocols import DeviceError
from companion.io.px4.wire import OpenWire, is_udp, open_wire
from companion.io.reopening import Reopening
from companion.io.team_link import TeamSender
from companion.model.codec import to_packet
from companion.model.launcher_messages import FlightEvent, GuardianEnded, GuardianStatus, TookOver
from companion.model.packets import LogLine
from companion.model.team import Grip, TeamState
from companion.model.types import Event, Severity, Vec3
from companion.runtime import ipc, simulated_time
from companion.runtime.clock import monotonic
from companion.runtime.realtime import GUARDIAN_PRIORITY, claim_realtime
from companion.safety.pose_filter import PoseFilter

PERIOD_S = 0.01
MOCAP_FRESH_S = 0.5
KILL_TIMEOUT_S = 0.5
"""Timeout for a killed process to end; it takes milliseconds unless a thread is in uninterruptible sleep (state D)."""
LINK_TIMEOUT_S = 30.0
"""Time after which the guardian gives up opening the link; the vehicle is then lost."""
STATUS_PERIOD_S = 0.5
ERROR_CHARS, ERRORS_REPORTED_MAX = 300, 20


class Guardian:
    """Standby, takeover and landing."""

    def __init__(
        self, settings: Settings, heartbeats: HeartbeatReceiver, channel: socket.socket, flight: FlightProcess
    ) -> None:
        self._settings = settings
        self._heartbeats = heartbeats
        self._channel = channel
        self._flight = flight
        self._external = settings.mocap.type == "external"
        self._mocap: GuardianMocap | None = None
        """None until it is open, and if another program feeds PX4, which then needs no poses from the guardian."""
        self._team: TeamSender | None = None
        """Sends this vehicle's state to the other of a team, once the flight process is dead; None for a vehicle that flies alone."""
        self._pose_filter = PoseFilter(settings.pose_limits)
        """Judges the poses of the landing; in standby it learns the motion-capture server's clock."""
        self._problem: str | None = None
        self._status_s = float("-inf")
        self._errors: set[str] = set()
        """Internal errors that have been reported."""
        self._link_reported = False
        """Whether the closed link has been reported."""
        self._reopening: Reopening[OpenWire] | None = None
        """Attempts to open a lost link again; None while it is open."""
        self._silent_s = 0.0
        """Longest silence while the rotors might turn."""
        self._flight_hangs = False

    def run(self) -> int:
        """Run until the flight has ended or the vehicle has landed; return the exit code."""
        try:
            try:
                if not self._external:
                    self._mocap = GuardianMocap(self._settings.mocap)
                if self._settings.team is not None:
                    self._team = TeamSender(self._settings.team)
            except DeviceError as problem:
                self._problem = str(problem)
            reason = self._stand_by()
            if reason is None or self._heartbeats.last is None:
                return 0
            return 0 if self._take_over(self._heartbeats.last, reason) else 1
        finally:
            received, silent_ms = self._heartbeats, self._silent_s * 1e3
            _log_line(
                f"heard {received.count} heartbeats, {received.missed} missed, silent for {silent_ms:.0f} ms at most in the air"
            )
            for opened in (self._mocap, self._team, received.recorder):
                if opened is not None:
                    opened.close()

    # -- standby ---------------------------------------------------------------------------------------------------

    def _stand_by(self) -> str | None:
        """Watch the flight process; return the reason for a takeover, or None if none is needed."""
        watch = StallWatch(self._settings.timeout_s)
        status_s = float("-inf")
        while True:
            dead = self._flight.watch(PERIOD_S)
            now_s = monotonic()
            heard = self._heartbeats.receive()
            last = self._heartbeats.last
            if self._mocap is not None:
                self._mocap.keep_connected()
                for pose in self._mocap.poses(0.0 if last is None else last.origin_s):
                    self._pose_filter.latency_s(pose)
            if last is not None and last.goodbye:
                return "the flight process has ended its flight, and PX4 may be armed" if last.lifting else None
            lifting = last is not None and last.lifting
            if dead:
                return "the flight process died" if lifting else None
            hangs = watch.update(now_s, heard or not lifting)
            self._silent_s = max(self._silent_s, watch.silent_s)
            if hangs:
                self._flight_hangs = True
                return f"the flight process hangs (silent for {watch.silent_s * 1e3:.0f} ms)"
            if now_s - status_s >= heartbeat.READY_PERIOD_S:
                status_s = now_s
                self._heartbeats.send_status(self._readiness_problem(now_s, last))

    def _readiness_problem(self, now_s: float, last: Heartbeat | None) -> str | None:
        """Return why a landing by the guardian would now be worse than one by the flight process, or None if it would be as good.

        In the air, missing motion capture does not make the guardian unready while the flight process receives none either: both
        would land without it.
        """
        if self._problem is not None or self._mocap is None:
            return self._problem
        if now_s - self._mocap.tracked_s <= MOCAP_FRESH_S:
            return None
        if last is not None and last.lifting and now_s - last.origin_s - last.pose_stamp_s > MOCAP_FRESH_S:
            return None
        wrong = f" ({self._mocap.problem})" if self._mocap.problem else ""
        body_id = self._settings.mocap.rigid_body_id
        return f"{self._mocap.where}: the guardian's client does not track rigid body {body_id}{wrong}"

    # -- take-over -------------------------------------------------------------------------------------------------

    def _take_over(self, last: Heartbeat, reason: str) -> bool:
        """Kill the flight process, open its link and land; return whether the vehicle has landed."""
        self._flight.kill()
        ipc.send(self._channel, TookOver(self._flight_hangs))
        gone = self._flight.wait(KILL_TIMEOUT_S)
        now_s = monotonic() - last.origin_s
        text = f"{reason}; the guardian has taken over" + (
            "" if gone else " (the flight process was killed but has not ended)"
        )
        self._publish(last, notice(now_s, "guardian_took_over", Severity.CRITICAL, text))
        link = self._open_link(last)
        if link is None:
            self._send_result(False, None)
            return False
        try:
            return self._land(last, link)
        finally:
            link.wire.close()

    def _open_link(self, last: Heartbeat) -> Link | None:
        """Open the flight process's link; try again while another process holds it. Return None after LINK_TIMEOUT_S."""
        deadline_s = monotonic() + LINK_TIMEOUT_S
        while True:
            try:
                wire = self._open_wire(last)
            except OSError as error:
                self._report_no_link(last, error.strerror or str(error))
            else:
                self._link_reported = False
                return Link(wire, (last.own_system, last.own_component), last.autopilot_system)
            if monotonic() > deadline_s:
                return None
            self._send_status()
            self._announce(last, last.position_world_m)
            simulated_time.wait(select.poll(), PERIOD_S, data=False)

    def _open_wire(self, last: Heartbeat) -> OpenWire:
        """Open the wire.

        A killed flight process that has not ended runs no code: it neither sends nor reads, so a UDP port is opened although it is
        still bound. A serial port or TCP link is opened only after the process has ended: if it resumed, two readers would share
        the bytes of a serial port.

        Raises:
            OSError: it cannot be opened now.
        """
        address = self._settings.autopilot_address
        share_port = not self._flight.wait(0.0)
        if share_port and not is_udp(address):
            raise OSError(errno.EBUSY, "the killed flight process still holds the link")
        return open_wire(address, last.local_port, last.peer, monotonic, share_port=share_port)

    def _report_no_link(self, last: Heartbeat, found: str) -> None:
        if not self._link_reported:
            self._link_reported = True
            text = f"autopilot {self._settings.autopilot_address}: {found}; trying again"
            now_s = monotonic() - last.origin_s
            self._publish(last, notice(now_s, "guardian_no_link", Severity.CRITICAL, text))

    def _restore_link(self, last: Heartbeat, link: Link, landing: TakeoverLanding, waiting: select.poll) -> None:
        """Close a lost link, because it would end every wait at once, and use it again once it is open again."""
        if not link.wire.lost:
            return
        if self._reopening is None:
            self._report_no_link(last, "the connection has ended")
            waiting.unregister(link.wire.fileno())
            link.wire.close()
            self._reopening = Reopening("px4 reopening", lambda: self._open_wire(last))
        elif (wire := self._reopening.take()) is not None:
            self._reopening, self._link_reported, link.wire = None, False, wire
            waiting.register(wire.fileno(), select.POLLIN)
            landing.link_reopened()

    def _land(self, last: Heartbeat, link: Link) -> bool:
        mocap = self._mocap
        waiting = select.poll()
        waiting.register(link.wire.fileno(), select.POLLIN)
        for opened in mocap.sockets if mocap is not None else ():
            waiting.register(opened.fileno(), select.POLLIN)
        landing = TakeoverLanding(
            last,
            self._settings.clearance_m,
            self._settings.tilt_max_rad,
            self._pose_filter,
            link,
            monotonic() - last.origin_s,
            lambda notice: self._publish(last, notice),
            external=self._external,
        )
        step_s = float("-inf")
        while landing.landed is None:
            simulated_time.wait(waiting, PERIOD_S, data=True)
            now_s = monotonic()
            t_s = now_s - last.origin_s
            with self._contain_errors(last, landing, "motion capture"):
                if mocap is not None:
                    landing.take_poses(mocap.poses(last.origin_s))
                    mocap.keep_connected()
            with self._contain_errors(last, landing, "PX4's messages"):
                landing.take_messages(t_s, link.receive())
                self._restore_link(last, link, landing, waiting)
            if now_s - step_s >= PERIOD_S:
                step_s = now_s
                with self._contain_errors(last, landing, "the landing"):
                    landing.step(t_s)
            self._send_status()
            self._announce(last, last.position_world_m if landing.pose is None else landing.pose.position_world_m)
        self._send_result(landing.landed, landing)
        return landing.landed

    @contextlib.contextmanager
    def _contain_errors(self, last: Heartbeat, landing: TakeoverLanding, what: str) -> Iterator[None]:
        """Report an exception and continue, because the guardian has no backup."""
        try:
            yield
        except Exception as error:
            t_s = monotonic() - last.origin_s
            text = f"an error in {what} ({type(error).__name__}: {error}); the landing continues"
            if text not in self._errors and len(self._errors) < ERRORS_REPORTED_MAX:
                self._errors.add(text)
                _log_line(traceback.format_exc())
                self._publish(last, notice(t_s, "guardian_error", Severity.CRITICAL, text[:ERROR_CHARS]))
            if what == "the landing":
                landing.restart(t_s)

    def _announce(self, last: Heartbeat, position_world_m: Vec3) -> None:
        """Tell the other vehicle of a team that PX4 lands this one, and that it will not lift the bar."""
        if self._team is not None:
            said = TeamState(grip=Grip.FREE, holds=True, lands=True, px4_lands=True, position_world_m=position_world_m)
            self._team.answers = last.partner_session
            self._team.announce(said, monotonic())

    def _send_status(self) -> None:
        """Send a status message to the launcher, twice a second."""
        now_s = monotonic()
        if now_s - self._status_s >= STATUS_PERIOD_S:
            self._status_s = now_s
            ipc.send(self._channel, GuardianStatus())

    def _publish(self, last: Heartbeat, event: Event) -> None:
        """Send an event to the launcher and to the log."""
        mission_t_s = last.mission_t_s + event.t_s - last.t_s if last.mission_t_s else 0.0
        ipc.send(self._channel, FlightEvent.of(event, last.tick, mission_t_s))
        _log_line(f"{event.t_s:.3f} {event.id}: {event.text}")
        if self._heartbeats.recorder is not None:
            packet = to_packet(LogLine(t_s=event.t_s, severity=event.severity, source=event.id, text=event.text))
            with contextlib.suppress(OSError):
                self._heartbeats.recorder.send(packet, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)

    def _send_result(self, landed: bool, landing: TakeoverLanding | None) -> None:
        ipc.send(self._channel, GuardianEnded(landed, landing is not None and landing.overturned))


def _log_line(text: str) -> None:
    """Write one line to guardian.log. If the disk is full, the line is lost and the landing continues."""
    with contextlib.suppress(OSError):
        os.write(2, text.encode() + b"\n")  # unbuffered, so that a failed write is not tried again at exit


def main(argv: list[str] | None = None) -> int:
    """Parse the arguments and run the guardian; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="companion.guardian", description="Lands the vehicle when the flight process cannot."
    )
    parser.add_argument("--config", type=Path, required=True, help="effective configuration, JSON")
    parser.add_argument("--heartbeats", type=int, required=True, help="socket to the flight process")
    parser.add_argument("--channel", type=int, required=True, help="socket to the launcher")
    parser.add_argument("--pidfd", type=int, required=True, help="pidfd of the flight process")
    parser.add_argument("--time", help="page and channel of simulated time")
    arguments = parser.parse_args(argv)
    if arguments.time is not None:
        simulated_time.enter(arguments.time)
    for number in (signal.SIGINT, signal.SIGHUP):  # the flight lands on them; the guardian ends after it
        signal.signal(number, signal.SIG_IGN)
    settings = read_settings(arguments.config)
    with socket.socket(fileno=arguments.heartbeats) as heartbeats, socket.socket(fileno=arguments.channel) as channel:
        if simulated_time.current() is None:
            claim_realtime(GUARDIAN_PRIORITY)
        return Guardian(settings, HeartbeatReceiver(heartbeats), channel, FlightProcess(arguments.pidfd)).run()
