"""The flight process's side of the recorder: a bounded channel that never waits, and the recorder process's life.

On the same channel the recorder tells what it hears: that the disk is full, commands from the ground, how its telemetry is.

The channel is a Unix SOCK_SEQPACKET pair; packets are `marshal` data of one interpreter (`companion.model.codec`). When it is full the
packet is dropped and counted. When the recorder is dead everything is counted as dropped and the flight goes on. When the flight
is killed, what it had sent is still in the socket: the recorder writes it, closes the log and exits.
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
from companion.model.codec import pack_plain, plain
from companion.model.types import GroundCommand, Inputs, OperatorCommand, Outputs, SafetyAction, Sent, Severity
from companion.runtime.packets import ACK, CLOSE, METADATA, TEXT, TICK

_BUFFER_BYTES = 8 * 2**20
_HEARD_MAX_BYTES = 4096
_HEARD_PER_TICK = 16
"""More at once waits for the next tick."""
_COMMANDS = {command.value: command for command in OperatorCommand if command is not OperatorCommand.NONE}
_SO_SNDBUFFORCE = 32


class RecorderClient:
    """Sends ticks, texts and metadata to the recorder; no call waits or raises because of it.

    Attributes:
        samples: ticks handed over.
        dropped: packets that did not fit into the channel or found no recorder.
        error: why recording stopped, in the recorder's words (a full disk, a dead recorder), or None.
        ground: how its telemetry is, in the recorder's words (`connected to mqtt://...`), or None: it has not said.
    """

    def __init__(self, channel: socket.socket | int) -> None:
        self._socket = channel if isinstance(channel, socket.socket) else socket.socket(fileno=channel)
        self._socket.setblocking(False)
        _enlarge(self._socket)
        self._offered = 0
        self._dead = False
        self.samples = 0
        self.dropped = 0
        self.error: str | None = None
        self.ground: str | None = None
        self._commands: list[GroundCommand] = []

    def record(self, inputs: Inputs, outputs: Outputs, sent: Sent) -> bool:
        """Hand one tick over, and hear what the recorder has to say. False: the tick was dropped (and counted)."""
        taken = self._send((TICK, self._offered, plain(inputs), plain(outputs), plain(sent)))
        self.samples += taken
        try:
            heard = self._socket.recv(_HEARD_MAX_BYTES)
        except OSError:  # nothing, nearly always; or nobody, which sending finds out
            return taken
        self._hear(heard)
        return taken

    @property
    def gone(self) -> bool:
        """There is no recorder process any more."""
        return self._dead

    def take_commands(self) -> list[GroundCommand]:
        """Commands that have come since the last call, in their order: signed, fresh, for this flight, all of it verified."""
        commands = self._commands
        if commands:
            self._commands = []
        return commands

    def ack(
        self,
        nonce: str,
        operator: str,
        command: OperatorCommand,
        accepted: bool,
        text: str,
        t_s: float,
        phase: str,
        action: SafetyAction,
    ) -> bool:
        """What came of a command.

        Args:
            nonce, operator, command: of the command, as `take_commands` gave it.
            accepted: it did something, or what it asks for is done already.
            text: what was done, or why nothing was.
            t_s: flight clock of the tick in which it was judged.
            phase, action: of that tick's `Outputs`.
        """
        what = (nonce, operator, command.value, accepted, text, t_s, phase, action.value)
        return self._send((ACK, self._offered, *what))

    def text(self, t_s: float, severity: Severity, source: str, text: str) -> bool:
        """A line for people in the log's `/log` channel; `t_s` on the flight clock."""
        return self._send((TEXT, self._offered, t_s, severity.value, source, text))

    def metadata(self, name: str, values: Mapping[str, str]) -> bool:
        """A metadata record for what becomes known only during the flight (autopilot version, parameters, ...)."""
        return self._send((METADATA, self._offered, name, dict(values)))

    def fileno(self) -> int:
        """The socket, for those who may wait until it is writable (a flight may not)."""
        return self._socket.fileno()

    def close(self) -> None:
        """End of the log: the recorder writes what is under way and closes the file."""
        if not self._dead:
            self._send((CLOSE, self._offered))
        self._dead = True
        self._socket.close()

    def _send(self, packet: tuple[Any, ...]) -> bool:
        self._offered += 1
        if not self._dead:
            try:
                self._socket.send(pack_plain(packet))
                return True
            except BlockingIOError:
                pass  # full
            except ValueError as error:  # marshal: a value that is no plain data
                self.error = f"recorder: a record could not be packed: {error}"
            except OSError as error:
                if isinstance(error, (BrokenPipeError, ConnectionError)):
                    self._dead = True
                    self.error = self.error or "recorder: the recorder process is gone; nothing more is recorded"
        self.dropped += 1
        return False

    def _hear(self, heard: bytes) -> None:
        """A message, and those right behind it; no bytes: the end."""
        left = _HEARD_PER_TICK
        with contextlib.suppress(OSError):
            while heard:
                self._take(heard)
                left -= 1
                if not left:
                    return
                heard = self._socket.recv(_HEARD_MAX_BYTES)

    def _take(self, heard: bytes) -> None:
        try:
            message = json.loads(heard)
        except (ValueError, RecursionError):
            return
        match message:
            case {"error": str(error)}:
                self.error = error
            case {"command": str(name), "operator": str(operator), "nonce": str(nonce), "hold": int(hold)} if (
                name in _COMMANDS
            ):
                self._commands.append(GroundCommand(_COMMANDS[name], operator, nonce, hold))
            case {"ground": str(text)}:
                self.ground = text


@dataclass(frozen=True, slots=True)
class RecorderReport:
    """What the recorder says at its end."""

    samples: int
    """Ticks in the log."""
    dropped: int
    """Packets that were offered and are not in the log."""
    error: str | None


class RecorderProcess:
    """A running recorder process and the client that feeds it.

    Args of `start`:
        path: the log to write; must not exist yet.
        config_json: effective configuration, stored as it is.
        epoch_offset_ns: wall clock (ns since 1970) at zero of the flight clock; see `epoch_offset_ns`.
        metadata: more key-value pairs for the log's `flight` metadata record (controller, mission, ...).
        simulated: the devices are those of the simulated world; ground stations are told.
    """

    def __init__(self, process: subprocess.Popen[bytes], client: RecorderClient, path: Path) -> None:
        self.process = process
        self.client = client
        self.path = path
        self._output = b""
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
        """Start it and wait until the log is open. Blocks for some 0.3 s: not for the control tick.

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
                    *(sys.executable, "-m", "companion.recorder.main"),
                    *("--fd", str(theirs.fileno()), "--out", str(path), "--config", str(config_fd)),
                    *("--epoch-offset-ns", str(epoch_offset_ns), "--metadata", json.dumps(dict(metadata or {}))),
                    *(("--simulated",) if simulated else ()),
                ],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                pass_fds=(theirs.fileno(), config_fd),
                # Ctrl-C on the terminal is for the flight alone; the recorder ends when the flight does.
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
            recorder._abandon()
            raise
        return recorder

    def finish(self, deadline_s: float = 10.0) -> RecorderReport:
        """Close the channel and wait for the log to be closed. Blocks: use a thread from asyncio. Never raises; a second
        call returns the same report.

        A recorder that is not done within the deadline is killed; the log then lacks its summary only.
        """
        if self._report is None:
            self.client.close()
            answer = self._answer(time.monotonic() + deadline_s)
            code = self._abandon()
            if answer is None:
                reason = self.client.error or f"recorder: {self.path}: ended without a report (exit code {code})"
                self._report = RecorderReport(self.client.samples, self.client.dropped, reason)
            else:
                self._report = RecorderReport(int(answer["samples"]), int(answer["dropped"]), answer["error"])
        return self._report

    def _answer(self, deadline_s: float) -> dict[str, Any] | None:
        """The next JSON line of the process; None if it ended or the deadline passed without one."""
        assert self.process.stdout is not None
        fd = self.process.stdout.fileno()
        while b"\n" not in self._output:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0 or not select.select([fd], [], [], left_s)[0]:
                return None
            data = os.read(fd, 65536)
            if not data:
                return None
            self._output += data
        line, _, self._output = self._output.partition(b"\n")
        try:
            answer = json.loads(line)
        except ValueError:
            return None
        return answer if isinstance(answer, dict) else None

    def _abandon(self) -> int:
        """Make sure that the process is gone; its exit code."""
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
    """Wall clock (ns since 1970) at zero of a flight clock that reads `flight_clock_s` now."""
    return time.time_ns() - round(flight_clock_s * 1e9)


def _enlarge(channel: socket.socket) -> None:
    """Ask for a send buffer of some seconds; the kernel caps it for users without CAP_NET_ADMIN."""
    try:
        channel.setsockopt(socket.SOL_SOCKET, _SO_SNDBUFFORCE, _BUFFER_BYTES)
    except OSError:
        channel.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
