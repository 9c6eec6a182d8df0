"""The simulated world behind its wires: the plant, with every device behind its real protocol.

In lockstep with a flight, the world owns the time and waits for the flight (`sitl.lockstep`). On its own it follows the wall clock: if
the process falls behind by more than `CATCH_UP_S`, the world pauses instead of catching up; `slipped_s` counts the lost time.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from typing import Any

from companion.config.vehicle import Vehicle
from companion.model.launcher_messages import WorldAtRest, WorldEvent, WorldMessage, WorldProgress, WorldSlipped
from companion.model.types import IDENTITY_QUAT
from companion.sitl_config.world import World as WorldConfig
from sitl.addresses import replaced, settings_of
from sitl.autopilot.backend import AutopilotBackend, StubBackend
from sitl.autopilot.mavlink import Ports as LinkPorts
from sitl.external_vision import ExternalVision
from sitl.faults.injector import Faults
from sitl.faults.processes import SIGNALS, ProcessFaults, environment
from sitl.force_torque import ForceTorqueServer
from sitl.lockstep import CATCH_UP_S, LockstepLoop, TimeKeeper
from sitl.natnet import OTHER_BODY, OTHER_PLACE_M, BodyPose, NatNetServer
from sitl.plant import MocapFrame, Plant
from sitl.px4.hil_link import Px4Error
from sitl.record import TrueCourse, final_report
from sitl.servo.bus import ServoBus
from sitl.servo.from_config import jaws_servo_of, plugged_in, servos_of
from sitl.servo.model import ServoModel
from sitl.world.arm_handling import ArmHandling
from sitl.world.start import Start
from sitl.world.state import PHYSICS_DT_S

BEFORE_S = -3600.0
"""Simulated time when a world in lockstep starts; it jumps to zero when the flight begins."""
BUS_PATIENCE_S = 1.0
"""Wall time that bytes take at most from the companion's end of a serial line to the world's."""
_LEAVE_S = 30.0
SLIP_REPORTED_S = 0.1
"""A world in real time reports its pauses each time that they have grown by this much."""

OnMessage = Callable[[WorldMessage], None]


@dataclass(frozen=True, slots=True)
class Ports:
    """UDP ports of the standalone simulator; 0 for any free port."""

    autopilot_local: int = 0
    autopilot_remote: int = 0
    """Port to which PX4 sends from the start; if 0, PX4 waits for the first message from a partner."""
    mocap_command: int = 0
    mocap_data: int = 0
    multicast: bool = False


class Sitl:
    """SITL server: the simulated plant and the links to its devices.

    Args:
        vehicle: vehicle file.
        config: configuration of the world.
        start: pose of the vehicle at the start.
        ports: UDP ports.
        on_message: called with every event, as a message for the launcher.
        autopilot: a real PX4, or None for the stub.
        keeper: simulated time, for a world in lockstep; None for a world in real time.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        config: WorldConfig,
        start: Start,
        ports: Ports,
        on_message: OnMessage,
        autopilot: AutopilotBackend | None = None,
        keeper: TimeKeeper | None = None,
    ) -> None:
        self._keeper = keeper
        self._vehicle = vehicle
        self._config = config
        self._on_message = on_message
        self.servos = servos_of(vehicle, config)
        self._jaws = jaws_servo_of(vehicle)
        self._on_bus = plugged_in(self.servos, config) + ([] if self._jaws is None else [self._jaws])
        stub_ports = LinkPorts(ports.autopilot_local, ports.autopilot_remote)
        self.autopilot: AutopilotBackend = autopilot or StubBackend(
            vehicle.airframe,
            config,
            stub_ports,
            external_vision=vehicle.devices.mocap.external,
            in_lockstep=keeper is not None,
        )
        self._start = start
        self._sent_frame = False
        """Whether motion capture has sent a frame in this step."""
        self._make_plant()
        self.bus: ServoBus | None = None
        """The servo bus; None if the vehicle has no arm, or while the links are not open."""
        self.mocap: NatNetServer | ExternalVision | None = None
        """The simulated motion capture; None while the links are not open."""
        self.force: ForceTorqueServer | None = None
        """The emulated force sensor; None if the vehicle has none, or while the links are not open."""
        other = config.mocap_other_id
        self._others = () if other is None else ((other, OTHER_BODY),)
        self._ball = vehicle.devices.mocap.ball
        """How motion capture sees the ball; None if the mission does not follow it."""
        bar_id = vehicle.devices.mocap.bar_id
        self._bar_body = () if bar_id is None else ((bar_id, "bar"),)
        """Id and name of the bar's rigid body; empty if it has none."""
        self._arm_handling = ArmHandling(vehicle.arm, start.arm_rad) if config.arm_handling and self.servos else None
        self.flight = ProcessFaults()
        self._course = TrueCourse()
        self._ports = ports
        self.slipped_s = self._slip_reported_s = 0.0
        self._origin_s = 0.0
        """World time 0 on the event loop's clock."""
        self._next_frame: asyncio.TimerHandle | None = None
        """Timer that sends a frame between two steps."""
        self._at_rest = False
        self._leaving = False
        self._end_s = math.inf
        self._lost_servo: ServoModel | None = None

    def _make_plant(self) -> None:
        vehicle, config = self._vehicle, self._config
        # In lockstep as in the fast closed loop: cameras expose at the end of a step, and all else happens there, too.
        between_steps = self._keeper is None
        self.plant = Plant(
            vehicle, config, self.autopilot, self.servos, self._start, jaws=self._jaws, between_steps=between_steps
        )
        self.autopilot.attach(self.plant.machine)
        self.faults = Faults(
            config,
            self.plant.scene,
            self.plant.machine,
            self.autopilot.fault_target,
            [servo.drive for servo in self.servos],
            vehicle.tether,
            self.servos,
        )
        if config.faults:
            self.plant.faults = self.faults

    def _start_over(self) -> None:
        """Put the world back to its beginning, as the flight begins: what happens in the flight does not depend on how long the
        preflight took. What the companion has set in the devices stays.
        """
        assert self._keeper is not None
        if not self.autopilot.start_over():
            return
        for servo in (*self.servos, *(() if self._jaws is None else (self._jaws,))):
            servo.drive.start_over()
        self._make_plant()
        if self.force is not None:
            self.force.start_over()
        if isinstance(self.mocap, NatNetServer):
            self.mocap.start_over()
        self._course = TrueCourse()
        self.flight.start_over()
        self._keeper.set(0.0)

    @contextlib.asynccontextmanager
    async def wires(self) -> AsyncIterator[dict[str, dict[str, Any]]]:
        """Open every link and yield the addresses in the form of a vehicle file's `devices` settings."""
        device = self._vehicle.devices
        async with contextlib.AsyncExitStack() as stack:
            if device.arm is not None:
                page = None if self._keeper is None else self._keeper.page
                self.bus = await stack.enter_async_context(ServoBus(self._on_bus, page=page))
            if device.force is not None:
                sensor = ForceTorqueServer(in_lockstep=self._keeper is not None)
                self.force = await stack.enter_async_context(sensor)
            if not device.mocap.external:
                self.mocap = await stack.enter_async_context(self._natnet_server())
            px4 = await stack.enter_async_context(self.autopilot.wires())
            if device.mocap.external:
                self.mocap = await stack.enter_async_context(ExternalVision(self.autopilot.vision_address))
            natnet = self.mocap if isinstance(self.mocap, NatNetServer) else None
            rate_hz, multicast = self._config.mocap_rate_hz, self._ports.multicast
            addresses = {"autopilot": {"address": px4}} | settings_of(
                device, natnet, rate_hz, multicast, self.bus, self.force
            )
            for text in replaced(device, addresses):
                self._on_message(WorldProgress(text))
            yield addresses

    def _natnet_server(self) -> NatNetServer:
        mocap = self._vehicle.devices.mocap
        return NatNetServer(
            version=self._config.natnet_version,
            command_port=self._ports.mocap_command,
            data_port=self._ports.mocap_data,
            multicast_group=mocap.multicast_group if self._ports.multicast else None,
            bodies=((mocap.rigid_body_id, self._vehicle.name), *self._others, *self._ball_body, *self._bar_body),
            clock=asyncio.get_running_loop().time if self._keeper is None else lambda: self.plant.t_s,
            stamps=self._server_clock_s,
        )

    @property
    def _ball_body(self) -> tuple[tuple[int, str], ...]:
        """Id and name of the ball's rigid body; empty if it has none."""
        return () if self._ball is None or self._ball.id is None else ((self._ball.id, "ball"),)

    def _server_clock_s(self) -> float:
        """Return the clock of the motion-capture server, with which `_publish` stamps frames."""
        now_s = self.plant.t_s if self._keeper is not None else time.monotonic() - self._origin_s
        return self.faults.server_clock_s(now_s) + self._ahead_s

    @property
    def _ahead_s(self) -> float:
        return 0.0 if self.autopilot.lockstep else self.slipped_s

    def flight_environment(self) -> dict[str, str]:
        """Return the environment variables that the flight process needs for faults that hang it."""
        stalls = [fault.duration_s for fault in self._config.faults if fault.kind == "stall_loop"]
        return environment({fault.kind for fault in self._config.faults}, stalls[0] if stalls else None)

    def stop(self) -> None:
        """End `run` at the next step."""
        self._end_s = -math.inf

    def leave(self) -> None:
        """End `run` as soon as the vehicle is disarmed, or after `_LEAVE_S` if it is still armed."""
        self._leaving = True
        self._end_s = min(self._end_s, self.plant.t_s + _LEAVE_S)

    async def run(self, on_ready: Callable[[], None] = lambda: None) -> None:
        """Run the world until `stop` or `leave` ends it; call `on_ready` once the autopilot is ready to fly.

        Raises:
            Px4Error: a real PX4 cannot be started, has ended or hangs.
        """
        try:
            async with asyncio.TaskGroup() as group:
                preparing = group.create_task(self._prepare(on_ready))
                try:
                    await (self._follow_clock() if self._keeper is None else self._in_lockstep(self._keeper))
                finally:
                    if self._next_frame is not None:
                        self._next_frame.cancel()
                preparing.cancel()
        except* Px4Error as errors:
            raise errors.exceptions[0] from None

    async def _prepare(self, on_ready: Callable[[], None]) -> None:
        await self.autopilot.prepare()
        on_ready()

    @property
    def _ends(self) -> bool:
        return self.plant.t_s >= self._end_s or (self._leaving and not self.autopilot.armed)

    async def _in_lockstep(self, keeper: TimeKeeper) -> None:
        """Step, let the flight do what it does at this instant, and so on."""
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LockstepLoop)
        if self.autopilot.lockstep:  # threads of a real PX4 send its telemetry on the computer's clock
            keeper.limit_to_real_time()
        before_s = 0.0 if self.autopilot.lockstep else BEFORE_S
        keeper.set(before_s + self.plant.t_s)
        keeper.bus = self.bus
        with keeper.listening():
            while not self._ends:
                if self.autopilot.lockstep:
                    await self.autopilot.answered()
                self._sent_frame = False
                self._step()
                if self.force is not None:
                    self.force.await_arrival()
                await keeper.advance(before_s + self.plant.t_s, self._sent_frame)
                if self.bus is not None:
                    self.bus.take(keeper.bus_bytes, BUS_PATIENCE_S)
                await loop.handle_all()
                if keeper.begins():
                    plant = self.plant
                    self._start_over()
                    before_s = before_s if self.plant is plant else 0.0

    async def _follow_clock(self) -> None:
        lockstep = self.autopilot.lockstep
        origin_s = self._origin_s = time.monotonic() - self.plant.t_s
        while not self._ends:
            behind_s = time.monotonic() - origin_s - self.plant.t_s
            if behind_s > CATCH_UP_S:
                origin_s = self._origin_s = origin_s + behind_s - CATCH_UP_S
                self.slipped_s += behind_s - CATCH_UP_S
                if self.slipped_s >= self._slip_reported_s + SLIP_REPORTED_S:
                    self._slip_reported_s = self.slipped_s
                    self._on_message(WorldSlipped(self.slipped_s))
                self.autopilot.skip(behind_s - CATCH_UP_S)
                behind_s = CATCH_UP_S
            for _ in range(int(behind_s / PHYSICS_DT_S)):
                if lockstep:
                    await self.autopilot.answered()
                self._step()
            ahead_s = self.plant.t_s + PHYSICS_DT_S - (time.monotonic() - origin_s)
            await asyncio.sleep(max(0.0, ahead_s))

    def _step(self) -> None:
        plant = self.plant
        if plant.faults is not None:
            self._apply_faults()
        autopilot = self.autopilot
        if self._arm_handling is not None and not autopilot.armed:
            self._hold_arm(self._arm_handling)
        plant.step(autopilot.armed)
        if autopilot.lockstep and plant.imu_due:
            autopilot.sense(plant.sample_imu())
        ahead_s = PHYSICS_DT_S - 1e-6 if self._keeper is None else 0.0
        for leaves_s, frame in plant.mocap_until(plant.t_s + ahead_s):
            if leaves_s <= plant.t_s:
                self._publish(frame, plant.t_s)
            else:
                loop = asyncio.get_running_loop()
                self._next_frame = loop.call_at(self._origin_s + leaves_s, self._publish, frame, leaves_s)
        if self.force is not None:
            plant.force_is_read = self.force.streaming
            if self._keeper is None or self.force.due(plant.t_s) or not self.force.streaming:
                self.force.set_wrench(*plant.force_torque())
            self.force.tick(plant.t_s)
        autopilot.pump(plant.t_s, plant.battery())
        observed, armed = autopilot.observe(), autopilot.armed
        mode = None if observed.nav_state is None else observed.nav_state.name
        self._course.watch_mode(plant.t_s, mode, armed)
        if self.flight.watch(plant.t_s, *observed, armed):
            self.flight.sample(plant.truth.position_world_m, plant.truth.attitude_wxyz)
        for event in plant.scene.take_events():
            self._on_message(WorldEvent(event.kind, event.t_s))
        at_rest = not armed
        if at_rest != self._at_rest:
            self._at_rest = at_rest
            self._on_message(WorldAtRest(at_rest))

    def _hold_arm(self, hand: ArmHandling) -> None:
        servos, machine = self.servos, self.plant.machine
        held = hand.angles_rad(
            self.plant.t_s,
            not any(servo.drive.torque_on for servo in servos),
            tuple(machine.q[index] for index in machine.layout.joint_q),
            max(servo.lights for servo in servos),
            any(servo.lit for servo in servos),
        )
        if held is not None:
            machine.hold_arm(held)

    def _publish(self, frame: MocapFrame, t_s: float) -> None:
        self._sent_frame = True
        if isinstance(self.mocap, ExternalVision):
            self.mocap.publish(frame, t_s)
            return
        if self.mocap is None:
            return
        body = self._vehicle.devices.mocap.rigid_body_id
        pose = BodyPose(body, frame.position_world_m, frame.attitude_wxyz, frame.valid)
        others = [BodyPose(number, OTHER_PLACE_M, IDENTITY_QUAT) for number, _ in self._others]
        others += [
            BodyPose(number, (*frame.markers, (0.0, 0.0, 0.0))[0], IDENTITY_QUAT, bool(frame.markers))
            for number, _ in self._ball_body
        ]
        if frame.bar is not None:
            others += [BodyPose(number, *frame.bar) for number, _ in self._bar_body]
        clock, ahead_s = self.faults.server_clock_s, self._ahead_s
        sent_s = t_s - frame.network_s
        single = {"markers": frame.markers} if self._ball is not None and not self._ball_body else {}
        self.mocap.publish(clock(sent_s) + ahead_s, (*others, pose), clock(frame.exposure_t_s) + ahead_s, **single)

    def _apply_faults(self) -> None:
        plant = self.plant
        for kind in SIGNALS:
            if plant.fault(kind) is not None:
                seen = self.autopilot.observe()
                injected = self.flight.inject(kind, plant.t_s, plant.truth.position_world_m, seen.vision_received)
                if injected and self._keeper is not None:
                    self._keeper.do_not_wait_for("flight")
        self.flight.inject_others(self.faults.active.keys(), plant.t_s)
        frame = self.mocap.frame_number if isinstance(self.mocap, NatNetServer) else 0
        self._course.watch(plant, self.faults, self._vehicle.tether, frame)
        down = plant.fault("link_loss") is not None or self.autopilot.down
        self.autopilot.set_link(down, self.faults.size("link_delay"))
        if self.bus is not None:
            self.bus.damaged = self.faults.packet_lost
            self.bus.answers_late_s = self.faults.size("bus_delay")
        if self.force is not None:
            self.force.silent = plant.fault("force_loss") is not None
        fault = plant.fault("servo_loss")
        if fault is not None:
            self._lost_servo = self.servos[fault.servo - 1]
            self._lost_servo.fail_silent(True)
        elif self._lost_servo is not None:
            self._lost_servo.fail_silent(False)
            self._lost_servo = None

    def ground_truth(self) -> dict[str, Any]:
        """Return the true course of a flight with faults, for a campaign's table (file `world.json`)."""
        return {
            **self.final(),
            "armed": self.autopilot.armed,
            "fault_begun_s": self.faults.begun_s,
            **self._course.report(),
        }

    def final(self) -> dict[str, Any]:
        """Return the world's report at the end of a flight, for `summary.json`."""
        return {
            "autopilot": self.autopilot.about(),
            "payload_kg": self._config.payload_kg,
            "knobs": self._config.model_dump(mode="json"),
            **final_report(self.plant),
            "slipped_s": self.slipped_s,
            "flight_fault": self.flight.report(),
        }
