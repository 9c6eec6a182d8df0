"""The simulated world's own MAVLink link to a real PX4, in addition to the companion's, for parameters, version and mode.

It uses PX4's camera link (UDP 14280 plus the instance number) and not the onboard link, because PX4 keeps sending to the first partner
that contacts it on a link.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Self

from pymavlink.dialects.v20 import development as mavlink  # common, and CURRENT_MODE

from companion.px4.params_file import single
from sitl.autopilot.modes import NavState, nav_state_from_custom
from sitl.autopilot.params import MAV_PARAM_TYPE_INT32, Value, decode_bytewise, encode_bytewise
from sitl.autopilot.types import Battery
from sitl.px4.hil_link import Px4Error
from sitl.px4.process import Instance
from sitl.udp import UdpEndpoint

ASK_AGAIN_S = 0.25
PARAMS_DEADLINE_S = 20.0
COMMAND_DEADLINE_S = 5.0
HEARTBEAT_DEADLINE_S = 20.0
MODE_PERIOD_S = 0.02
"""Period of CURRENT_MODE on this link; heartbeats arrive once per second, too rarely to show when the mode changes."""
_AT_ONCE = 20
"""Number of parameters requested at a time; more would overflow PX4's receive buffer."""
_OWN_SYSTEM, _OWN_COMPONENT = 254, mavlink.MAV_COMP_ID_SYSTEM_CONTROL
_AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1
_FORCE_DISARM = 21196.0


@dataclass(frozen=True, slots=True)
class Version:
    """Version of PX4."""

    release: str
    """Release, such as 1.16.1."""
    build: str
    """First eight hexadecimal digits of the commit; empty if PX4 does not report it."""

    def __str__(self) -> str:
        return f"{self.release} ({self.build})" if self.build else self.release


class ControlLink(UdpEndpoint):
    """The world's control link to PX4; an async context manager on the socket of the instance.

    Args:
        battery_cells: number of cells of the battery whose state is sent, 1 to 10.
    """

    def __init__(self, instance: Instance, battery_cells: int) -> None:
        super().__init__()
        self.nav_state: NavState | None = None
        """Mode in the newest HEARTBEAT or CURRENT_MODE; None if it is unknown."""
        self._instance, self._cells = instance, battery_cells
        self._system = instance.number + 1
        self._encoder = mavlink.MAVLink(None, srcSystem=_OWN_SYSTEM, srcComponent=_OWN_COMPONENT)
        self._battery_encoder = mavlink.MAVLink(None, self._system, mavlink.MAV_COMP_ID_BATTERY)
        self._decoder = mavlink.MAVLink(None)
        self._decoder.robust_parsing = True
        self._handlers: list[Callable[[Any], None]] = []

    async def __aenter__(self) -> Self:
        await asyncio.get_running_loop().create_datagram_endpoint(lambda: self, sock=self._instance.control)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        """Decode PX4's messages, store its mode and pass each message to the waiting requests."""
        for message in self._decoder.parse_buffer(data) or ():
            if message.get_srcSystem() != self._system or message.get_srcComponent() != _AUTOPILOT:
                continue
            if message.get_type() in ("HEARTBEAT", "CURRENT_MODE"):
                main, sub = (message.custom_mode >> 16) & 0xFF, (message.custom_mode >> 24) & 0xFF
                self.nav_state = nav_state_from_custom(main, sub)
            for handler in tuple(self._handlers):
                handler(message)

    async def await_heartbeat(self) -> None:
        """Wait for a heartbeat from PX4.

        Raises:
            Px4Error: no heartbeat arrived within HEARTBEAT_DEADLINE_S.
        """
        self.nav_state = None
        heard = await self._ask(
            lambda: self._send(mavlink.MAVLink_ping_message(0, 0, self._system, _AUTOPILOT)),
            lambda message: message if message.get_type() == "HEARTBEAT" else None,
            HEARTBEAT_DEADLINE_S,
        )
        if heard is None:
            raise Px4Error(
                f"PX4: expected a heartbeat on UDP {self._instance.control.getsockname()[1]} within "
                f"{HEARTBEAT_DEADLINE_S:g} s, found none; check that this is PX4 SITL with its standard links"
            )

    async def version(self) -> Version:
        """Request AUTOPILOT_VERSION and return the version of PX4.

        Raises:
            Px4Error: PX4 did not answer.
        """
        message = await self._ask(
            lambda: self._command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION),
            lambda message: message if message.get_type() == "AUTOPILOT_VERSION" else None,
            COMMAND_DEADLINE_S,
        )
        if message is None:
            raise Px4Error(f"PX4: expected AUTOPILOT_VERSION within {COMMAND_DEADLINE_S:g} s, found none")
        number = int(message.flight_sw_version)
        build = bytes(message.flight_custom_version)[::-1].hex()[:8].strip("0")
        return Version(".".join(str(number >> shift & 0xFF) for shift in (24, 16, 8)), build)

    async def read(self, names: Iterable[str]) -> dict[str, Value]:
        """Return the values of parameters by name; names that PX4 does not have are omitted.

        Raises:
            Px4Error: PX4 stopped answering.
        """
        wanted = list(dict.fromkeys(names))
        found: dict[str, Value] = {}
        # PX4 does not answer a request for an unknown name, so a name without an answer to four requests is absent.
        for _ in range(4):
            missing = [name for name in wanted if name not in found]
            for i in range(0, len(missing), _AT_ONCE):
                found |= await self._read_some(missing[i : i + _AT_ONCE])
        if wanted and not found:
            raise Px4Error(f"PX4: expected the values of {len(wanted)} parameters, found no answer")
        return found

    async def _read_some(self, names: list[str]) -> dict[str, Value]:
        found: dict[str, Value] = {}

        def note(message: Any) -> dict[str, Value] | None:
            name, value = _parameter(message)
            if name in names and value is not None:
                found[name] = value
            return found if len(found) == len(names) else None

        def send() -> None:
            for name in names:
                if name not in found:
                    self._send(mavlink.MAVLink_param_request_read_message(self._system, _AUTOPILOT, name.encode(), -1))

        await self._ask(send, note, 2.5 * ASK_AGAIN_S)
        return found

    async def write(self, values: Mapping[str, Value]) -> None:
        """Set parameters and wait until PX4 confirms each of them.

        Args:
            values: int for INT32 and float for REAL32; PX4 ignores a value of the wrong type.

        Raises:
            Px4Error: PX4 did not confirm one of them.
        """
        left = dict(values)

        def note(message: Any) -> bool | None:
            name, value = _parameter(message)
            if name in left and value is not None and same(value, left[name]):
                del left[name]
            return True if not left else None

        def send() -> None:
            for name, value in list(left.items())[:_AT_ONCE]:
                kind = MAV_PARAM_TYPE_INT32 if isinstance(value, int) else mavlink.MAV_PARAM_TYPE_REAL32
                self._send(
                    mavlink.MAVLink_param_set_message(
                        self._system, _AUTOPILOT, name.encode(), encode_bytewise(value), kind
                    )
                )

        if left:
            await self._ask(send, note, PARAMS_DEADLINE_S)
        if left:
            name, value = next(iter(left.items()))
            found = (await self.read([name])).get(name)
            raise Px4Error(
                f"PX4: expected {name} to become {value:g}, found {'no such parameter' if found is None else found}"
            )

    async def save(self) -> None:
        """Make PX4 store its parameters immediately instead of a few seconds later.

        Raises:
            Px4Error: PX4 refused or did not answer.
        """
        await self.command(mavlink.MAV_CMD_PREFLIGHT_STORAGE, 1.0)

    async def request_mode_stream(self) -> None:
        """Request CURRENT_MODE every MODE_PERIOD_S; a restart of PX4 ends the stream.

        Raises:
            Px4Error: PX4 refused or did not answer.
        """
        await self.command(
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_CURRENT_MODE, MODE_PERIOD_S * 1e6
        )

    def request_mode(self, state: NavState) -> None:
        """Request a mode as a ground station does, without waiting for an answer."""
        main, sub = state.value[0:2]
        self._command(mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, main, sub)

    def force_disarm(self) -> None:
        """Stop the rotors, even in the air."""
        self._command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, _FORCE_DISARM)

    def send_battery(self, battery: Battery) -> None:
        """Send BATTERY_STATUS with PX4's system id, which PX4 uses in place of its power module (handle_message_battery_status)."""
        cells = [round(battery.voltage_v / self._cells * 1e3)] * self._cells + [0xFFFF] * (10 - self._cells)
        message = mavlink.MAVLink_battery_status_message(
            0, mavlink.MAV_BATTERY_FUNCTION_ALL, mavlink.MAV_BATTERY_TYPE_LIPO, 2500, cells, round(battery.current_a * 1e2),
            round(battery.consumed_mah), -1, round(battery.remaining * 1e2),
        )  # fmt: skip
        self.send_to(message.pack(self._battery_encoder), self._instance.control_address)
        self._battery_encoder.seq = (self._battery_encoder.seq + 1) % 256

    async def command(self, command: int, *params: float) -> None:
        """Send one MAV_CMD and wait until PX4 accepts it.

        Raises:
            Px4Error: PX4 refused it or did not answer.
        """

        def result(message: Any) -> Any:
            return message if message.get_type() == "COMMAND_ACK" and message.command == command else None

        message = await self._ask(lambda: self._command(command, *params), result, COMMAND_DEADLINE_S)
        name = mavlink.enums["MAV_CMD"][command].name
        if message is None:
            raise Px4Error(f"PX4: expected an answer to {name} within {COMMAND_DEADLINE_S:g} s, found none")
        if message.result != mavlink.MAV_RESULT_ACCEPTED:
            found = mavlink.enums["MAV_RESULT"][message.result].name
            raise Px4Error(f"PX4: expected {name} to be accepted, found {found}")

    def _command(self, command: int, *params: float) -> None:
        numbers = [*params, *[0.0] * (7 - len(params))]
        self._send(mavlink.MAVLink_command_long_message(self._system, _AUTOPILOT, command, 0, *numbers))

    async def _ask(self, send: Callable[[], None], answer: Callable[[Any], Any], deadline_s: float) -> Any:
        """Call `send` every ASK_AGAIN_S until `answer` returns a value for a message; return it, or None at the deadline."""
        answered: asyncio.Future[Any] = asyncio.get_running_loop().create_future()

        def handle(message: Any) -> None:
            found = answer(message)
            if found is not None and not answered.done():
                answered.set_result(found)

        self._handlers.append(handle)
        try:
            end_s = asyncio.get_running_loop().time() + deadline_s
            while (left_s := end_s - asyncio.get_running_loop().time()) > 0.0:
                send()
                done, _ = await asyncio.wait((answered,), timeout=min(ASK_AGAIN_S, left_s))
                if done:
                    return answered.result()
            return None
        finally:
            self._handlers.remove(handle)

    def _send(self, message: Any) -> None:
        self.send_to(message.pack(self._encoder), self._instance.control_address)
        self._encoder.seq = (self._encoder.seq + 1) % 256


def _parameter(message: Any) -> tuple[str, Value | None]:
    """Return the name and the value in a PARAM_VALUE, or ("", None) for another message."""
    if message.get_type() != "PARAM_VALUE":
        return "", None
    return message.param_id, decode_bytewise(message.param_value, message.param_type)


def same(a: Value, b: Value) -> bool:
    """Return whether PX4 stores both numbers as the same value; it stores floating-point numbers in single precision."""
    if isinstance(a, int) != isinstance(b, int):
        return False
    finite = math.isfinite(a) and math.isfinite(b)
    return a == b or (finite and math.isclose(single(a), single(b), rel_tol=1e-6, abs_tol=1e-9))
