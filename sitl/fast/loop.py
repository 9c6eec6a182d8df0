"""The fast closed loop: flight core, PX4 stub, servos and world on simulated time, without sockets.

It keeps the sensor rates, quantisation, noise and delays of the real protocols and omits only their encoding.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from operator import itemgetter
from typing import Final

from msgspec.structs import replace

from companion.control.types import MakeLaw
from companion.core.flight_core import FlightCore
from companion.flight.ticker import SIMULATED_START_S
from companion.model.constants import TICK_PERIOD_S
from companion.model.frames import attitude_ned_frd_from_enu_flu, ned_from_enu
from companion.model.outputs import Outputs
from companion.model.team import Grip, PartnerState, TeamState
from companion.model.types import (
    AutopilotRequest,
    ForceSample,
    Inputs,
    MocapPose,
    OperatorCommand,
    VehicleState,
)
from companion.sitl_config.faults import FaultKind
from companion.sitl_config.loader import SitlConfig
from sitl.autopilot.backend import LINK_DELAY_S, set_hover_thrust, stub_of
from sitl.autopilot.types import AttitudeTarget
from sitl.fast.bus import FastBus, scales_of
from sitl.fast.clamp import FastClamp
from sitl.fast.guardian import TAKE_OVER_S, FastGuardian, Landing
from sitl.fast.link import FastLink
from sitl.fast.mocap import FastMocap
from sitl.fast.result import FastResult, garbage_collection_paused
from sitl.fast.telemetry import FastTelemetry
from sitl.faults.injector import Faults
from sitl.faults.timing import with_fault_times
from sitl.force_torque import TIME_EPSILON_S, overloaded, quantised
from sitl.plant import Plant
from sitl.servo.from_config import plugged_in, servos_of
from sitl.world.scene import Scene
from sitl.world.start import start_of
from sitl.world.throws import with_throws

START_S: Final = SIMULATED_START_S
"""World time at the first tick, as over the wires."""
_NO_COMMAND: Final = OperatorCommand.NONE
_NO_REQUEST: Final = AutopilotRequest.NONE
SETTLE_S: Final = 30.0
"""Longest time for which the world continues after a flight that ends while armed."""
FLIGHT_PROCESS_FAULTS: Final[frozenset[FaultKind]] = frozenset({"stall_loop", "hold_gil", "stop_flight", "kill_flight"})


class FastFlight:
    """One flight in the fast closed loop.

    Args:
        config: effective configuration; the hover thrust is the stub's MPC_THR_HOVER if the vehicle file has none.
        commands: the operator's commands, by the time on the flight clock at which each is given.
        make_law: makes the control law in place of the configured one.
        scene: the scene of which this is machine `number`; None for a scene of its own.
    """

    def __init__(
        self,
        config: SitlConfig,
        commands: Mapping[float, OperatorCommand] | None = None,
        make_law: MakeLaw | None = None,
        *,
        scene: Scene | None = None,
        number: int = 0,
    ) -> None:
        config = with_fault_times(with_throws(config))
        vehicle, world, start = config.vehicle, config.world, config.mission.start
        self._commands = sorted((commands or {}).items(), key=itemgetter(0))
        self.px4 = stub_of(world, vehicle.airframe, LINK_DELAY_S)
        servos = servos_of(vehicle, world)
        drives = [servo.drive for servo in servos]
        pose = start_of(start.position_m, start.yaw_deg, start.arm_deg)
        self._clamp = FastClamp.of(vehicle)
        jaws = None if self._clamp is None else self._clamp.drive
        self.plant = Plant(vehicle, world, self.px4, drives, pose, jaws=jaws, scene=scene, number=number)
        self.faults = Faults(
            world, self.plant.scene, self.plant.machine, self.px4, drives, vehicle.tether, clamp=self._clamp
        )
        faults = self.faults if world.faults else None
        if faults is not None:
            self.plant.inject(faults)
        self._guardian = None if faults is None else FastGuardian(vehicle, self.px4)
        self._link = FastLink(faults, self.plant.scene, self.px4, TICK_PERIOD_S)
        hover = set_hover_thrust(self.px4, world, self.plant.machine)
        if vehicle.airframe.hover_thrust is None:
            airframe = vehicle.airframe.model_copy(update={"hover_thrust": hover})
            vehicle = vehicle.model_copy(update={"airframe": airframe})
            config = config.model_copy(update={"vehicle": vehicle})
        self.config = config
        self.core = FlightCore(config.flight, make_law)
        scales = scales_of(vehicle, plugged_in(servos, world))
        watchdog_s = vehicle.arm_device.watchdog_ms * 1e-3 if drives else 0.0
        self._bus = FastBus(drives, scales, watchdog_s, faults)
        self._external = vehicle.devices.mocap.external
        """Whether another program feeds PX4 with poses: the companion receives none."""
        self._mocap = FastMocap(vehicle.devices.mocap, faults)
        force = vehicle.devices.force
        self._force_period_s = None if force is None else 1.0 / force.rate_hz
        """Period of the force sensor's samples; None if the vehicle has none."""
        self._force_due_s = 0.0
        self._force: ForceSample | None = None
        self._telemetry = FastTelemetry(self.px4, self.plant.battery, external=self._external)
        self._vehicle: VehicleState | None = None
        """PX4's state as the core has last received it."""
        self._dropped = 0
        self.partner: PartnerState | None = None
        """Newest announcement of the other vehicle of a team, as it has arrived."""
        self._result = FastResult()
        self._limit_s = self._until_mission_s = math.inf
        self._until: Callable[[Outputs], bool] | None = None
        self._period = 0
        """Number of the next tick's period; 0 before the first."""
        self._opens_s = math.inf
        self._landing: Landing | None = None
        """Time at which the guardian that has decided to land takes over, and its landing; infinite and None without one."""
        self._lands_s = 0.0
        """Time of the newest record of a landing without the flight process."""
        self._settles_until_s = math.inf
        """Time until which PX4 may finish a landing; infinite before the flight has ended."""
        self.over = False
        """Whether the flight has ended and `result` is complete."""

    def run(
        self, limit_s: float = 90.0, until_mission_s: float = math.inf, until: Callable[[Outputs], bool] | None = None
    ) -> FastResult:
        """Fly until the mission ends, a crash, world time `limit_s`, mission time `until_mission_s`, or `until` is True of a tick."""
        result = FastResult()
        with garbage_collection_paused():
            for _ in self.ticks(result, limit_s, until_mission_s, until):
                pass
        return result

    def ticks(
        self,
        result: FastResult,
        limit_s: float = 90.0,
        until_mission_s: float = math.inf,
        until: Callable[[Outputs], bool] | None = None,
    ) -> Iterator[Outputs]:
        """Fly as `run` does, and yield the outputs of each tick; `result` is complete when the iteration has ended."""
        plant, px4 = self.plant, self.px4
        scene = plant.scene
        self.begin(result, limit_s, until_mission_s, until)
        while not self.over:
            plant.act(px4.armed)
            scene.step(px4.armed)
            outputs = self.after_step()
            if outputs is not None:
                yield outputs

    def begin(
        self,
        result: FastResult,
        limit_s: float = 90.0,
        until_mission_s: float = math.inf,
        until: Callable[[Outputs], bool] | None = None,
    ) -> None:
        """Begin the flight recorded in `result`, with the arguments of `run`; then call `Plant.act`, the scene, `after_step`."""
        result.layout = self.plant.machine.layout
        self._result, self._limit_s, self._until_mission_s, self._until = result, limit_s, until_mission_s, until

    def after_step(self) -> Outputs | None:
        """Do everything that is due after a step of the scene; return the outputs of a control tick, if one was due."""
        plant = self.plant
        scene = plant.scene
        plant.mocap.sense()
        if self.over:
            return None
        if self._landing is not None or self._opens_s < math.inf:
            self._guardian_lands()
            return None
        if self._settles_until_s < math.inf:
            self._settle()
            return None
        self._receive()
        if scene.t_s < START_S - 1e-9:
            self._bus.keep_alive(scene.t_s)
            return None
        if self._period == 0:
            self._telemetry.start_sums()
            self._period = round(START_S / TICK_PERIOD_S) + 1
        if scene.t_s < self._period * TICK_PERIOD_S - 1e-9:
            return None
        self._period += 1
        outputs = self._tick()
        if not self.over and self._settles_until_s == math.inf and scene.t_s >= self._limit_s:
            self._end()
        return outputs

    def _tick(self) -> Outputs | None:
        """Run a control tick; return its outputs, or None while the flight process is stalled."""
        plant, guardian, result = self.plant, self._guardian, self._result
        scene, machine = plant.scene, plant.machine
        if guardian is not None and self._flight_process_stalled(guardian):
            if guardian.decides_to_take_over(scene.t_s, False, plant.fault("kill_flight") is not None):
                self._opens_s = self._lands_s = scene.t_s
                self._opens_s += TAKE_OVER_S
                return None
            result.after.append(machine.snapshot())
            if machine.crashed:
                self._end()
            return None
        inputs = self._inputs(len(result.inputs))
        outputs = self.core.step(inputs)
        self._carry_out(outputs)
        if guardian is not None:
            guardian.heartbeat(inputs, outputs)
            guardian.decides_to_take_over(scene.t_s, True, False)
        result.inputs.append(inputs)
        result.outputs.append(outputs)
        result.snapshots.append(machine.snapshot())
        if (
            outputs.outcome is not None
            or machine.crashed
            or outputs.mission_t_s >= self._until_mission_s
            or (self._until is not None and self._until(outputs))
        ):
            self._end()
        return outputs

    def _receive(self) -> None:
        plant = self.plant
        if plant.faults is not None:
            self._bus.step(plant.scene.t_s)
        for frame in plant.mocap.take()[-1:]:  # of frames that wait, the driver delivers the newest
            pose = self._mocap.receive(frame, plant.scene.t_s)
            self._forward(pose)
            if self._guardian is not None and not self._external:
                self._guardian.see(pose)
        if self._force_period_s is not None and plant.scene.t_s >= self._force_due_s - TIME_EPSILON_S:
            self._force_due_s += self._force_period_s
            self._sample_force()
        self._telemetry.pump(plant.scene.t_s)

    def _end(self) -> None:
        """End the flight; with faults, PX4 then finishes its landing."""
        if self._guardian is None:
            self._over()
            return
        self._result.guardian_events = self._guardian.events
        self._lands_s = self.plant.scene.t_s
        self._settles_until_s = self._lands_s + SETTLE_S
        if not self._settling():
            self._over()

    def _over(self) -> None:
        self.over, result, scene = True, self._result, self.plant.scene
        result.armed, result.crashed = self.px4.armed, self.plant.machine.crashed
        result.caught = scene.payload.caught_t_s is not None
        result.miss_m = scene.payload.miss_m

    def _sample_force(self) -> None:
        force_n, torque_nm = self.plant.force_torque()
        if self.plant.fault("force_loss") is not None:
            return
        force, torque = quantised(force_n, torque_nm)
        overload = overloaded(force_n, torque_nm)
        self._force = ForceSample(stamp_s=math.nan, force_sensor_n=force, torque_sensor_nm=torque, overload=overload)

    def _settling(self) -> bool:
        return self.px4.armed and not self.plant.machine.crashed and self.plant.scene.t_s < self._settles_until_s

    def _settle(self) -> None:
        if self._external:
            self._poses_for_guardian()
        self._record_landing()
        if not self._settling():
            self._over()

    def _record_landing(self) -> None:
        if self.plant.scene.t_s >= self._lands_s + TICK_PERIOD_S - 1e-9:
            self._lands_s += TICK_PERIOD_S
            self._result.after.append(self.plant.machine.snapshot())

    def _flight_process_stalled(self, guardian: FastGuardian) -> bool:
        """Return whether a fault stops the flight process's ticks; if only its event loop stalls, do what its bus thread does."""
        active, t_s = self.faults.active, self.plant.scene.t_s
        guardian.alive = "kill_guardian" not in active
        if "stall_loop" in active:
            self._bus.keep_alive(t_s)
        return not active.keys().isdisjoint(FLIGHT_PROCESS_FAULTS)

    def _guardian_lands(self) -> None:
        """Let the guardian land the vehicle, from `TAKE_OVER_S` after its decision."""
        scene, machine, guardian = self.plant.scene, self.plant.machine, self._guardian
        assert guardian is not None
        poses = self._poses_for_guardian()
        if self._landing is None and scene.t_s >= self._opens_s:
            self._landing = guardian.take_over(scene.t_s)
        landing = self._landing
        if landing is not None:
            landing.step(scene.t_s, poses)
        self._record_landing()
        ended = landing is not None and landing.landed is not None
        if ended or machine.crashed or scene.t_s >= self._limit_s:
            self._result.guardian_landed = landing.landed if landing is not None else False
            self._landing, self._opens_s = None, math.inf
            self._end()

    def _poses_for_guardian(self) -> list[MocapPose]:
        """Return the poses of this step; none if another program sends them to PX4 itself, which it does here."""
        plant = self.plant
        poses = [self._mocap.pose(frame, plant.scene.t_s) for frame in plant.mocap.take()]
        if not self._external:
            return poses
        for pose in poses:
            self._forward(pose)
        return []

    def _forward(self, pose: MocapPose) -> None:
        """Send a pose to PX4, as the flight process does or, on a link of its own, the other program."""
        if not (pose.tracking_valid if self._external else self.core.forwards(pose, self._vehicle)):
            return
        position, attitude = ned_from_enu(pose.position_world_m), attitude_ned_frd_from_enu_flu(pose.attitude_wxyz)
        if self._external:
            self.px4.on_vision(pose.stamp_s, position, attitude)
        elif self.faults.active.keys().isdisjoint(FLIGHT_PROCESS_FAULTS):
            self._link.send(lambda: self.px4.on_vision(self.plant.scene.t_s, position, attitude))

    def _inputs(self, tick: int) -> Inputs:
        plant, t_s = self.plant, self.plant.scene.t_s
        self._link.deliver_due()
        vehicle, status = self._link.receive(self._telemetry.vehicle(t_s), self._telemetry.status(t_s))
        guardian_ready = None
        if plant.faults is not None:
            active = plant.faults.active
            guardian_ready = "kill_guardian" not in active
            if "kill_recorder" in active or "disk_full" in active:
                self._dropped += 1
        self._vehicle = vehicle
        if self._force is not None and math.isnan(self._force.stamp_s):
            self._force = replace(self._force, stamp_s=t_s)
        due = bool(self._commands) and t_s >= self._commands[0][0]
        return Inputs(
            tick=tick,
            t_s=t_s,
            vehicle=vehicle,
            status=status,
            mocap=self._mocap.newest,
            arm=self._bus.read(t_s),
            force=self._force,
            command=self._commands.pop(0)[1] if due else _NO_COMMAND,
            recorder_dropped=self._dropped,
            guardian_ready=guardian_ready,
            estimator=self._telemetry.estimator(t_s) if self._external else None,
            markers=self._mocap.markers,
            clamp=None if self._clamp is None else self._clamp.read(t_s),
            bar=self._mocap.bar,
            partner=self.partner,
        )

    def announced(self, outputs: Outputs | None) -> TeamState | None:
        """Return what the vehicle tells its partner after this step: the core, or a landing guardian; None if there is nothing."""
        if outputs is not None:
            return outputs.team
        guardian, pose = self._guardian, self._mocap.newest
        if self._landing is None or guardian is None or not guardian.alive or pose is None:
            return None
        return TeamState(grip=Grip.FREE, holds=True, lands=True, px4_lands=True, position_world_m=pose.position_world_m)

    def _carry_out(self, outputs: Outputs) -> None:
        setpoint = outputs.attitude
        if setpoint is not None:
            target = AttitudeTarget(attitude_ned_frd_from_enu_flu(setpoint.attitude_wxyz), setpoint.thrust)
            self._link.send(lambda: self.px4.on_setpoint(self.plant.scene.t_s, target))
        self._bus.write(self.plant.scene.t_s, outputs.arm_torque_nm)
        if self._clamp is not None:
            self._clamp.write(outputs.clamp)
        if outputs.request is not _NO_REQUEST:
            self._link.request(outputs.request)
