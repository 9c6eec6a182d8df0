"""The fast closed loop: the same flight core, PX4 stub, servos and world, without sockets and on simulated time.

What a wire would do is kept: sensor rates, quantisation, noise, delays; what is left out is only the bytes.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

from companion.config.loader import FlightConfig
from companion.core import FlightCore
from companion.frames import (
    attitude_enu_flu_from_ned_frd,
    attitude_ned_frd_from_enu_flu,
    enu_from_ned,
    flu_from_frd,
    ned_from_enu,
)
from companion.io import dynamixel as dxl
from companion.types import (
    ArmState,
    AttitudeSetpoint,
    AutopilotRequest,
    AutopilotStatus,
    FlightMode,
    ForceSample,
    Inputs,
    LandedState,
    MocapPose,
    OperatorCommand,
    Outputs,
    VehicleState,
)
from sitl.autopilot.autopilot import Command7, Px4Stub, gains_from_params
from sitl.autopilot.cascade import Cascade
from sitl.autopilot.commander import Command
from sitl.autopilot.estimator import Estimator
from sitl.autopilot.modes import NavState
from sitl.autopilot.params import Params
from sitl.autopilot.types import AttitudeTarget
from sitl.plant import Plant
from sitl.server import start_of
from sitl.servo_model import ServoModel
from sitl.world import Truth

TICK_S = 0.005
POSITION_PERIOD_S = 1.0 / 124.0
"""As PX4 streams at most; attitude and IMU come with every tick."""
_MODES = {NavState.OFFBOARD: FlightMode.OFFBOARD, NavState.LAND: FlightMode.LAND, NavState.LOITER: FlightMode.HOLD}
_OFFBOARD_MODE: Command7 = (1.0, 6.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_NOTHING: Command7 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass
class FastResult:
    """One flight."""

    inputs: list[Inputs] = field(default_factory=list)
    outputs: list[Outputs] = field(default_factory=list)
    truth: list[Truth] = field(default_factory=list)
    crashed: bool = False
    caught: bool = False


class FastFlight:
    """One flight in the fast closed loop.

    Args:
        config: effective configuration; hover thrust is taken from the stub's MPC_THR_HOVER if absent.
        command: what the operator asks for at a flight time, for tests.
    """

    def __init__(self, config: FlightConfig, land_at_s: float | None = None) -> None:
        vehicle, world, start = config.vehicle, config.world, config.mission.start
        self._land_at_s = land_at_s
        params = Params()
        self.px4 = Px4Stub(
            params, Estimator(), Cascade(gains_from_params(params)), setpoint_delay_s=world.setpoint_delay_s + 0.002
        )
        self._servos = [ServoModel(joint.servo_id, baud_bps=vehicle.devices.arm.baud) for joint in vehicle.arm.joints]
        pose = start_of(start.position_m, start.yaw_deg, start.arm_deg)
        self.plant = Plant(vehicle, world, self.px4, self._servos, (pose.position_m, pose.yaw_rad, pose.arm_rad))
        hover = self.plant.world.hover_command * (1.0 + world.hover_thrust_error)
        params.set("MPC_THR_HOVER", hover)
        if vehicle.airframe.hover_thrust is None:
            airframe = vehicle.airframe.model_copy(update={"hover_thrust": hover})
            vehicle = vehicle.model_copy(update={"airframe": airframe})
            config = config.model_copy(update={"vehicle": vehicle})
        self.config = config
        self.core = FlightCore(config)
        self._scales = []
        for servo, joint in zip(self._servos, vehicle.arm.joints, strict=True):
            servo.write(dxl.TORQUE_ENABLE.address, b"\x00")
            servo.write(dxl.OPERATING_MODE.address, bytes([dxl.MODE_CURRENT]))
            servo.write(dxl.TORQUE_ENABLE.address, b"\x01")
            limit = struct.unpack("<H", servo.read(dxl.CURRENT_LIMIT.address, 2))[0]
            self._scales.append(dxl.joint_scale(joint, vehicle.arm.torque_per_amp_nm_a, limit))
        self._mocap: MocapPose | None = None
        self._force: ForceSample | None = None
        self._arm: ArmState | None = None
        self._position = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)
        self._heard_t_s = 0.0

    def run(self, limit_s: float = 90.0) -> FastResult:
        """Fly to the end."""
        result = FastResult()
        plant = self.plant
        tick = 0
        while plant.t_s < limit_s:
            while plant.t_s < (tick + 1) * TICK_S - 1e-9:
                plant.step(self.px4.armed)
                self._deliver()
            inputs = self._inputs(tick)
            outputs = self.core.step(inputs)
            self._carry_out(outputs)
            result.inputs.append(inputs)
            result.outputs.append(outputs)
            result.truth.append(plant.truth)
            tick += 1
            if outputs.outcome is not None or plant.world.crashed:
                break
        result.crashed = plant.world.crashed
        result.caught = plant.world.caught_t_s is not None
        return result

    def _deliver(self) -> None:
        plant = self.plant
        for frame in plant.take_mocap():
            self._mocap = MocapPose(
                stamp_s=plant.t_s,
                latency_s=plant.t_s - frame.exposure_t_s,
                frame_number=frame.number,
                position_world_m=frame.position_world_m,
                attitude_wxyz=frame.attitude_wxyz,
                tracking_valid=frame.valid,
                marker_error_m=0.0002,
            )
            if plant.fault("link_loss") is None:
                attitude = attitude_ned_frd_from_enu_flu(frame.attitude_wxyz)
                self.px4.on_vision(plant.t_s, ned_from_enu(frame.position_world_m), attitude)

    def _inputs(self, tick: int) -> Inputs:
        plant, t_s = self.plant, self.plant.t_s
        linked = plant.fault("link_loss") is None
        if linked:
            self._heard_t_s = t_s
        if plant.fault("force_loss") is None:
            force, torque = plant.force_torque()
            self._force = ForceSample(t_s, force, torque, overload=False)
        if plant.fault("servo_loss") is None:
            self._arm = self._read_arm(t_s)
        land = self._land_at_s is not None and t_s >= self._land_at_s
        return Inputs(
            tick=tick,
            t_s=t_s,
            vehicle=self._vehicle(self._heard_t_s),
            status=self._status(self._heard_t_s),
            mocap=self._mocap,
            arm=self._arm,
            force=self._force,
            command=OperatorCommand.LAND if land else OperatorCommand.NONE,
            recorder_dropped=0,
        )

    def _vehicle(self, t_s: float) -> VehicleState | None:
        estimate = self.px4.estimate
        if estimate is None or (not estimate.vision_fused and self._mocap is None):
            return None
        if t_s - self._position[2] >= POSITION_PERIOD_S - 1e-9:
            self._position = (enu_from_ned(estimate.position_ned_m), enu_from_ned(estimate.velocity_ned_m_s), t_s)
        position, velocity, stamp_s = self._position
        return VehicleState(
            position_stamp_s=stamp_s,
            attitude_stamp_s=t_s,
            imu_stamp_s=t_s,
            position_world_m=position,
            velocity_world_m_s=velocity,
            attitude_wxyz=attitude_enu_flu_from_ned_frd(estimate.attitude_ned_frd),
            angular_rate_body_rad_s=flu_from_frd(estimate.rates_frd_rad_s),
            specific_force_body_m_s2=flu_from_frd(estimate.accel_frd_m_s2),
        )

    def _status(self, t_s: float) -> AutopilotStatus:
        px4 = self.px4
        battery = self.plant.battery()
        return AutopilotStatus(
            heartbeat_stamp_s=t_s,
            armed=px4.armed,
            mode=_MODES.get(px4.nav_state, FlightMode.OTHER),
            landed=LandedState.ON_GROUND if px4.landed else LandedState.IN_AIR,
            battery_voltage_v=battery.voltage_v,
            battery_remaining=battery.remaining,
        )

    def _read_arm(self, t_s: float) -> ArmState:
        angle, velocity, torque = [], [], []
        for servo, scale in zip(self._servos, self._scales, strict=True):
            current, speed, position = struct.unpack("<hii", servo.read(dxl.PRESENT_CURRENT.address, 10))
            angle.append(scale.angle_rad(position))
            velocity.append(scale.velocity_rad_s(speed))
            torque.append(scale.torque_nm(current))
        return ArmState(
            stamp_s=t_s,
            angle_rad=(angle[0], angle[1]),
            velocity_rad_s=(velocity[0], velocity[1]),
            torque_nm=(torque[0], torque[1]),
            hardware_error=(0, 0),
            temperature_c=(35.0, 35.0),
            read_failures=0,
        )

    def _carry_out(self, outputs: Outputs) -> None:
        linked = self.plant.fault("link_loss") is None
        if outputs.attitude is not None and linked:
            self._send_attitude(outputs.attitude)
        if outputs.arm_torque_nm is not None and self.plant.fault("servo_loss") is None:
            for servo, scale, torque in zip(self._servos, self._scales, outputs.arm_torque_nm, strict=True):
                servo.write(dxl.GOAL_CURRENT.address, struct.pack("<h", scale.current_counts(torque)))
        if linked:
            self._request(outputs.request)

    def _send_attitude(self, setpoint: AttitudeSetpoint) -> None:
        attitude = attitude_ned_frd_from_enu_flu(setpoint.attitude_wxyz)
        self.px4.on_attitude_target(self.plant.t_s, AttitudeTarget(attitude, setpoint.thrust))

    def _request(self, request: AutopilotRequest) -> None:
        t_s = self.plant.t_s
        if request is AutopilotRequest.OFFBOARD:
            self.px4.on_command(t_s, Command.DO_SET_MODE, _OFFBOARD_MODE)
        elif request is AutopilotRequest.ARM:
            self.px4.on_command(t_s, Command.COMPONENT_ARM_DISARM, (1.0, *_NOTHING[1:]))
        elif request is AutopilotRequest.LAND and self.px4.nav_state is not NavState.LAND:
            self.px4.on_command(t_s, Command.NAV_LAND, _NOTHING)
        elif request is AutopilotRequest.DISARM:
            self.px4.on_command(t_s, Command.COMPONENT_ARM_DISARM, _NOTHING)
