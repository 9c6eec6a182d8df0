"""The guardian process: stands by the flight process, and takes over when that hangs or dies while the rotors turn.

Started by the launcher as `python -m companion.guardian --config FILE --beats FD --channel FD --pidfd FD`. Exit code 0: not needed, or
landed; 1: the vehicle is lost.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import os
import select
import signal
import socket
import time
import traceback
from collections.abc import Iterator
from pathlib import Path

from companion.guardian import heartbeat as words
from companion.guardian.heartbeat import Beat
from companion.guardian.link import Link, Wire, address_problem, is_udp, open_wire
from companion.guardian.mocap import MocapClient, MocapProblem
from companion.guardian.monitors import StallWatch
from companion.guardian.settings import Settings, read_settings
from companion.guardian.takeover_landing import Charge, Told
from companion.model.codec import pack_plain
from companion.model.types import SafetyAction, Severity
from companion.runtime import ipc
from companion.runtime.packets import TEXT, UNNUMBERED
from companion.runtime.realtime import GUARDIAN_PRIORITY, claim_realtime

PERIOD_S = 0.01
MOCAP_FRESH_S = 0.5
KILL_TIMEOUT_S = 0.5
"""A killed process ends within milliseconds, unless one of its threads sleeps uninterruptibly in the kernel (state D)."""
LINK_TIMEOUT_S = 30.0
"""A link that cannot be opened for this long is given up, and the vehicle with it."""
REOPEN_PERIOD_S = 0.5
"""Pause before a link that ended (TCP closed, serial port unplugged) is opened again."""
STATUS_PERIOD_S = 0.5
ERROR_CHARS, ERRORS_TOLD_MAX = 300, 20
_MAX_BEATS = 512


class FlightProcess:
    """The flight process, held by its pidfd: no other process can be mistaken for it."""

    def __init__(self, pidfd: int) -> None:
        self.pidfd = pidfd
        self._poll = select.poll()
        self._poll.register(pidfd, select.POLLIN)

    def wait(self, timeout_s: float) -> bool:
        """Whether it is dead, after `timeout_s` at the latest. Dead means that its sockets are closed."""
        return bool(self._poll.poll(max(0, round(timeout_s * 1e3))))

    def kill(self) -> None:
        """SIGKILL: the only signal that ends a process that hangs in any way."""
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self.pidfd, signal.SIGKILL)


class Beats:
    """The guardian's end of the socket to the flight process."""

    def __init__(self, channel: socket.socket) -> None:
        channel.setblocking(False)
        self._channel = channel
        self.last: Beat | None = None
        self.count = self.missed = 0
        """Beats heard, and ticks of the flight in between that were not."""
        self.recorder: socket.socket | None = None
        """The recorder's channel, once the flight process has shared it."""

    def listen(self) -> bool:
        """Read everything that waits; True: a beat was among it."""
        heard = False
        for _ in range(_MAX_BEATS):
            try:
                datagram, descriptors, _, _ = socket.recv_fds(self._channel, words.MAX_BYTES, 1)
            except OSError:  # nothing more, or the flight process is gone: its pidfd tells
                break
            if not datagram:
                break
            for descriptor in descriptors:
                if datagram[:1] == words.ADOPT and self.recorder is None:
                    self.recorder = socket.socket(fileno=descriptor)
                else:
                    os.close(descriptor)
            beat = words.unpack(datagram)
            if beat is not None:
                if self.last is not None:
                    self.missed += max(0, beat.tick - self.last.tick - 1)
                self.count += 1
                self.last, heard = beat, True
        return heard

    def tell(self, problem: str | None) -> None:
        """Say that the guardian stands ready, or why not; never waits."""
        text = words.READY if problem is None else words.PROBLEM + problem.encode()[: words.MAX_BYTES - 1]
        with contextlib.suppress(OSError):
            self._channel.send(text, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)


class Guardian:
    """Standby, take-over, landing."""

    def __init__(self, settings: Settings, beats: Beats, channel: socket.socket, flight: FlightProcess) -> None:
        self._settings = settings
        self._beats = beats
        self._channel = channel
        self._flight = flight
        self._mocap: MocapClient | None = None
        self._problem = address_problem(settings.autopilot_address)
        self._status_s = float("-inf")
        self._errors: set[str] = set()
        """Errors of its own that have been told."""
        self._no_link = False
        """The link is not open, and that has been reported."""
        self._reopen_s = float("-inf")
        """When a link that ended may be opened again, by `time.monotonic`."""
        self._silent_s = 0.0
        """Longest silence while the rotors may lift."""

    def run(self) -> int:
        """Until the flight has ended, one way or the other; the exit code."""
        try:
            try:
                self._mocap = MocapClient(self._settings.mocap)
            except MocapProblem as problem:
                self._problem = self._problem or str(problem)
            reason = self._stand_by()
            if reason is None or self._beats.last is None:
                return 0
            return 0 if self._take_over(self._beats.last, reason) else 1
        finally:
            beats, silent_ms = self._beats, self._silent_s * 1e3
            _say(f"heard {beats.count} beats, {beats.missed} missed, silent for {silent_ms:.0f} ms at most in the air")
            if self._mocap is not None:
                self._mocap.close()
            if self._beats.recorder is not None:
                self._beats.recorder.close()

    # -- standby ---------------------------------------------------------------------------------------------------

    def _stand_by(self) -> str | None:
        """Why the guardian must take over; None: it need not."""
        watch = StallWatch(self._settings.timeout_s)
        told_s = float("-inf")
        while True:
            dead = self._flight.wait(PERIOD_S)
            now_s = time.monotonic()
            heard = self._beats.listen()
            last = self._beats.last
            if self._mocap is not None:
                self._mocap.serve(now_s)
                self._mocap.glance(now_s)
            if last is not None and last.goodbye:
                return None
            lifting = last is not None and last.lifting
            if dead:
                return "the flight process died" if lifting else None
            hangs = watch.update(now_s, heard or not lifting)
            self._silent_s = max(self._silent_s, watch.silent_s)
            if hangs:
                return f"{words.HANGS} (silent for {watch.silent_s * 1e3:.0f} ms)"
            if now_s - told_s >= words.READY_PERIOD_S:
                told_s = now_s
                self._beats.tell(self._trouble(now_s, last))

    def _trouble(self, now_s: float, last: Beat | None) -> str | None:
        """Why the guardian could not land the vehicle now, or not as well as the flight process.

        In the air nothing is wrong with a guardian that sees no motion capture as long as the flight process sees none either: it would
        land without, as the flight process does.
        """
        if self._problem is not None or self._mocap is None:
            return self._problem
        if now_s - self._mocap.tracked_s <= MOCAP_FRESH_S:
            return None
        if last is not None and last.lifting and now_s - last.origin_s - last.pose_stamp_s > MOCAP_FRESH_S:
            return None
        mocap = self._settings.mocap
        wrong = f" ({self._mocap.trouble})" if self._mocap.trouble else ""
        return f"mocap {mocap.server}:{mocap.command_port}: the guardian's own client sees no rigid body {mocap.rigid_body_id}{wrong}"

    # -- take-over -------------------------------------------------------------------------------------------------

    def _take_over(self, last: Beat, reason: str) -> bool:
        """Kill, take the link, land; True: the vehicle stands."""
        self._flight.kill()
        gone = self._flight.wait(KILL_TIMEOUT_S)
        now_s = time.monotonic() - last.origin_s
        text = f"{reason}; the guardian has taken over" + ("" if gone else ", though that was killed and has not ended")
        self._tell(last, Told(now_s, "guardian_took_over", Severity.CRITICAL, SafetyAction.AUTOPILOT_LAND, text))
        link = self._open_link(last)
        if link is None:
            self._result(last, False, None)
            return False
        try:
            return self._land(last, link)
        finally:
            link.wire.close()

    def _open_link(self, last: Beat) -> Link | None:
        """The flight process's link; tried again while something still holds it. None: not free within LINK_TIMEOUT_S."""
        deadline_s = time.monotonic() + LINK_TIMEOUT_S
        while True:
            wire = self._try_wire(last)
            if wire is not None:
                return Link(wire, (last.own_system, last.own_component), last.autopilot_system)
            if time.monotonic() > deadline_s:
                return None
            self._sign_of_life(0)
            time.sleep(PERIOD_S)

    def _try_wire(self, last: Beat) -> Wire | None:
        """Open the wire. The first failure is reported.

        A killed flight process that has not ended runs no more code of its own, so it neither sends nor reads, and a UDP link is opened
        beside it. Not a serial port, of which two readers share out the bytes should it come back to life in the kernel, nor TCP.
        """
        address = self._settings.autopilot_address
        try:
            beside = not self._flight.wait(0.0)
            if beside and not is_udp(address):
                raise OSError(errno.EBUSY, "the killed flight process still holds it")
            wire = open_wire(address, last.local_port, last.peer, beside=beside)
        except OSError as error:
            self._report_no_link(last, error.strerror or str(error))
            return None
        self._no_link = False
        return wire

    def _report_no_link(self, last: Beat, found: str) -> None:
        if not self._no_link:
            self._no_link = True
            text = f"autopilot {self._settings.autopilot_address}: {found}; trying again"
            now_s = time.monotonic() - last.origin_s
            self._tell(last, Told(now_s, "guardian_no_link", Severity.CRITICAL, SafetyAction.AUTOPILOT_LAND, text))

    def _mend_link(self, last: Beat, link: Link, charge: Charge, waiting: select.poll) -> None:
        """Close a link that has ended, so that it wakes no wait, and open it again every REOPEN_PERIOD_S."""
        now_s = time.monotonic()
        if not link.wire.lost or now_s < self._reopen_s:
            return
        self._reopen_s = now_s + REOPEN_PERIOD_S
        if not self._no_link:
            self._report_no_link(last, "the connection has ended")
            waiting.unregister(link.wire.fileno())
            link.wire.close()
            return
        wire = self._try_wire(last)
        if wire is not None:
            link.wire = wire
            waiting.register(wire.fileno(), select.POLLIN)
            charge.link_reopened()

    def _land(self, last: Beat, link: Link) -> bool:
        mocap = self._mocap
        waiting = select.poll()
        waiting.register(link.wire.fileno(), select.POLLIN)
        for opened in mocap.sockets if mocap is not None else ():
            waiting.register(opened.fileno(), select.POLLIN)
        charge = Charge(
            last,
            self._settings.clearance_m,
            self._settings.tilt_max_rad,
            link,
            time.monotonic() - last.origin_s,
            lambda told: self._tell(last, told),
        )
        step_s = float("-inf")
        while charge.landed is None:
            waiting.poll(PERIOD_S * 1e3)
            now_s = time.monotonic()
            t_s = now_s - last.origin_s
            with self._surviving(last, charge, "motion capture"):
                if mocap is not None:
                    charge.take_poses(mocap.poses(now_s, last.origin_s))
                    mocap.serve(now_s)
            with self._surviving(last, charge, "PX4's messages"):
                charge.take_messages(t_s, link.receive())
                self._mend_link(last, link, charge, waiting)
            if now_s - step_s >= PERIOD_S:
                step_s = now_s
                with self._surviving(last, charge, "the landing"):
                    charge.step(t_s)
            self._sign_of_life(link.poses_sent)
        self._result(last, charge.landed, charge)
        return charge.landed

    @contextlib.contextmanager
    def _surviving(self, last: Beat, charge: Charge, what: str) -> Iterator[None]:
        """Nobody stands behind the guardian: an error of its own is told, and costs no more than what it broke."""
        try:
            yield
        except Exception as error:
            t_s = time.monotonic() - last.origin_s
            text = f"an error in {what} ({type(error).__name__}: {error}); the landing goes on"
            if text not in self._errors and len(self._errors) < ERRORS_TOLD_MAX:
                self._errors.add(text)
                _say(traceback.format_exc())
                self._tell(
                    last,
                    Told(t_s, "guardian_error", Severity.CRITICAL, SafetyAction.AUTOPILOT_LAND, text[:ERROR_CHARS]),
                )
            if what == "the landing":
                charge.begin_again(t_s)

    def _sign_of_life(self, poses_sent: int) -> None:
        """To the launcher, twice a second."""
        now_s = time.monotonic()
        if now_s - self._status_s >= STATUS_PERIOD_S:
            self._status_s = now_s
            ipc.send(self._channel, {"type": "guardian_status", "poses_sent": poses_sent})

    def _tell(self, last: Beat, told: Told) -> None:
        """To the launcher and into the log."""
        mission_t_s = last.mission_t_s + told.t_s - last.t_s if last.mission_t_s else 0.0
        message = {
            "type": "event",
            "source": "guardian",
            "tick": last.tick,
            "t_s": mission_t_s,
            "flight_t_s": told.t_s,
            "id": told.id,
            "severity": told.severity.value,
            "action": told.action.value,
            "text": told.text,
        }
        ipc.send(self._channel, message)
        _say(f"{told.t_s:.3f} {told.id}: {told.text}")
        if self._beats.recorder is not None:
            packet = pack_plain((TEXT, UNNUMBERED, told.t_s, told.severity.value, told.id, told.text))
            with contextlib.suppress(OSError):
                self._beats.recorder.send(packet, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)

    def _result(self, last: Beat, landed: bool, charge: Charge | None) -> None:
        pose = charge.pose if charge is not None else None
        message = {
            "type": "guardian_result",
            "landed": landed,
            "overturned": charge is not None and charge.overturned,
            "took_over_position_m": list(last.position_world_m),
            "position_m": None if pose is None else list(pose.position_world_m),
        }
        ipc.send(self._channel, message)


def _say(text: str) -> None:
    """One line of guardian.log; a full disk under it costs the line, not the landing."""
    with contextlib.suppress(OSError):
        os.write(2, text.encode() + b"\n")  # unbuffered: what cannot be written must not be tried again at the end


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(prog="companion.guardian", description="Lands when the flight process cannot.")
    parser.add_argument("--config", type=Path, required=True, help="effective configuration, JSON")
    parser.add_argument("--beats", type=int, required=True, help="socket to the flight process")
    parser.add_argument("--channel", type=int, required=True, help="socket to the launcher")
    parser.add_argument("--pidfd", type=int, required=True, help="of the flight process")
    arguments = parser.parse_args(argv)
    for number in (signal.SIGINT, signal.SIGHUP):  # for the flight, which lands; the guardian ends when the flight does
        signal.signal(number, signal.SIG_IGN)
    settings = read_settings(arguments.config)
    with socket.socket(fileno=arguments.beats) as beats, socket.socket(fileno=arguments.channel) as channel:
        claim_realtime(GUARDIAN_PRIORITY)
        return Guardian(settings, Beats(beats), channel, FlightProcess(arguments.pidfd)).run()
