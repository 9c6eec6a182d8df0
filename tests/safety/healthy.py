"""A machine in good health, tick by tick: every value moves a little, as real ones do."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable

import msgspec

from companion.config.vehicle import Vehicle
from companion.model.estimator import EstimatorReport
from companion.model.frames import quat_from_euler_zyx
from companion.model.outputs import ControlLog, TetherState
from companion.model.types import (
    ArmState,
    AutopilotStatus,
    Chi,
    Event,
    FlightMode,
    ForceSample,
    Inputs,
    LandedState,
    MocapPose,
    OperatorCommand,
    VehicleState,
)
from companion.safety.flight_context import FlightContext
from companion.safety.monitors import Monitors

TICK_S = 0.005
START_S = 10.0
ZERO3 = (0.0, 0.0, 0.0)
ZERO8: Chi = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
SLOW = TetherState(
    range_m=1.8,
    slack_m=1.2,
    stop_slack_m=1.2,
    elevation_rad=0.5,
    clearance_m=0.3,
    turns=0.0,
    pull_n=0.0,
    taut=False,
    snagged=False,
    separated=False,
    vehicle_turns=0.0,
)
Change = Callable[[Inputs], Inputs]


@functools.lru_cache(maxsize=8192)
def healthy(tick: int = 0, t_s: float | None = None) -> Inputs:
    """In the air at (0, 0, 1), yaw 0.4; `t_s` for ticks that do not come every 5 ms."""
    t_s = START_S + tick * TICK_S if t_s is None else t_s
    d = 1e-4 * ((tick * 7) % 11 - 5)
    position = (d, -d, 1.0 + d)
    attitude = quat_from_euler_zyx(d, -d, 0.4 + d)
    return Inputs(
        tick=tick,
        t_s=t_s,
        vehicle=VehicleState(
            position_stamp_s=t_s,
            attitude_stamp_s=t_s,
            imu_stamp_s=t_s,
            position_world_m=position,
            velocity_world_m_s=(0.05, d, d),
            attitude_wxyz=attitude,
            angular_rate_body_rad_s=(0.06, d, d),
            specific_force_body_m_s2=(d, d, 9.81 + d),
            boot_s=t_s,
            imu_boot_s=t_s,
            delta_velocity_body_m_s=(0.0, 0.0, 9.81 * t_s),
        ),
        status=AutopilotStatus(
            heartbeat_stamp_s=t_s,
            armed=True,
            mode=FlightMode.OFFBOARD,
            landed=LandedState.IN_AIR,
            battery_voltage_v=15.8,
            battery_remaining=0.9,
        ),
        mocap=MocapPose(
            stamp_s=t_s,
            latency_s=0.005,
            frame_number=tick,
            position_world_m=position,
            attitude_wxyz=attitude,
            tracking_valid=True,
            marker_error_m=0.0002,
            exposure_server_s=t_s - 0.005,
        ),
        arm=ArmState(
            stamp_s=t_s,
            angle_rad=(2.0 + d, 1.0 - d),
            velocity_rad_s=(d, d),
            torque_nm=(0.5 + d, 0.2 - d),
            hardware_error=(0, 0),
            temperature_c=(35.0, 35.0),
            read_failures=0,
        ),
        force=ForceSample(stamp_s=t_s, force_sensor_n=(1.0 + d, -1.0, 0.5), torque_sensor_nm=(d, d, d), overload=False),
        command=OperatorCommand.NONE,
        recorder_dropped=0,
    )


def fed_by_another(i: Inputs) -> Inputs:
    """The same machine if another program feeds PX4: no motion capture, but the report of PX4's estimator."""
    report = EstimatorReport(
        stamp_s=i.t_s,
        flags=831,
        velocity_ratio=0.0,
        position_horizontal_ratio=0.05,
        position_vertical_ratio=0.04,
        position_horizontal_accuracy_m=0.005,
        position_vertical_accuracy_m=0.005,
    )
    return msgspec.structs.replace(i, mocap=None, estimator=i.estimator or report)


def flying(**changes: object) -> FlightContext:
    context = FlightContext(
        airborne=True, offboard_expected=True, tracking_error_m=0.02, control=control(), tether=SLOW
    )
    return dataclasses.replace(context, **changes)  # type: ignore[arg-type]


def standing(**changes: object) -> FlightContext:
    return dataclasses.replace(FlightContext(False, False, None), **changes)  # type: ignore[arg-type]


def control(**changes: object) -> ControlLog:
    log = ControlLog(
        error=ZERO8,
        error_rate=ZERO8,
        sliding=ZERO8,
        gamma=ZERO8,
        tau=ZERO8,
        e_tau=ZERO8,
        h_hat=(0.0, 0.0, 0.0, 0.0),
        zeta=0.0,
        rho=0.0,
        force_ext_world_n=ZERO3,
        attitude_desired_rad=ZERO3,
        hover_thrust=0.5,
        saturated=(False, False, False),
    )
    return msgspec.structs.replace(log, **changes)


def put(part: str, **fields: object) -> Change:
    """Replace fields of one part of the inputs: put("arm", read_failures=9)."""

    def change(i: Inputs) -> Inputs:
        return msgspec.structs.replace(i, **{part: msgspec.structs.replace(getattr(i, part), **fields)})

    return change


def stopped(*parts: str) -> Change:
    """These parts stay as they were at the start, stamps and all."""
    frozen = healthy()
    return lambda i: msgspec.structs.replace(i, **{part: getattr(frozen, part) for part in parts})


def watched(
    vehicle: Vehicle, inputs: Iterable[Inputs], context: FlightContext, monitors: Monitors | None = None
) -> list[Event]:
    """Events of a whole stream."""
    monitors = monitors or Monitors(vehicle)
    return [event for i in inputs for event in monitors.check(i, context)]


def after_a_moment(change: Change, ticks: int = 700, sound: int = 3) -> list[Inputs]:
    """Some healthy ticks, then changed ones: 3.5 s."""
    return [healthy(k) if k < sound else change(healthy(k)) for k in range(ticks)]
