"""Link to QGroundControl or any other MAVLink ground station: forwards MAVLink between it and PX4.

The driver of PX4 forwards frames to and from a process on loopback (`companion.io.qgroundcontrol.relay`) that blocks what a ground
station must not send and also sends the companion's own texts. A call here costs the
control tick one send on a local socket.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import re
import socket
import subprocess
import sys
from typing import Any, Protocol, Self

from companion.io.protocols import DeviceError
from companion.io.qgroundcontrol import texts as words
from companion.io.qgroundcontrol.channel import pack, unpack
from companion.model.outputs import Outputs
from companion.model.types import AutopilotRequest, Inputs, LinkIdentity

VALUES_EVERY = 50
"""Number of ticks between two sets of values: 4 Hz at a control rate of 200 Hz."""
_FORM = "udpout://HOST:14550"
_ADDRESS = re.compile(r"udpout://(?P<host>\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+):(?P<port>\d{1,5})")
_RESOLVE_DEADLINE_S = 5.0
_START_DEADLINE_S = 10.0
_END_DEADLINE_S = 2.0
_MESSAGES_PER_CALL = 8
_TEXT_MAX = 400
"""Largest length of a line from the relay; the rest is truncated."""


class Forwarder(Protocol):
    """The part of the autopilot driver that a ground station needs."""

    def identity(self) -> LinkIdentity:
        """Return the ids of both ends of the link to PX4."""

    def forward_to(self, port: int) -> int:
        """Forward MAVLink between PX4 and a UDP port of 127.0.0.1; return the port from which it is sent."""


def ground_error(address: str, expected: str, found: str, fix: str) -> DeviceError:
    """Return the error as one line for the user."""
    return DeviceError(f"ground.qgroundcontrol {address}: expected {expected}, found {found}; {fix}")


def check_address(address: str) -> tuple[str, int]:
    """Return host, without brackets, and port.

    Raises:
        DeviceError: the address is invalid.
    """
    match = _ADDRESS.fullmatch(address)
    if match is None:
        raise ground_error(address, f"an address like {_FORM}", "something else", "correct it, or leave it out")
    port = int(match["port"])
    if not 0 < port <= 65535:
        raise ground_error(address, "a port from 1 to 65535", str(port), "QGroundControl listens on 14550")
    return match["host"].strip("[]"), port


class GroundStation:
    """Driver of the link. Enter it after the autopilot's driver, which must have been made with `forwarding`, and leave it before
    that driver.

    Args:
        address: `udpout://HOST:PORT`.
        while_armed: as `ground.qgroundcontrol_while_armed`.
        console: as `ground.qgroundcontrol_console`.
    """

    def __init__(self, address: str, autopilot: Forwarder, *, while_armed: bool = False, console: bool = False) -> None:
        self.address = address
        self._while_armed, self._console = while_armed, console
        self._autopilot = autopilot
        self._channel: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._phase: str | None = None
        self._messages: list[str] = []
        self.vehicle_port = 0
        """UDP port on loopback from which frames are forwarded; 0 if it is not open."""

    @property
    def relay_pid(self) -> int | None:
        """Return the relay's process id."""
        return self._process.pid if self._process is not None else None

    @property
    def line(self) -> str:
        """Return one line about the open link for the operator."""
        when = " even in flight," if self._while_armed else " while it is disarmed,"
        return (
            f"MAVLink is forwarded to and from {self.address}. Any program that can send from there can change PX4's mode and,"
            f"{when} its parameters, but nothing in the companion"
        )

    async def __aenter__(self) -> Self:
        """Resolve the host, start the relay, forward frames to it. The ground station need not be present.

        Raises:
            DeviceError: the address or its host is invalid, or the relay does not start; nothing stays open.
        """
        host = await self._resolve(*check_address(self.address))
        try:
            port = await self._start(*host)
            self.vehicle_port = self._autopilot.forward_to(port)
            self._send({"vehicle_port": self.vehicle_port})
        except BaseException:
            await self._close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        """Stop the relay's output. Forwarding ends with the autopilot's link."""
        self._send({"bye": True})
        await self._close()

    def report_tick(self, inputs: Inputs, outputs: Outputs) -> None:
        """Send a tick's events and phase changes at once, its values at 4 Hz. Never waits; what does not fit is dropped."""
        if self._channel is None:
            return
        texts = [words.event_text(event) for event in outputs.events]
        said: dict[str, Any] = {}
        if outputs.request is AutopilotRequest.ARM:
            said["arming"] = True
        if outputs.phase != self._phase:
            self._phase = outputs.phase
            text = words.phase_text(outputs.phase)
            texts.append(text)
            said["situation"] = text[1]
        if outputs.outcome is not None:
            texts.append(words.outcome_text(outputs.outcome))
        if texts:
            said["texts"] = [
                (severity, text[: words.TEXT_MAX_BYTES]) for severity, text in texts[-words.TEXTS_WAITING_MAX :]
            ]
        if outputs.tick % VALUES_EVERY == 0:
            said["t_ms"], said["values"] = int(outputs.t_s * 1e3), words.values(inputs, outputs)
        if said:
            self._send(said)

    def take_messages(self) -> list[str]:
        """Return lines for the operator since the last call, on ground station, refused messages and relay. Never waits."""
        for _ in range(_MESSAGES_PER_CALL):
            if self._channel is None:
                break
            try:
                data = self._channel.recv(4096)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if data:
                text = str(unpack(data).get("text"))[:_TEXT_MAX]
                self._messages.append("".join(c if c.isprintable() else "?" for c in text))
            else:
                self._gone()
        messages, self._messages = self._messages, []
        return messages

    async def _resolve(self, host: str, port: int) -> tuple[str, int]:
        fix = "correct it, or leave it out"
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(_RESOLVE_DEADLINE_S):
                found = await loop.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        except TimeoutError:
            raise ground_error(self.address, f"an address of {host}", "no answer from name resolution", fix) from None
        except (OSError, UnicodeError) as error:
            found_text = getattr(error, "strerror", None) or str(error)
            raise ground_error(self.address, f"an address of {host}", str(found_text).lower(), fix) from None
        ip = str(found[0][4][0])
        if ipaddress.ip_address(ip.partition("%")[0]).is_multicast or ip == "255.255.255.255":
            raise ground_error(self.address, "one computer", f"the group {ip}", "give the ground station's address")
        return ip, port

    async def _start(self, ip: str, port: int) -> int:
        """Start the relay and return its UDP port on loopback."""
        self._channel = ours = self._spawn(ip, port)
        try:
            async with asyncio.timeout(_START_DEADLINE_S):
                data = await asyncio.get_running_loop().sock_recv(ours, 4096)
        except TimeoutError:
            expected = f"the relay to be ready within {_START_DEADLINE_S:g} s"
            raise ground_error(self.address, expected, "silence", "the computer is overloaded; try again") from None
        answer: dict[str, Any] = unpack(data) if data else {"error": "its end"}
        relay_port = answer.get("port")
        if type(relay_port) is not int or not 0 < relay_port <= 65535:
            fix = "give the address of one computer that can be reached from here"
            raise ground_error(self.address, "a relay to it", str(answer.get("error")).lower(), fix)
        return relay_port

    def _spawn(self, ip: str, port: int) -> socket.socket:
        """Start the relay's process and return the channel to it."""
        identity = self._autopilot.identity()
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        arguments = [
            *(sys.executable, "-P", "-m", "companion.io.qgroundcontrol.relay", "--fd", str(theirs.fileno())),
            *("--host", ip, "--port", str(port), "--system", str(identity.autopilot_system)),
            *("--name", self.address.removeprefix("udpout://")),
            *(["--while-armed"] if self._while_armed else []),
            *(["--console"] if self._console else []),
        ]
        try:
            self._process = subprocess.Popen(
                arguments,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(),),
                process_group=0,  # Ctrl-C on the terminal is for the flight process only
            )
        except BaseException:
            ours.close()
            raise
        finally:
            theirs.close()
        return ours

    def _send(self, said: dict[str, Any]) -> None:
        if self._channel is None:
            return
        try:
            self._channel.send(pack(said))
        except BlockingIOError:
            pass  # the relay is delayed: the text is lost, the flight continues
        except OSError:
            self._gone()

    def _gone(self) -> None:
        if self._channel is not None:
            self._channel.close()
            self._channel = None
            self._messages.append(f"ground station {self.address}: the relay has ended; nothing is forwarded")

    async def _close(self) -> None:
        if self._channel is not None:
            self._channel.close()  # the relay ends
            self._channel = None
        process, self._process = self._process, None
        if process is None:
            return
        try:
            with contextlib.suppress(subprocess.TimeoutExpired):
                await asyncio.to_thread(process.wait, _END_DEADLINE_S)
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
