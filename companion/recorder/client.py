"""The flight process's side of the recorder: a bounded channel that never waits, and the recorder process's life cycle.

The recorder uses the same channel to report a full disk, commands from the ground and the state of its telemetry.

The channel is a Unix SOCK_SEQPACKET pair; its packets are `companion.model.packets`. If the channel is
full the packet is dropped and counted. If the recorder is dead every packet is counted as dropped and the flight continues. If the
flight process is killed, its packets are still in the socket: the recorder writes them, closes the log and exits.
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
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.io.protocols import DeviceError
from companion.model.codec import to_packet
from companion.model.commands import COMMANDS
from companion.model.outputs import Outputs, Sent
from companion.model.packets import Close, CommandAnswer, LogLine, Metadata, Packet, Tick
from companion.model.types import GroundCommand, Inputs, Severity
from companion.runtime import simulated_time
from companion.runtime.subprocesses import JsonLines

_BUFFER_BYTES = 8 * 2**20
_MESSAGE_MAX_BYTES = 4096
_MESSAGES_PER_TICK = 16
"""Maximum number of messages read in a tick; the rest are read in the next one."""
_SO_SNDBUFFORCE = 32
_ROOM_TIMEOUT_S = 2.0
"""Longest wait for a recorder whose channel is full, in simulated time only."""


class RecorderClient:
    """Sends ticks, texts and metadata to the recorder; no call waits, and none raises when the recorder fails.

    Attributes:
        samples: ticks sent.
        dropped: packets that did not fit into the channel, or found no recorder.
        error: why recording stopped (a full disk or a dead recorder), or None.
        telemetry_status: state of the telemetry (`connected to mqtt://...`), or None if the recorder has not reported it.
    """

    def __init__(self, channel: socket.socket | int) -> None:
        self._socket = channel if isinstance(channel, socket.socket) else socket.socket(fileno=channel)
        self._socket.setblocking(False)
        _enlarge(self._socket)
        self._offered = 0
        self.gone = False
        """Whether the recorder process has ended."""
        self.samples = 0
        self.dropped = 0
        self.error: str | None = None
        self.telemetry_status: str | None = None
        self._commands: list[GroundCommand] = []

    def record(self, inputs: Inputs, outputs: Outputs, sent: Sent) -> bool:
        """Send one tick, then read the recorder's messages. Return False if the tick was dropped (and counted)."""
        taken = self._send(Tick(number=self._offered, inputs=inputs, outputs=outputs, sent=sent))
        self.samples += taken
        try:
            data = self._socket.recv(_MESSAGE_MAX_BYTES)
        except OSError:  # usually no message; a dead recorder is detected by sending
            return taken
        self._read_messages(data)
        return taken

    def take_commands(self) -> list[GroundCommand]:
        """Return the commands since the last call, in order. The recorder has verified each: signature, age, session and nonce."""
        commands = self._commands
        if commands:
            self._commands = []
        return commands

    def ack(self, asked: GroundCommand, accepted: bool, text: str, after: Outputs) -> bool:
        """Send the result of a command.

        Args:
            accepted: the command took effect, or the requested state was reached before.
            text: what was done, or why the command was refused.
            after: outputs of the tick that handled it.
        """
        answer = CommandAnswer(
            number=self._offered, nonce=asked.nonce, operator=asked.operator, command=asked.command, accepted=accepted, text=text,
            t_s=after.t_s, phase=after.phase, action=after.action,
        )  # fmt: skip
        return self._send(answer)

    def text(self, t_s: float, severity: Severity, source: str, text: str) -> bool:
        """Write a line to the log's `/log` channel; `t_s` is the flight clock."""
        return self._send(LogLine(number=self._offered, t_s=t_s, severity=severity, source=source, text=text))

    def metadata(self, name: str, values: Mapping[str, str]) -> bool:
        """Write a metadata record whose values become known only during the flight (autopilot version, parameters, ...)."""
        return self._send(Metadata(self._offered, name, dict(values)))

    def fileno(self) -> int:
        """Return the socket's descriptor, for callers that may wait until it is writable (the flight may not)."""
        return self._socket.fileno()

    def close(self) -> None:
        """End the log: the recorder writes the packets that it has received and closes the file."""
        if not self.gone:
            self._send(Close(self._offered))
        self.gone = True
        self._socket.close()

    def _send(self, packet: Packet) -> bool:
        self._offered += 1
        if not self.gone:
            try:
                data = to_packet(packet)
                try:
                    self._socket.send(data)
                except BlockingIOError:  # full
                    if simulated_time.current() is None:
                        raise
                    select.select((), (self._socket,), (), _ROOM_TIMEOUT_S)  # time stands meanwhile
                    self._socket.send(data)
                return True
            except BlockingIOError:
                pass
            except (ValueError, TypeError, OverflowError) as error:  # a value that no record may hold
                self.error = f"recorder: a record could not be packed: {error}"
            except OSError as error:
                if isinstance(error, (BrokenPipeError, ConnectionError)):
                    self.gone = True
                    self.error = self.error or "recorder: the recorder process has ended; recording has stopped"
        self.dropped += 1
        return False

    def _read_messages(self, data: bytes) -> None:
        """Handle a message and all that wait behind it; empty bytes mean that the channel has ended."""
        left = _MESSAGES_PER_TICK
        with contextlib.suppress(OSError):
            while data:
                self._handle(data)
                left -= 1
                if not left:
                    return
                data = self._socket.recv(_MESSAGE_MAX_BYTES)

    def _handle(self, data: bytes) -> None:
        try:
            message = json.loads(data)
        except (ValueError, RecursionError):
            return
        match message:
            case {"error": str(error)}:
                self.error = error
            case {
                "command": str(name),
                "operator": str(who),
                "nonce": str(nonce),
                "hold": int(hold),
                "t_s": float(t_s),
            } if name in COMMANDS:
                asked = GroundCommand(command=COMMANDS[name], operator=who, nonce=nonce, hold=hold, t_s=t_s)
                self._commands.append(asked)
            case {"ground": str(text)}:
                self.telemetry_status = text


@dataclass(frozen=True, slots=True)
class RecorderReport:
    """Final report of the recorder."""

    samples: int
    """Ticks in the log."""
    dropped: int
    """Packets that were sent but are not in the log."""
    error: str | None


class RecorderProcess:
    """A running recorder process and its client.

    Args of `start`:
        path: the log to write; must not exist.
        config_json: effective configuration, stored unchanged.
        epoch_offset_ns: wall clock (ns since 1970) when the flight clock was zero; see `epoch_offset_ns`.
        metadata: further key-value pairs of the log's `flight` metadata record (controller, mission, ...).
        simulated: whether the devices are simulated; ground stations show this.
    """

    def __init__(self, process: subprocess.Popen[bytes], client: RecorderClient, path: Path) -> None:
        self.process = process
        self.client = client
        self.path = path
        assert process.stdout is not None
        self._lines = JsonLines(process.stdout.fileno())
        self._report: RecorderReport | None = None

    @classmethod
    def start(
        cls,
        path: Path,
        *,
        config_json: str,
        epoch_offset_ns: int,
        metadata: Mapping[str, str] | None = None,
        simulated: bool = False,
        deadline_s: float = 15.0,
    ) -> RecorderProcess:
        """Start the process and wait until the log is open. Blocks for about 0.3 s; do not call it in a control tick.

        Raises:
            DeviceError: the log cannot be opened, or the process is not ready within the deadline.
        """
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        config_fd = os.memfd_create("config")
        try:
            with os.fdopen(os.dup(config_fd), "w", encoding="utf-8") as config:
                config.write(config_json)
            os.lseek(config_fd, 0, os.SEEK_SET)
            process = subprocess.Popen(
                [
                    *(sys.executable, "-P", "-m", "companion.recorder.main"),
                    *("--fd", str(theirs.fileno()), "--out", str(path), "--config", str(config_fd)),
                    *("--epoch-offset-ns", str(epoch_offset_ns), "--metadata", json.dumps(dict(metadata or {}))),
                    *(("--simulated",) if simulated else ()),
                ],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                pass_fds=(theirs.fileno(), config_fd),
                # Ctrl-C in the terminal is meant for the flight process only; the recorder ends when the flight ends.
                process_group=0,
            )
        except BaseException:
            ours.close()
            raise
        finally:
            theirs.close()
            os.close(config_fd)
        recorder = cls(process, RecorderClient(ours), path)
        try:
            answer = recorder._answer(time.monotonic() + deadline_s)
            if answer is None or not answer.get("ready"):
                reason = (answer or {}).get("error") or f"recorder: {path}: not ready within {deadline_s:g} s"
                raise DeviceError(str(reason))
        except BaseException:
            recorder._end()
            raise
        return recorder

    def finish(self, deadline_s: float = 10.0) -> RecorderReport:
        """Close the channel and wait for the log to be closed. Blocks: from asyncio, call it in a thread. Never raises; a second
        call returns the same report.

        A recorder that has not finished at the deadline is killed; the log then lacks only its summary.
        """
        if self._report is None:
            self.client.close()
            answer = self._answer(time.monotonic() + deadline_s)
            code = self._end()
            if answer is None:
                reason = self.client.error or f"recorder: {self.path}: ended without a report (exit code {code})"
                self._report = RecorderReport(self.client.samples, self.client.dropped, reason)
            else:
                self._report = RecorderReport(int(answer["samples"]), int(answer["dropped"]), answer["error"])
        return self._report

    def _answer(self, deadline_s: float) -> dict[str, Any] | None:
        """Return the next JSON line of the process, or None if it ended or the deadline passed."""
        return next(self._lines.read(deadline_s), None)

    def _end(self) -> int:
        self.client.close()
        try:
            code = self.process.wait(2.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            code = self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()
        return code


def epoch_offset_ns(flight_clock_s: float) -> int:
    """Return the Unix time (ns) at which the flight clock was zero. `flight_clock_s` is its current reading. In simulated time the
    flight clock starts when the flight begins, which is about now.
    """
    return time.time_ns() - (round(flight_clock_s * 1e9) if simulated_time.current() is None else 0)


def _enlarge(channel: socket.socket) -> None:
    """Request a send buffer for a few seconds of ticks; the kernel limits it for users without CAP_NET_ADMIN."""
    try:
        channel.setsockopt(socket.SOL_SOCKET, _SO_SNDBUFFORCE, _BUFFER_BYTES)
    except OSError:
        channel.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
