"""Driver of PX4: MAVSDK's native binding on a link that the driver itself reads and writes.

MAVSDK makes JSON of every message and calls Python from its own threads, which costs more than all else that a tick does with PX4. So
the link is the driver's (`companion.io.px4.traffic`): once per tick it reads what has arrived, decodes what the flight uses, and passes
everything but the streams of the vehicle's state to MAVSDK, whose `raw://` connection returns what is to be sent. Setpoints, poses and
commands are written straight onto the link. Decision 14 (docs/internals/decisions) gives the figures.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Iterable
from typing import Any, Self

from mavsdk import ComponentType, Configuration, Mavsdk

from companion.config.devices import AutopilotDevice
from companion.io.protocols import DeviceError
from companion.io.px4 import messages
from companion.io.px4.exclusive_link import ExclusiveLink
from companion.io.px4.frames import frames
from companion.io.px4.inbox import Inbox
from companion.io.px4.link import check_address, device_error, first_autopilot, open_link, quiet_native_log
from companion.io.px4.origin import ensure_origin
from companion.io.px4.params import ParamTransfer
from companion.io.px4.questions import Questions
from companion.io.px4.requests import RequestQueue
from companion.io.px4.setpoints import SetpointPath, setpoint_path
from companion.io.px4.streams import ESTIMATOR_RATE_HZ, HEARTBEAT_ASK_PERIOD_S, ask_for_streams, stop_unread_streams
from companion.io.px4.traffic import Traffic
from companion.model.estimator import EstimatorReport
from companion.model.observations import StateCounts
from companion.model.types import (
    AttitudeSetpoint,
    AutopilotRequest,
    AutopilotStatus,
    LinkIdentity,
    MocapPose,
    VehicleState,
)
from companion.runtime.clock import Clock

_HEARTBEAT_DEADLINE_S = 5.0
"""Deadline for PX4's heartbeat, which is sent once per second."""
_PUMP_S, _PUMP_IN_FLIGHT_S = 0.005, 0.05
"""Period at which the link is read while the flight loop does not read it, as at start-up, and at which that is checked otherwise."""
_log = logging.getLogger(__name__)


class MavsdkAutopilot:
    """Driver of PX4; implements the `Autopilot` protocol.

    Attitude setpoints are sent by the path in `devices.autopilot.setpoint_path`; see `companion.io.px4.setpoints`.

    Args:
        forwarding: whether a second connection is needed; see `forward_to`.
    """

    def __init__(
        self,
        device: AutopilotDevice,
        clock: Clock,
        *,
        forwarding: bool = False,
        estimator_rate_hz: float = ESTIMATOR_RATE_HZ,
    ) -> None:
        self._device = device
        self._estimator_rate_hz = estimator_rate_hz
        self._forwarding = forwarding
        self._clock = clock
        self._requests = RequestQueue()
        self._inbox = Inbox(self._requests, self._after_heartbeat)
        self._mavsdk: Any = None
        self._connection: Any = None
        self._traffic: Traffic | None = None
        self._asking: asyncio.Task[None] | None = None
        self._pump_timer: asyncio.TimerHandle | None = None
        self._asked_s = -math.inf
        self._restore_log: Callable[[], None] | None = None
        self._setpoints: SetpointPath | None = None
        self._questions: Questions | None = None
        self._open = False
        self._loop: asyncio.AbstractEventLoop | None = None
        self._system_id = 0
        self._own_ids = (0, 0)
        self._reports: list[str] = []
        self._claim: ExclusiveLink | None = None

    async def __aenter__(self) -> Self:
        """Open the link, find PX4, request the streams, and set a global origin if PX4 has none and is not armed.

        Raises:
            DeviceError: the link could not be opened or set up; the text gives the reason, and nothing stays open.
        """
        address = self._device.address
        check_address(address)
        self._loop = asyncio.get_running_loop()
        self._restore_log = quiet_native_log()
        try:
            configuration = Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)
            self._own_ids = (int(configuration.system_id), int(configuration.component_id))
            self._mavsdk = Mavsdk(configuration)
            self._connection = self._mavsdk.add_any_connection_with_handle("raw://")
            self._mavsdk.subscribe_raw_bytes_to_be_sent(self._send_for_mavsdk)
            self._claim = claim = ExclusiveLink(address)
            await claim.find_px4(self._device.discovery_timeout_s)
            wire = await asyncio.to_thread(open_link, address, claim.peer, self._clock, self._reports.append)
            self._traffic = traffic = Traffic(
                address, wire, self._own_ids, stream=claim.peer is None, clock=self._clock, inbox=self._inbox,
                to_mavsdk=self._mavsdk.pass_received_raw_bytes, reports=self._reports,
            )  # fmt: skip
            self._pump()
            async with claim.calling(self._own_ids):
                system = await first_autopilot(self._mavsdk, address, self._device.discovery_timeout_s)
            self._system_id = int(system.get_system_id())
            traffic.only_from(self._system_id)
            path = self._device.setpoint_path
            self._setpoints = setpoint_path(path, system, self._send_message, self._send_frame)
            self._questions = questions = Questions(address, self._system_id, self._inbox, self._send_message)
            await ask_for_streams(questions, self._estimator_rate_hz)
            self._open = True
            await self.ensure_origin()
            if not await self._armed():  # a vehicle in flight does not wait for it
                stop_unread_streams(questions, forwarded=self._forwarding)
            claim.refuse_rivals()
        except BaseException:
            await self._close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the connection at once, then let MAVSDK's threads end. Nothing is sent after that; PX4 stays in its mode."""
        await self._close()

    def identity(self) -> LinkIdentity:
        """Return the ids of both ends of the open link."""
        traffic, (own_system, own_component) = self._traffic, self._own_ids
        return LinkIdentity(
            autopilot_system=self._system_id,
            own_system=own_system,
            own_component=own_component,
            local_port=traffic.local_port if traffic is not None else 0,
            peer=traffic.remote if traffic is not None else None,
        )

    def forward_to(self, port: int) -> int:
        """Forward MAVLink between PX4 and a local UDP port, that of the relay (`companion.io.qgroundcontrol.relay`). Return the local
        port from which it is sent; datagrams of all other senders are ignored.
        """
        self._require_open()
        assert self._traffic is not None
        return self._traffic.forward_to(port)

    def vehicle(self) -> VehicleState | None:
        """Read the link; return the latest fused state, None before all of its parts have arrived. Stamps are arrival times."""
        self._poll()
        self._ask_for_heartbeat()
        return self._inbox.vehicle()

    def status(self) -> AutopilotStatus | None:
        """Return the latest status, or None before the first heartbeat. `heartbeat_stamp_s` is the newest one's arrival."""
        return self._inbox.status()

    def estimator(self) -> EstimatorReport | None:
        """Return the latest ESTIMATOR_STATUS, stamped on arrival, or None before the first."""
        return self._inbox.estimator()

    def counts(self) -> StateCounts:
        """Return the number of state messages since the link was opened."""
        return self._inbox.counts()

    def send_attitude(self, setpoint: AttitudeSetpoint | None) -> bool:
        """Send SET_ATTITUDE_TARGET at once; None stops the setpoints. Return False if nothing was sent.

        Raises:
            ValueError: an invalid value (not finite, not a unit quaternion, thrust outside 0 to 1).
        """
        if not self._open or self._setpoints is None:
            return False
        if setpoint is None:
            self._setpoints.stop()
            return False
        return self._setpoints.send(setpoint, self._clock())

    def send_vision(self, pose: MocapPose) -> bool:
        """Send VISION_POSITION_ESTIMATE at once. Return False if it was not sent.

        Raises:
            ValueError: the pose is not finite.
        """
        payload = messages.vision_position_estimate(pose)
        if not self._open:
            return False
        return self._send_message(messages.VISION_POSITION_ESTIMATE_ID, payload)

    def request(self, request: AutopilotRequest) -> None:
        """Send the request's command, once, unless one of its kind is in progress or was sent a moment ago. Returns at once.

        LAND never waits for a command of another kind. `take_messages` returns refusals.
        """
        if self._open and self._requests.claim(request, self._clock()):
            self._send_message(*messages.command_long(*messages.command(request), self._system_id))

    def take_messages(self) -> list[str]:
        """Return, oldest first, all refusals and STATUSTEXTs since the last call, and reports of a new port of PX4, of a link that hung
        up or is open again, or of a second sender that claims to be PX4.
        """
        texts = self._requests.take_messages(self._clock())
        if self._reports:
            texts += self._reports
            self._reports.clear()
        rival = self._claim.take_rival() if self._claim is not None else None
        return texts if rival is None else [*texts, rival]

    async def read_params(self, names: Iterable[str]) -> dict[str, float | int]:
        """Return the values of PX4's parameters by name, int or float as PX4 stores them; a name that PX4 does not have is left out.

        Raises:
            DeviceError: an invalid name, or no answer within the deadline.
        """
        return await self._params().read(names)

    async def read_param(self, name: str) -> float | int:
        """Return the value of one PX4 parameter, int or float as PX4 stores it.

        Raises:
            DeviceError: no such name, or no answer within the deadline.
        """
        values = await self._params().read([name])
        if name not in values:
            fix = "check the name against PX4's version"
            raise device_error(self._device.address, f"PX4's parameter {name}", "no such parameter", fix)
        return values[name]

    async def write_param(self, name: str, value: float | int) -> float | int:
        """Write one PX4 parameter, read it back and return the value that PX4 now holds, a float in single precision.

        Raises:
            DeviceError: PX4 has no such parameter, its type cannot hold the value, or PX4 refuses the value or keeps a different one.
        """
        return await self._params().write(name, value)

    async def ensure_origin(self) -> bool:
        """Set PX4's global origin (`companion.io.px4.origin`) unless it has one or is armed. Return whether PX4 reports an origin.

        PX4 reports one only while its position is valid, so False means nothing right after boot.

        Raises:
            DeviceError: PX4 does not answer, or sends no heartbeat.
        """
        return await ensure_origin(self._ask(), self._armed)

    def start_sums(self) -> None:
        """Start the sums over PX4's samples, such as the change of velocity, at zero; called when the flight begins."""
        self._poll()  # samples that wait on the link belong to the time before
        self._inbox.start_sums()

    async def _armed(self) -> bool:
        try:
            async with asyncio.timeout(_HEARTBEAT_DEADLINE_S):
                while (status := self._inbox.status()) is None:  # noqa: ASYNC110 - `_pump` reads the link
                    await asyncio.sleep(0.02)
        except TimeoutError:
            expected = f"a PX4 heartbeat within {_HEARTBEAT_DEADLINE_S:g} s"
            raise device_error(self._device.address, expected, "none", "check the link") from None
        return status.armed

    async def firmware(self) -> str:
        """Return PX4's version as it reports it, such as `PX4 1.16.1 release (git 0123456789abcdef)`.

        Raises:
            DeviceError: no AUTOPILOT_VERSION within the deadline.
        """
        question = messages.command_long(messages.REQUEST_MESSAGE, messages.AUTOPILOT_VERSION_ID, 0.0, self._system_id)
        expected = "PX4's version (AUTOPILOT_VERSION)"
        return await self._ask().ask(expected, question, messages.AUTOPILOT_VERSION_ID, messages.firmware)

    def _params(self) -> ParamTransfer:
        return ParamTransfer(self._clock, self._ask())

    def _ask(self) -> Questions:
        self._require_open()
        assert self._questions is not None
        return self._questions

    def _require_open(self) -> None:
        if not self._open:
            fix = "open it first"
            raise device_error(self._device.address, "an open link", "a closed one", fix)

    def _after_heartbeat(self) -> None:
        if (
            self._traffic is not None
            and self._traffic.was_lost
            and self._questions is not None
            and self._loop is not None
        ):
            self._traffic.was_lost = False
            self._asking = self._loop.create_task(self._ask_again(self._questions))
        self._show_ground_station()

    async def _ask_again(self, questions: Questions) -> None:
        """Request the streams on a link that was lost: PX4 keeps their rates, unless it restarted its end of the link or itself."""
        try:
            await ask_for_streams(questions, self._estimator_rate_hz)
        except DeviceError as error:
            self._reports.append(str(error))

    def _show_ground_station(self) -> None:
        """Answer the heartbeat of a disarmed PX4 with that of a ground station, because PX4 reports the
        reasons why it refuses to arm only to a ground station.

        While PX4 is armed nothing is sent, because PX4 must notice the loss of the real ground station, whatever NAV_DLL_ACT
        is set to.
        """
        status = self._inbox.status()
        if self._open and status is not None and not status.armed:
            self._send_message(messages.HEARTBEAT_ID, messages.GROUND_STATION_HEARTBEAT)

    def _ask_for_heartbeat(self) -> None:
        """Request HEARTBEAT from an armed PX4, which sends no more than one per second: a kill must be seen sooner."""
        status, now_s = self._inbox.status(), self._clock()
        if self._open and status is not None and status.armed and now_s - self._asked_s >= HEARTBEAT_ASK_PERIOD_S:
            self._asked_s = now_s
            heartbeat = float(messages.HEARTBEAT_ID)
            self._send_message(*messages.command_long(messages.REQUEST_MESSAGE, heartbeat, 0.0, self._system_id))

    def _pump(self) -> None:
        assert self._loop is not None
        idle = self._traffic is not None and self._clock() - self._traffic.polled_s > 1.5 * _PUMP_S
        if idle:
            self._poll()
        self._pump_timer = self._loop.call_later(_PUMP_S if idle else _PUMP_IN_FLIGHT_S, self._pump)

    def _poll(self) -> None:
        if self._traffic is not None:
            self._traffic.poll()

    def _send_message(self, message_id: int, payload: bytes) -> bool:
        return self._traffic is not None and self._traffic.send_message(message_id, payload)

    def _send_frame(self, frame: bytes) -> bool:
        return self._traffic is not None and self._traffic.send_frame(frame)

    def _send_for_mavsdk(self, data: bytes, *_: Any) -> None:
        """Send what MAVSDK sends, in a thread of MAVSDK; setpoints only as their path wants."""
        frame = bytes(data)
        found = next(frames(frame), None)
        if found is None or found.message_id != messages.SET_ATTITUDE_TARGET_ID:
            self._send_frame(frame)
        elif self._setpoints is not None:
            self._setpoints.pass_on(frame)

    async def _close(self) -> None:
        self._open = False
        if self._pump_timer is not None:
            self._pump_timer.cancel()
        if self._asking is not None:
            self._asking.cancel()
        for held in (self._traffic, self._claim):  # from here on nothing can leave
            if held is not None:
                held.close()
        if self._connection is not None:
            self._mavsdk.remove_connection(self._connection)
            self._connection = None
        # Shielded: a second Ctrl-C must not leave MAVSDK half destroyed.
        await asyncio.shield(asyncio.get_running_loop().run_in_executor(None, self._tear_down))

    def _tear_down(self) -> None:
        try:
            if self._mavsdk is not None:
                self._mavsdk.destroy()
        except Exception as error:
            _log.error("autopilot %s: closing failed: %s", self._device.address, error)
        finally:
            if self._restore_log is not None:
                self._restore_log()
