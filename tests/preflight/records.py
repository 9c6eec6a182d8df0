"""What a preflight sees of a sound machine, 5 s of it, as plain records."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

from msgspec.structs import replace

from companion.config.loader import FlightConfig, load_flight
from companion.model.estimator import EstimatorReport
from companion.model.frames import quat_from_euler_zyx
from companion.model.observations import ForceStream, Machine, MocapStream, Observations, ServoReport, StateCounts
from companion.model.types import (
    ArmState,
    AutopilotStatus,
    FlightMode,
    ForceSample,
    Joints,
    LandedState,
    MocapPose,
    VehicleState,
)
from companion.px4 import required
from companion.px4.rotors import geometry_of
from tests.support import CATCH

START_S, SPAN_S = 2.0, 5.0
ARM_RAD: Joints = (math.radians(165.0), math.radians(140.0))
PARAMS = {
    **{one.name: one.value for one in required.WANTED if one.value is not None},
    required.HOVER: 0.49,
    required.ROTOR_COUNT: 4,
    required.RADIO: 0,
    required.KILL_CHANNEL: 7,
    **geometry_of(load_flight(CATCH).vehicle.airframe),
}
FLAGS = 447
"""As PX4 1.16 says it of a machine that stands and fuses motion capture, with a global origin."""


@cache
def config() -> FlightConfig:
    return load_flight(CATCH, overrides=["vehicle.tether.attachment_body_m=[0, -0.1, 0]"])


def wave(index: int, size: float) -> float:
    """Something like noise, the same in every run."""
    return size * ((index * 7 % 11) - 5) / 5.0


def vehicle(count: int = 620) -> tuple[VehicleState, ...]:
    return tuple(
        VehicleState(
            position_stamp_s=(t_s := START_S + (i + 1) * SPAN_S / count),
            attitude_stamp_s=t_s,
            imu_stamp_s=t_s,
            position_world_m=(-1.0 + wave(i, 0.002), wave(i + 3, 0.002), 0.30),
            velocity_world_m_s=(0.0, 0.0, 0.0),
            attitude_wxyz=quat_from_euler_zyx(0.0, 0.0, wave(i, 0.002)),
            angular_rate_body_rad_s=(0.0, 0.0, wave(i, 0.01)),
            specific_force_body_m_s2=(wave(i, 0.05), wave(i + 1, 0.05), 9.81 + wave(i + 2, 0.05)),
            boot_s=t_s + 40.0,
        )
        for i in range(count)
    )


def estimator(**changes: Any) -> tuple[EstimatorReport, ...]:
    sound = EstimatorReport(
        stamp_s=START_S,
        flags=FLAGS,
        velocity_ratio=0.0,
        position_horizontal_ratio=0.02,
        position_vertical_ratio=0.01,
        position_horizontal_accuracy_m=0.004,
        position_vertical_accuracy_m=0.005,
    )
    return tuple(replace(sound, stamp_s=START_S + 0.2 * i, **changes) for i in range(1, 26))


def mocap(count: int = 1000, **changes: Any) -> tuple[MocapPose, ...]:
    poses = (
        MocapPose(
            stamp_s=START_S + (i + 1) * SPAN_S / count + wave(i, 0.0005),
            latency_s=0.006,
            frame_number=5000 + i,
            position_world_m=(-1.0 + wave(i, 0.0004), wave(i + 5, 0.0004), 0.30),
            attitude_wxyz=quat_from_euler_zyx(0.0, 0.0, wave(i + 2, 0.001)),
            tracking_valid=True,
            marker_error_m=0.0003,
        )
        for i in range(count)
    )
    return tuple(replace(pose, **changes) for pose in poses)


def arm(**changes: Any) -> tuple[ArmState, ...]:
    sound = ArmState(
        stamp_s=START_S,
        angle_rad=ARM_RAD,
        velocity_rad_s=(0.0, 0.0),
        torque_nm=(0.0, 0.0),
        hardware_error=(0, 0),
        temperature_c=(31.0, 33.0),
        read_failures=0,
    )
    return tuple(replace(sound, **{"stamp_s": START_S + (i + 1) * SPAN_S / 700, **changes}) for i in range(700))


def servos(**changes: Any) -> tuple[ServoReport, ...]:
    """Two servos, the second one with changes."""
    sound = ServoReport(
        servo_id=1,
        model=1030,
        firmware=48,
        operating_mode=0,
        return_delay_us=0,
        current_limit_counts=1193,
        watchdog_ms=100,
        voltage_v=12.1,
    )
    return sound, replace(sound, servo_id=2, **changes)


def force(
    *, bias_n: float = 2.0, noise_n: float = 0.05, drift_n: float = 0.0, overload: bool = False
) -> tuple[ForceSample, ...]:
    return tuple(
        ForceSample(
            stamp_s=START_S + (i + 1) * SPAN_S / 1000,
            force_sensor_n=(bias_n + wave(i, noise_n) + drift_n * i / 1000, wave(i + 1, noise_n), 0.7),
            torque_sensor_nm=(0.0, 0.0, 0.0),
            overload=overload and i == 500,
        )
        for i in range(1000)
    )


def status(**changes: Any) -> tuple[AutopilotStatus, ...]:
    sound = AutopilotStatus(
        heartbeat_stamp_s=START_S + SPAN_S - 0.4,
        armed=False,
        mode=FlightMode.HOLD,
        landed=LandedState.ON_GROUND,
        battery_voltage_v=16.2,
        battery_remaining=0.97,
        radio=True,
    )
    return (replace(sound, **changes),)


def machine(**changes: Any) -> Machine:
    sound = Machine(
        disk_free_bytes=10**10,
        governors=("performance",) * 4,
        realtime="SCHED_FIFO 50",
        memory_lock=None,
        cpus=(0, 1, 2, 3),
        arm_latency_ms=1,
        force_latency_ms=None,
    )
    return replace(sound, **changes)


def stream(**changes: Any) -> MocapStream:
    return replace(MocapStream(frames=1000, lost=0, application="Motive 3.1, NatNet 4.1"), **changes)


@cache
def sound() -> Observations:
    """A machine in SITL: no hand test is required."""
    return Observations(
        start_s=START_S,
        duration_s=SPAN_S,
        firmware="PX4 1.16.1 release (git 94cb2012)",
        params=PARAMS,
        vehicle=vehicle(),
        status=status(),
        estimator=estimator(),
        mocap=mocap(),
        mocap_stream=stream(),
        arm=arm(),
        servos=servos(),
        force=force(),
        machine=machine(),
        state_counts=StateCounts(620, 1060, 1130),
        force_stream=ForceStream(samples=1000, bad_sums=0, product="RFT60-HA01, firmware V1.2.0"),
        arm_reads=(700, 0),
        mission_s=21.0,
        plan=(),
        left_out=(),
        recorder="",
    )
