"""Opens the link to PX4; every failure is reported in one line."""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import socket
import stat
import threading
from collections.abc import Callable
from typing import Any

from mavsdk import Autopilot as AutopilotKind
from mavsdk import Mavsdk, log_subscribe, log_unsubscribe

from companion.io.protocols import DeviceError
from companion.io.px4.wire import OpenWire, open_wire
from companion.model.link_address import parse_address
from companion.runtime.clock import Clock
from companion.runtime.event_loop import real_time

_native_log = logging.getLogger("companion.mavsdk")
_log_lock = threading.Lock()
_log_users = 0


def device_error(address: str, expected: str, found: str, fix: str) -> DeviceError:
    """Return a DeviceError with the text "autopilot ADDRESS: expected ..., found ...; FIX"."""
    return DeviceError(f"autopilot {address}: expected {expected}, found {found}; {fix}")


def no_heartbeat(address: str, timeout_s: float) -> DeviceError:
    """Return the error for a link without an autopilot's heartbeat."""
    fix = "power the autopilot; check the cable, and the baud rate or PX4's MAVLink target address and port"
    return device_error(address, f"a PX4 heartbeat within {timeout_s:g} s", "none", fix)


def check_address(address: str) -> None:
    """Check that a serial port exists and is accessible.

    Raises:
        DeviceError: the serial port is missing or not accessible.
    """
    parts = parse_address(address)
    if parts.serial:
        _check_serial(address, parts.host)


def _check_serial(address: str, path: str) -> None:
    try:
        mode = os.stat(path).st_mode
    except OSError as error:
        fix = "plug the autopilot in, or correct devices.autopilot.address (ls /dev/serial/by-id)"
        raise device_error(address, f"the serial port {path}", error.strerror or str(error), fix) from None
    if not stat.S_ISCHR(mode):
        raise device_error(address, f"a serial port at {path}", "no device file", "correct devices.autopilot.address")
    if not os.access(path, os.R_OK | os.W_OK):
        fix = "add the user to the group that owns it (usually dialout) and log in again"
        raise device_error(address, f"permission to read and write {path}", "none", fix)


def bind_alone(address: str, host: str, port: int, kind: socket.SocketKind) -> socket.socket:
    """Return a socket bound to a local port that no other socket uses.

    Raises:
        DeviceError: the port is busy, or the host is not this computer.
    """
    bound = socket.socket(socket.AF_INET, kind)
    try:
        bound.bind((host, port))
    except OSError as error:
        bound.close()
        if error.errno == errno.EADDRINUSE:
            fix = "stop that program (another companion, QGroundControl, a MAVLink router?) or use another port"
            raise device_error(address, f"port {port} to be free", "another program on it", fix) from None
        fix = "use an address of this computer, or 0.0.0.0 for all"
        raise device_error(address, f"a local address in {host}", error.strerror or str(error), fix) from None
    return bound


def open_link(address: str, peer: tuple[str, int] | None, clock: Clock, report: Callable[[str], None]) -> OpenWire:
    """Return the open wire to PX4; its port is the claim's (`companion.io.px4.exclusive_link`). Blocks while a TCP connection is made.

    Args:
        peer: PX4's verified UDP address.
        report: called with a line when PX4 is received at another port.

    Raises:
        DeviceError: it could not be opened.
    """
    try:
        return open_wire(address, 0, peer, clock, share_port=True, report=report)
    except OSError as error:
        parts = parse_address(address)
        if parts.serial and error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            fix = f"stop that program (another companion? `fuser {parts.host}` names it)"
            expected, found = f"the serial port {parts.host} to be free", "another program on it"
        else:
            expected, found = "to open the connection", error.strerror or str(error)
            fix = "check the cable and the address, and use a baud rate that the port supports, 921600 for PX4's TELEM2"
        raise device_error(address, expected, found, fix) from None


async def first_autopilot(mavsdk: Mavsdk, address: str, timeout_s: float) -> Any:
    """Return the first MAVSDK system with a heartbeat, if it is PX4.

    Raises:
        DeviceError: no heartbeat within `timeout_s`, or only one of an autopilot other than PX4.
    """
    loop = asyncio.get_running_loop()
    found: asyncio.Future[Any] = loop.create_future()

    def resolve(system: Any) -> None:
        if not found.done():
            found.set_result(system)

    handle = mavsdk.first_autopilot_async(-1.0, lambda system: loop.call_soon_threadsafe(resolve, system))
    try:
        with real_time():
            async with asyncio.timeout(timeout_s):
                system = await found
    except TimeoutError:
        raise no_heartbeat(address, timeout_s) from None
    finally:
        mavsdk.cancel_first_autopilot(handle)
    kind = system.autopilot_type()
    if kind != AutopilotKind.PX4:
        raise device_error(address, "PX4", kind.name, "connect a PX4 autopilot; companion supports no other autopilot")
    return system


def _log_native(level: Any, message: str, file: str | None, line: int) -> bool:
    del level, file, line
    _native_log.debug("%s", message)
    return True  # keeps MAVSDK from printing it


def quiet_native_log() -> Callable[[], None]:
    """Redirect MAVSDK's log from the terminal to the logger `companion.mavsdk` at DEBUG. Return a function that restores it."""
    global _log_users
    with _log_lock:
        _log_users += 1
        if _log_users == 1:
            log_subscribe(_log_native)
    undone = False

    def undo() -> None:
        nonlocal undone
        global _log_users
        with _log_lock:
            if undone:
                return
            undone = True
            _log_users -= 1
            # After the last instance is gone no thread of MAVSDK is left to call into Python while the interpreter ends.
            if _log_users == 0:
                log_unsubscribe()

    return undo
