"""A fabricated flight with the shape of the paper's scenario; trial data for the log, the metrics and the plots."""

from __future__ import annotations

import json
import math
import random
import select
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from companion.analysis.log import FlightLog
from companion.model.frames import quat_from_euler_zyx
from companion.model.outputs import ControlLog, Outputs, Sent
from companion.model.types import (
    ArmState,
    AttitudeSetpoint,
    AutopilotRequest,
    AutopilotStatus,
    Event,
    FlightMode,
    ForceSample,
    Inputs,
    Joints,
    LandedState,
    MocapPose,
    OperatorCommand,
    Outcome,
    PhaseKind,
    Reference,
    SafetyAction,
    Severity,
    Vec3,
    VehicleState,
)
from companion.recorder.client import RecorderProcess, RecorderReport

RATE_HZ = 200.0
GROUND_S = 1.0
TAKEOFF_S = 3.0
CATCH_S = 6.5
FLIGHT_END_S = 12.0
LANDED_S = 14.0
FOLDED_RAD: Joints = (math.radians(165), math.radians(140))
CATCH_RAD: Joints = (math.radians(100), math.radians(60))

CONFIG: dict[str, Any] = {
    "vehicle": {
        "arm": {"link_lengths_m": [0.2, 0.2]},
        "name": "test rig",
        "tether": {"anchor_world_m": [-2.0, 0.0, 3.0], "length_m": 4.5, "attachment_body_m": [0.0, 0.0, 0.1]},
        "airframe": {"mass_kg": 3.0},
    },
    "controller": {
        "law": "adaptive",
        "preset": "recommended",
        "inertia_md": [3.0, 3.0, 3.0, 0.1, 0.1, 0.1, 0.1, 0.1],
        "damping_kd": [40.0, 40.0, 40.0, 2.0, 2.0, 2.0, 1.0, 1.0],
        "phi": [2.0, 2.0, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0],
    },
    "mission": {"name": "catch"},
    "world": {"payload_kg": 0.2},
}


def _blend(x: float) -> float:
    x = min(1.0, max(0.0, x))
    return x * x * x * (10.0 - 15.0 * x + 6.0 * x * x)


def _mix(a: float, b: float, share: float) -> float:
    return a + (b - a) * share


def phase_at(mission_t_s: float) -> tuple[str, PhaseKind]:
    if mission_t_s < TAKEOFF_S:
        return "take-off", PhaseKind.TAKEOFF
    if mission_t_s < 9.0:
        return "catch", PhaseKind.FLIGHT
    if mission_t_s < FLIGHT_END_S:
        return "return", PhaseKind.FLIGHT
    return ("land", PhaseKind.LANDING) if mission_t_s < LANDED_S else ("done", PhaseKind.DONE)


def reference_at(t_s: float) -> tuple[Vec3, Joints]:
    up = _blend(t_s / TAKEOFF_S) - _blend((t_s - FLIGHT_END_S) / (LANDED_S - FLIGHT_END_S))
    x = -1.0 + 2.0 * _blend((t_s - 3.5) / 6.0) - 2.0 * _blend((t_s - 9.5) / 2.5)
    open_ = _blend((t_s - 3.5) / 2.0) - _blend((t_s - 10.0) / 2.0)
    arm = (_mix(FOLDED_RAD[0], CATCH_RAD[0], open_), _mix(FOLDED_RAD[1], CATCH_RAD[1], open_))
    return (x, 0.0, 0.15 + 0.85 * up), arm


def synthetic_flight(end_s: float = LANDED_S, rate_hz: float = RATE_HZ) -> Iterator[tuple[Inputs, Outputs, Sent]]:
    """Ticks up to `end_s` of the mission clock."""
    noise = random.Random(1)
    period_s = 1.0 / rate_hz
    caught = False
    last_kind: PhaseKind | None = None
    for tick in range(round((GROUND_S + end_s) * rate_hz) + 1):
        t_s = tick * period_s
        mission_t_s = max(0.0, t_s - GROUND_S)
        name, kind = ("ground", PhaseKind.GROUND) if t_s < GROUND_S else phase_at(mission_t_s)
        position, arm = reference_at(mission_t_s)
        after_s = mission_t_s - CATCH_S
        kick = math.exp(-after_s / 0.8) * math.sin(4.0 * after_s) if after_s > 0 else 0.0
        error: Vec3 = (
            -0.05 * kick + noise.gauss(0, 1e-3),
            0.006 * math.sin(t_s) + noise.gauss(0, 1e-3),
            -0.06 * kick + noise.gauss(0, 1e-3),
        )
        tilt = 0.05 * math.sin(0.9 * t_s) + 0.06 * kick
        actual = (position[0] + error[0], position[1] + error[1], position[2] + error[2])
        attitude = quat_from_euler_zyx(noise.gauss(0, 2e-3), tilt + noise.gauss(0, 2e-3), noise.gauss(0, 2e-3))
        joints = (arm[0] + 0.08 * kick + noise.gauss(0, 1e-3), arm[1] - 0.05 * kick + noise.gauss(0, 1e-3))
        events: tuple[Event, ...] = ()
        if kind is not last_kind and kind is not PhaseKind.GROUND:
            events += (
                Event(
                    t_s=t_s,
                    id=f"phase_{kind.value}",
                    severity=Severity.INFO,
                    action=SafetyAction.NOMINAL,
                    text=f"phase {name}",
                ),
            )
        last_kind = kind
        if not caught and after_s >= 0:
            caught = True
            events += (
                Event(
                    t_s=t_s, id="catch", severity=Severity.INFO, action=SafetyAction.NOMINAL, text="payload in the net"
                ),
            )
        load_n = 2.0 * (1.0 - math.exp(-max(0.0, after_s) / 0.05)) + 14.0 * max(0.0, kick) ** 8
        velocity: Vec3 = (0.0, 0.0, 0.0)
        inputs = Inputs(
            tick=tick,
            t_s=t_s,
            vehicle=VehicleState(
                position_stamp_s=t_s - 0.004,
                attitude_stamp_s=t_s - 0.002,
                imu_stamp_s=t_s - 0.002,
                position_world_m=actual,
                velocity_world_m_s=velocity,
                attitude_wxyz=attitude,
                angular_rate_body_rad_s=velocity,
                specific_force_body_m_s2=(0.0, 0.0, 9.81),
            ),
            status=AutopilotStatus(
                heartbeat_stamp_s=float(math.floor(t_s)),
                armed=kind is not PhaseKind.GROUND,
                mode=FlightMode.OFFBOARD,
                landed=LandedState.IN_AIR,
                battery_voltage_v=15.8,
                battery_remaining=0.9,
            ),
            mocap=MocapPose(
                stamp_s=t_s - 0.003,
                latency_s=0.002,
                frame_number=tick,
                position_world_m=actual,
                attitude_wxyz=attitude,
                tracking_valid=True,
                marker_error_m=2e-4,
            ),
            arm=ArmState(
                stamp_s=t_s + 4e-4,
                angle_rad=joints,
                velocity_rad_s=(0.0, 0.0),
                torque_nm=(0.1, 0.05),
                hardware_error=(0, 0),
                temperature_c=(31.0, 30.0),
                read_failures=0,
                written_s=t_s - period_s + 4e-4 + 1.5e-3,
            ),
            force=ForceSample(
                stamp_s=t_s - 0.002,
                force_sensor_n=(noise.gauss(0, 0.05), 0.0, -load_n),
                torque_sensor_nm=(0.0, 0.0, 0.0),
                overload=False,
            ),
            command=OperatorCommand.NONE,
            recorder_dropped=0,
        )
        rho = 1.0 + 3.0 * abs(kick)
        control = ControlLog(
            error=(*error, 0.0, 0.0, 0.0, joints[0] - arm[0], joints[1] - arm[1]),
            error_rate=(0.0,) * 8,
            sliding=(2 * error[0], 2 * error[1], 3 * error[2], 0.0, 0.0, 0.0, 0.24 * kick, -0.15 * kick),
            gamma=(0.0,) * 8,
            tau=(-8 * error[0], -8 * error[1], 29.43 - 20 * error[2], 0.0, 0.0, 0.0, 0.35 + kick, 0.1 - 0.5 * kick),
            e_tau=(0.0,) * 8,
            h_hat=(0.1 * rho, 0.2 * rho, 0.05 * rho, 0.02 * rho),
            zeta=0.1 * math.exp(-t_s / 10),
            rho=rho,
            force_ext_world_n=(0.0, 0.0, -load_n),
            attitude_desired_rad=(0.0, tilt, 0.0),
            hover_thrust=0.5,
            saturated=(False, abs(kick) > 0.6, False),
        )
        flying = kind not in (PhaseKind.GROUND, PhaseKind.DONE)
        outputs = Outputs(
            tick=tick,
            t_s=t_s,
            mission_t_s=mission_t_s,
            phase=name,
            phase_kind=kind,
            progress=min(1.0, mission_t_s / LANDED_S),
            reference=Reference(
                position_world_m=position,
                velocity_world_m_s=velocity,
                acceleration_world_m_s2=velocity,
                yaw_rad=0.0,
                yaw_rate_rad_s=0.0,
                arm_rad=arm,
                arm_rate_rad_s=(0.0, 0.0),
                arm_acceleration_rad_s2=(0.0, 0.0),
                jerk_world_m_s3=(0.0, 0.0, 0.0),
            )
            if flying
            else None,
            attitude=AttitudeSetpoint(quat_from_euler_zyx(0.0, tilt, 0.0), 0.5 + 0.02 * kick) if flying else None,
            arm_torque_nm=(0.35 + kick, 0.1 - 0.5 * kick) if flying else None,
            request=AutopilotRequest.NONE,
            action=SafetyAction.NOMINAL,
            events=events,
            control=control if flying else None,
            outcome=Outcome.COMPLETED if kind is PhaseKind.DONE else None,
            mocap_trusted=True,
            limited_by=(),
        )
        late_s = abs(noise.gauss(0, 6e-4))
        start_s = t_s + late_s
        written: Joints | None = (
            None if outputs.arm_torque_nm is None else (round(0.35 + kick, 2), round(0.1 - 0.5 * kick, 2))
        )
        core_s = start_s + 9e-4 + abs(noise.gauss(0, 1e-4))
        sent = Sent(
            tick=tick,
            attitude_sent=flying,
            arm_torque_sent_nm=written,
            start_s=start_s,
            lateness_s=late_s,
            joint_read_s=start_s + 8e-4,
            core_s=core_s,
            setpoint_sent_s=core_s + 1e-4,
            current_sent_s=core_s + 2e-4,
        )
        yield inputs, outputs, sent


def sent_at(tick: int, t_s: float) -> Sent:
    """Return plausible times: the fast loop has no wires."""
    return Sent(
        tick=tick,
        attitude_sent=True,
        start_s=t_s - 0.0008,
        lateness_s=0.0003,
        joint_read_s=t_s,
        core_s=t_s + 0.0002,
        setpoint_sent_s=t_s + 0.0004,
        current_sent_s=t_s + 0.0003,
    )


def log_of_rows(
    rows: Iterable[tuple[Inputs, Outputs, Sent]],
    config: dict[str, Any] = CONFIG,
    *,
    path: str = "flight.mcap",
    about: dict[str, str] | None = None,
) -> FlightLog:
    """Return ticks in memory as a closed log; `about` is its metadata record `companion`."""
    inputs, outputs, sent = zip(*rows, strict=True)
    metadata = {"companion": about or {}, "config": {"json": json.dumps(config)}}
    return FlightLog(path=Path(path), inputs=inputs, outputs=outputs, sent=sent, metadata=metadata, closed=True)


def record_flight(
    path: Path, *, config: dict[str, Any] | None = CONFIG, end_s: float = LANDED_S, rate_hz: float = RATE_HZ
) -> RecorderReport:
    """Write a synthetic flight through the real recorder process."""
    config_json = "" if config is None else json.dumps(config)
    return record_rows(path, synthetic_flight(end_s=end_s, rate_hz=rate_hz), config_json)


def record_rows(path: Path, rows: Iterable[tuple[Inputs, Outputs, Sent]], config_json: str) -> RecorderReport:
    """Write ticks through the real recorder process."""
    recorder = RecorderProcess.start(path, config_json=config_json, epoch_offset_ns=1_700_000_000_000_000_000)
    for inputs, outputs, sent in rows:
        # Faster than real time the channel would drop, as it must in flight; here every tick matters.
        select.select([], [recorder.client], [], 60.0)
        recorder.client.record(inputs, outputs, sent)
    return recorder.finish(60.0)


def with_joints(row: tuple[Inputs, Outputs, Sent], count: int) -> tuple[Inputs, Outputs, Sent]:
    """Return the tick as of an arm with so many joints: surplus values are cut off, missing ones repeat the last; 0: no arm."""
    inputs, outputs, sent = row

    def joints(values: Any) -> Any:
        return (tuple(values) + (values[-1],) * count)[:count]

    def rows(values: Any) -> Any:
        return values[:6] + joints(values[6:])

    arm, reference, control = inputs.arm, outputs.reference, outputs.control
    if arm is not None:
        measured = ("angle_rad", "velocity_rad_s", "torque_nm", "hardware_error", "temperature_c")
        arm = msgspec.structs.replace(arm, **{key: joints(getattr(arm, key)) for key in measured}) if count else None
    if reference is not None:
        planned = ("arm_rad", "arm_rate_rad_s", "arm_acceleration_rad_s2")
        reference = msgspec.structs.replace(reference, **{key: joints(getattr(reference, key)) for key in planned})
    if control is not None:
        chi = ("error", "error_rate", "sliding", "gamma", "tau", "e_tau")
        control = msgspec.structs.replace(control, **{key: rows(getattr(control, key)) for key in chi})
    torque, written = outputs.arm_torque_nm, sent.arm_torque_sent_nm
    return (
        msgspec.structs.replace(inputs, arm=arm),
        msgspec.structs.replace(
            outputs, reference=reference, control=control, arm_torque_nm=joints(torque) if torque is not None else None
        ),
        msgspec.structs.replace(sent, arm_torque_sent_nm=joints(written) if written is not None and count else None),
    )
