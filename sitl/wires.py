"""The wires of one machine of the simulated world: its autopilot, servo bus and force sensor behind their real protocols."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from typing import Any

from companion.config.vehicle import Vehicle
from companion.model.launcher_messages import WorldAtRest, WorldMessage, WorldProgress
from companion.sitl_config.world import World as WorldConfig
from sitl.addresses import replaced, settings_of
from sitl.autopilot.backend import AutopilotBackend, StubBackend
from sitl.autopilot.mavlink import Ports as LinkPorts
from sitl.external_vision import ExternalVision
from sitl.faults.injector import Faults
from sitl.faults.processes import SIGNALS, ProcessFaults, environment
from sitl.force_torque import ForceTorqueServer
from sitl.lockstep import MachineTime
from sitl.natnet import NatNetServer
from sitl.plant import Plant
from sitl.record import TrueCourse, final_report
from sitl.servo.bus import ServoBus
from sitl.servo.from_config import jaws_servo_of, plugged_in, servos_of
from sitl.servo.model import ServoModel
from sitl.world.arm_handling import ArmHandling
from sitl.world.scene import Scene
from sitl.world.start import Start

OnMessage = Callable[[WorldMessage], None]
BUS_PATIENCE_S = 1.0
"""Wall time that bytes take at most from the companion's end of a serial line to the world's."""


@dataclass(frozen=True, slots=True)
class Ports:
    """UDP ports of the standalone simulator; 0 for any free port."""

    autopilot_local: int = 0
    autopilot_remote: int = 0
    """Port to which PX4 sends from the start; if 0, PX4 waits for the first message from a partner."""
    mocap_command: int = 0
    mocap_data: int = 0
    multicast: bool = False


class MachineWires:
    """A simulated machine and the links to its devices; `Sitl` steps it, and its motion capture sees it.

    Args:
        on_message: called with every event, as a message for the launcher.
        autopilot: a real PX4, or None for the stub.
        time: simulated time of the machine's processes; None for a world in real time.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        config: WorldConfig,
        start: Start,
        ports: Ports,
        on_message: OnMessage,
        autopilot: AutopilotBackend | None = None,
        time: MachineTime | None = None,
    ) -> None:
        self.vehicle, self.config, self.ports, self.on_message, self.time = vehicle, config, ports, on_message, time
        self.servos = servos_of(vehicle, config)
        self._jaws = jaws_servo_of(vehicle)
        self._more = () if self._jaws is None else (self._jaws,)
        self._on_bus = [*plugged_in(self.servos, config), *self._more]
        self.autopilot: AutopilotBackend = autopilot or StubBackend(
            vehicle.airframe,
            config,
            LinkPorts(ports.autopilot_local, ports.autopilot_remote),
            external_vision=vehicle.devices.mocap.external,
            in_lockstep=time is not None,
        )
        self._start = start
        self.plant: Plant
        """The machine with its sensors and motors, of `make_plant`."""
        self.faults: Faults
        self.bus: ServoBus | None = None
        """The servo bus; None if the vehicle has no arm, or while the links are not open."""
        self.vision: ExternalVision | None = None
        """The other program that feeds PX4 with poses; None if motion capture is a server, or while the links are not open."""
        self.force: ForceTorqueServer | None = None
        """The emulated force sensor; None if the vehicle has none, or while the links are not open."""
        self._arm_handling = ArmHandling(vehicle.arm, start.arm_rad) if config.arm_handling and self.servos else None
        self.flight = ProcessFaults()
        self._course = TrueCourse()
        self._at_rest = False
        self._lost_servo: ServoModel | None = None

    def make_plant(self, scene: Scene | None, number: int) -> None:
        """Make the plant, as machine `number` of a scene; None for a scene of its own."""
        vehicle, config = self.vehicle, self.config
        self.plant = Plant(
            vehicle,
            config,
            self.autopilot,
            self.servos,
            self._start,
            # In lockstep as in the fast closed loop: cameras expose at the end of a step, and all else happens there, too.
            between_steps=self.time is None,
            jaws=self._jaws,
            scene=scene,
            number=number,
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
            self._jaws,
        )
        if config.faults:
            self.plant.inject(self.faults)

    def start_over(self, scene: Scene | None, number: int) -> None:
        """Put the machine back to its beginning, after its autopilot. What the companion has set in the devices stays."""
        for servo in (*self.servos, *self._more):
            servo.drive.start_over()
        self.make_plant(scene, number)
        if self.force is not None:
            self.force.start_over()
        self._course = TrueCourse()
        self.flight.start_over()

    @contextlib.asynccontextmanager
    async def wires(self, natnet: NatNetServer | None) -> AsyncIterator[dict[str, dict[str, Any]]]:
        """Open every link and yield the addresses in the form of a vehicle file's `devices` settings.

        Args:
            natnet: the motion-capture server; None if another program feeds PX4 with poses.
        """
        device = self.vehicle.devices
        async with contextlib.AsyncExitStack() as stack:
            if device.arm is not None:
                page = None if self.time is None else self.time.page
                self.bus = await stack.enter_async_context(ServoBus(self._on_bus, page=page))
            if device.force is not None:
                sensor = ForceTorqueServer(in_lockstep=self.time is not None)
                self.force = await stack.enter_async_context(sensor)
            px4 = await stack.enter_async_context(self.autopilot.wires())
            if device.mocap.external:
                self.vision = await stack.enter_async_context(ExternalVision(self.autopilot.vision_address))
            addresses = {"autopilot": {"address": px4}} | settings_of(
                device, natnet, self.config.mocap_rate_hz, self.ports.multicast, self.bus, self.force
            )
            for text in replaced(device, addresses):
                self.on_message(WorldProgress(text))
            yield addresses

    def flight_environment(self) -> dict[str, str]:
        """Return the environment variables that the flight process needs for faults that hang it."""
        stalls = [fault.duration_s for fault in self.config.faults if fault.kind == "stall_loop"]
        return environment({fault.kind for fault in self.config.faults}, stalls[0] if stalls else None)

    def before_step(self, frame_number: int) -> None:
        """Inject the faults that are due, and hold the arm of a vehicle on the ground.

        Args:
            frame_number: number of the newest motion-capture frame; 0 without one.
        """
        if self.plant.faults is not None:
            self._apply_faults(frame_number)
        if self._arm_handling is not None and not self.autopilot.armed:
            self._hold_arm(self._arm_handling)

    def sense(self) -> None:
        """Let motion capture and a real PX4 see the machine after a step of the scene."""
        plant = self.plant
        plant.mocap.sense()
        if self.autopilot.lockstep and plant.imu_due:
            self.autopilot.sense(plant.sample_imu())

    def after_step(self) -> None:
        """Serve the force sensor and the autopilot's telemetry after a step, and watch the autopilot."""
        plant, autopilot = self.plant, self.autopilot
        if self.force is not None:
            plant.force_is_read = self.force.streaming
            if self.time is None or self.force.due(plant.t_s) or not self.force.streaming:
                self.force.set_wrench(*plant.force_torque())
            self.force.tick(plant.t_s)
        autopilot.pump(plant.t_s, plant.battery())
        observed, armed = autopilot.observe(), autopilot.armed
        mode = None if observed.nav_state is None else observed.nav_state.name
        self._course.watch_mode(plant.t_s, mode, armed)
        if self.flight.watch(plant.t_s, *observed, armed):
            self.flight.sample(plant.truth.position_world_m, plant.truth.attitude_wxyz)

    def report_rest(self) -> None:
        """Report whether the rotors stand still, if that has changed."""
        at_rest = not self.autopilot.armed
        if at_rest != self._at_rest:
            self._at_rest = at_rest
            self.on_message(WorldAtRest(at_rest))

    def take_bus(self) -> None:
        """Wait until the instructions that the flight has written to the servo bus have arrived."""
        if self.bus is not None and self.time is not None:
            self.bus.take(self.time.bus_bytes, BUS_PATIENCE_S)

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

    def _apply_faults(self, frame_number: int) -> None:
        plant = self.plant
        for kind in SIGNALS:
            if plant.fault(kind) is not None:
                seen = self.autopilot.observe()
                injected = self.flight.inject(kind, plant.t_s, plant.truth.position_world_m, seen.vision_received)
                if injected and self.time is not None:
                    self.time.do_not_wait_for("flight")
        self.flight.inject_others(self.faults.active.keys(), plant.t_s)
        self._course.watch(plant, self.faults, self.vehicle.tether, frame_number)
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

    def ground_truth(self, slipped_s: float) -> dict[str, Any]:
        """Return the true course of a flight with faults, for a campaign's table (file `world.json`)."""
        return {
            **self.final(slipped_s),
            "armed": self.autopilot.armed,
            "fault_begun_s": self.faults.begun_s,
            **self._course.report(),
        }

    def final(self, slipped_s: float) -> dict[str, Any]:
        """Return the world's report at the end of a flight, for `summary.json`."""
        return {
            "autopilot": self.autopilot.about(),
            "payload_kg": self.config.payload_kg,
            "knobs": self.config.model_dump(mode="json"),
            **final_report(self.plant),
            "slipped_s": slipped_s,
            "flight_fault": self.flight.report(),
        }
