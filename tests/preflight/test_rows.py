"""Every row of the preflight by records: a sound machine passes, and whatever can be wrong is reported by its own row, with what to
do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pytest
from msgspec.structs import replace

from companion.config.loader import FlightConfig, load_flight
from companion.model.check_row import Level, Row
from companion.model.markers import Marker, MarkerFrame
from companion.model.observations import ForceStream, Observations, StateCounts
from companion.model.types import ArmState, Vec3, VehicleState
from companion.preflight import evaluation, frames, mocap, px4
from tests.machines import overrides_with_joints
from tests.preflight import records as r
from tests.support import HOVER, ROOT
from tools.docs.preflight import ROOMS, tables
from tools.docs.tables import written


@dataclass(frozen=True)
class Case:
    """What is seen otherwise, and the row that tells it."""

    row: str
    read: str
    """Part of what the row says that it read."""
    fix: str
    """Part of what it says is to be done; empty: the device's own line says it."""
    seen: Mapping[str, Any]
    level: Level = Level.REFUSE
    vehicle: Mapping[str, Any] | None = None
    """`airframe.thrust_max_n`: changed in the vehicle file."""
    also: tuple[str, ...] = ()
    """Rows that must fail with it."""


FED: dict[str, Any] = {"mocap": (), "mocap_stream": None}
EXTERNAL = {"devices.mocap.type": "external"}
WITH_MARKER: dict[str, Any] = {"devices.mocap.ball": {"kind": "marker"}}
WITH_BAR: dict[str, Any] = {"devices.mocap.bar_id": 3}
WITH_BODY: dict[str, Any] = {"devices.mocap.ball": {"kind": "body", "id": 9}}


def force_stream(samples: int = 1000, bad_sums: int = 0, lost: str | None = None) -> dict[str, Any]:
    return {"force_stream": ForceStream(samples=samples, bad_sums=bad_sums, product="RFT60", lost=lost)}


def moved(x_m: float = 0.0, yaw_rad: float = 0.0, until: int = 620) -> tuple[VehicleState, ...]:
    """PX4's state with the first ones elsewhere."""
    q = (math.cos(yaw_rad / 2), 0.0, 0.0, math.sin(yaw_rad / 2))
    return tuple(
        replace(state, position_world_m=(-1.0 + x_m, 0.0, 0.3), attitude_wxyz=q) if i < until else state
        for i, state in enumerate(r.vehicle())
    )


def gap(after: int, gap_s: float) -> Any:
    return tuple(replace(p, stamp_s=p.stamp_s + (gap_s if i >= after else 0.0)) for i, p in enumerate(r.mocap()))


def late(share: float, late_s: float) -> tuple[VehicleState, ...]:
    every = round(1 / share)
    return tuple(
        replace(state, attitude_stamp_s=state.attitude_stamp_s + (late_s if i % every == 0 else 0.0))
        for i, state in enumerate(r.vehicle())
    )


def unsteady_clock() -> Any:
    """A server that stops for 60 ms a second and then catches up."""
    return tuple(replace(p, stamp_s=p.stamp_s + 0.06 * (i // 500)) for i, p in enumerate(r.mocap()))


def markers(*places: Vec3) -> Mapping[str, Any]:
    """100 frames with the same single markers."""
    single = tuple(Marker(position_world_m=place) for place in places)
    frames_ = [MarkerFrame(stamp_s=k / 20, exposed_s=k / 20, frame_number=k, markers=single) for k in range(100)]
    return {"markers": tuple(frames_)}


def failure(device: str) -> Mapping[str, Any]:
    return {"failures": {device: f"{device}: expected it, found nothing; plug it in"}}


WARN = Level.WARN
CASES = {
    "no PX4": Case("px4.device", "expected it, found nothing; plug", "", failure("autopilot")),
    "no heartbeat": Case("px4.heartbeat", "no heartbeat", "baud rate", {"status": ()}),
    "old heartbeat": Case("px4.heartbeat", "none for 3.0 s", "cable", {"status": r.status(heartbeat_stamp_s=4.0)}),
    "armed": Case("px4.disarmed", "armed", "disarm it", {"status": r.status(armed=True)}),
    "slow state": Case("px4.rates", "position 60,", "MAV_x_RATE", {"state_counts": StateCounts(300, 1000, 1000)}, WARN),
    "very slow state": Case("px4.rates", "IMU 20 Hz", "MAV_x_RATE", {"state_counts": StateCounts(600, 1000, 100)}),
    "no position": Case("px4.rates", "position 0,", "until it fuses", {"state_counts": StateCounts(0, 1000, 1000)}),
    "late link": Case("px4.lag", "90 ms", "other traffic", {"vehicle": late(0.05, 0.09)}, WARN),
    "no local position": Case("px4.vision", "no LOCAL_POSITION_NED", "EKF2_EV_CTRL", {"vehicle": ()}),
    "no estimator status": Case("px4.vision", "no ESTIMATOR_STATUS", "EKF2_HGT_REF", {"estimator": ()}),
    "estimate that has just come": Case("px4.vision", "just begun", "reboot", {"estimator": r.estimator()[12:]}),
    "estimate that stopped": Case("px4.vision", "has stopped", "reboot", {"vehicle": r.vehicle()[:300]}),
    "no position flag": Case("px4.vision", "no valid horizontal position", "EKF2_EV_CTRL", {"estimator": r.estimator(flags=439)}),
    "no height flag": Case("px4.vision", "no valid height", "EKF2_HGT_REF", {"estimator": r.estimator(flags=415)}),
    "flag lost for a moment": Case(
        "px4.vision",
        "no valid attitude",
        "EKF2",
        {"estimator": (*r.estimator()[:9], replace(r.estimator()[9], flags=446), *r.estimator()[10:])},
    ),
    "frozen ratios": Case(
        "px4.vision", "ratios of position are 0", "EKF2_EV_CTRL",
        {"estimator": r.estimator(position_horizontal_ratio=0.0, position_vertical_ratio=0.0)},
    ),
    "rejected": Case("px4.vision", "rejected", "EKF2", {"estimator": r.estimator(position_vertical_ratio=1.2)}),
    "ratio unknown": Case(
        "px4.vision", "ratios of position are 0", "EKF2",
        {"estimator": r.estimator(position_horizontal_ratio=math.nan, position_vertical_ratio=math.nan)},
    ),
    "inaccurate": Case("px4.vision", "0.30 m", "EKF2", {"estimator": r.estimator(position_horizontal_accuracy_m=0.3)}),
    "accuracy unknown": Case("px4.vision", "inf", "EKF2", {"estimator": r.estimator(position_vertical_accuracy_m=math.inf)}),
    "apart": Case("px4.agrees", "0.2", "EKF2_EV_CTRL", {"vehicle": moved(x_m=0.2)}),
    "turned": Case("px4.agrees", "20.", "body's axes", {"vehicle": moved(yaw_rad=math.radians(20))}, also=("frames.px4_yaw",)),
    "wandering": Case("px4.steady", "0.06", "at rest", {"vehicle": moved(x_m=0.06, until=200)}),
    "wandering yaw": Case("px4.steady", "4.", "gyros", {"vehicle": moved(yaw_rad=math.radians(4), until=200)}),
    "never in time together": Case("px4.agrees", "no state of PX4 and no pose", "rates", {"mocap": r.mocap(stamp_s=90.0)}),
    "flat battery": Case("px4.battery", "25%", "charge", {"status": r.status(battery_remaining=0.25)}),
    "battery of other cells": Case("px4.battery", "11.4 V", "cells", {"status": r.status(battery_voltage_v=11.4)}),
    "battery unknown": Case("px4.battery", "97%", "BAT1_N_CELLS", {"status": r.status(battery_voltage_v=None)}, WARN),
    "killed": Case("px4.kill_switch", "engaged", "release", {"status": r.status(system_status=8)}),
    "no kill switch": Case("px4.kill_switch", "RC_MAP_KILL_SW is 0", "assign", {"params": {**r.PARAMS, "RC_MAP_KILL_SW": 0}}),
    "radio off": Case("px4.kill_switch", "receives no radio", "switch the radio on", {"status": r.status(radio=False)}),
    "radio unknown": Case("px4.kill_switch", "receives no radio", "switch the radio on", {"status": r.status(radio=None)}),
    "no radio": Case("px4.kill_switch", "COM_RC_IN_MODE is 4", "with a radio", {"params": {**r.PARAMS, "COM_RC_IN_MODE": 4}}, WARN),
    "hover thrust doubtful": Case("px4.hover_thrust", "0.600", "hover fit", {"params": {**r.PARAMS, "MPC_THR_HOVER": 0.6}}, WARN),
    "hover thrust wrong": Case(
        "px4.hover_thrust", "0.750", "MPC_THR_HOVER", {"params": {**r.PARAMS, "MPC_THR_HOVER": 0.75}}, WARN,
        also=("px4.param.MPC_THR_HOVER",),
    ),
    "a parameter": Case("px4.param.EKF2_EV_CTRL", "0", "set EKF2_EV_CTRL to 11", {"params": {**r.PARAMS, "EKF2_EV_CTRL": 0}}),
    "another motor map": Case(
        "px4.rotors", "CA_ROTOR0 is 45 deg to the left", "select the machine's airframe",
        {"params": {**r.PARAMS, "CA_ROTOR0_PY": -0.23, "CA_ROTOR2_PY": 0.23}},
    ),
    "tether through the arm": Case(
        "tether.arm", "is not judged", "more than 0.09 m beside the arm's plane", {}, WARN,
        vehicle={"tether.attachment_body_m": (0.0, 0.0, 0.0)},
    ),
    "figures of another machine": Case(
        "mission.vehicle", "airframe.radius_m = 0.49", "add them", {"left_out": ("airframe.radius_m = 0.49",)}, WARN
    ),
    "slow bus": Case(
        "arm.bus_time", "7.3 ms (2 servos, 84 bytes at 115200 baud)", "1000000 baud", {}, vehicle={"devices.arm.baud": 115200}
    ),
    "old firmware of PX4": Case("px4.firmware", "PX4 1.13.3", "flash", {"firmware": "PX4 1.13.3 release (git 0)"}),
    "hover thrust of the vehicle file": Case(
        "px4.hover_thrust", "airframe.hover_thrust", "airframe.hover_thrust", {}, vehicle={"airframe.hover_thrust": 0.2}
    ),
    "another program feeds PX4": Case("mocap.device", "lost frames are not checked", "", FED, WARN, EXTERNAL),
    "another program, no estimator status": Case(
        "px4.vision", "no ESTIMATOR_STATUS", "start the program", {**FED, "estimator": ()}, vehicle=EXTERNAL
    ),
    "another program, wandering": Case(
        "px4.steady", "0.06", "at rest", {**FED, "vehicle": moved(x_m=0.06, until=200)}, vehicle=EXTERNAL
    ),
    "no motion capture": Case("mocap.device", "expected it", "", failure("mocap")),
    "slow": Case("mocap.rate", "120 Hz", "camera rate", {"mocap_stream": r.stream(frames=600)}, WARN),
    "very slow": Case("mocap.rate", "40 Hz", "camera rate", {"mocap_stream": r.stream(frames=200)}),
    "uneven": Case("mocap.jitter", "9", "Wi-Fi", {"mocap": gap(500, 0.09)}, WARN),
    "late frames": Case("mocap.latency", "60.0 ms", "Motive's load", {"mocap": r.mocap(latency_s=0.06)}, WARN),
    "very late frames": Case("mocap.latency", "200.0 ms", "Motive's load", {"mocap": r.mocap(latency_s=0.2)}),
    "no clock for two": Case(
        "mocap.latency", "does not stamp", "NatNet", {"mocap": r.mocap(exposure_server_s=None)}, vehicle={"devices.team": {}}
    ),
    "latency not told": Case("mocap.latency", "does not report", "NatNet", {"mocap": r.mocap(latency_s=None)}, WARN),
    "lost frames": Case("mocap.lost", "20 of 1020", "cable", {"mocap_stream": r.stream(lost=20)}, WARN),
    "many lost frames": Case("mocap.lost", "100 of 1100", "cable", {"mocap_stream": r.stream(lost=100)}),
    "seldom tracked": Case(
        "mocap.tracked", "90.0%", "markers",
        {"mocap": tuple(replace(p, tracking_valid=i % 10 != 0) for i, p in enumerate(r.mocap()))},
    ),
    "not always tracked": Case(
        "mocap.tracked", "99.9%", "markers", {"mocap": (replace(r.mocap()[0], tracking_valid=False), *r.mocap()[1:])}, WARN
    ),
    "a gap that a flight bears, in a short watch": Case(
        "mocap.tracked", "85.0%", "markers",
        {"mocap": tuple(replace(p, tracking_valid=i >= 30) for i, p in enumerate(r.mocap()[:200]))}, WARN,
    ),
    "a pose that is the same to the last bit": Case(
        "mocap.frozen", "for 5.00 s", "Motive is paused",
        {"mocap": r.mocap(position_world_m=(-1.0, 0.0, 0.3), attitude_wxyz=(1.0, 0.0, 0.0, 0.0))},
    ),
    "another body": Case("mocap.body", "others: 2, 7", "disable the others", {"mocap_stream": r.stream(other_bodies=(2, 7))}, WARN),
    "markers off": Case("mocap.ball", "no single marker in 100 frames", "unlabelled", markers(), WARN, WITH_MARKER),
    "reflections": Case(
        "mocap.ball", "3 to 3 single markers, 2 to 2 of them", "mask",
        markers((1.0, 0.0, 1.0), (0.0, 1.0, 1.0), (9.0, 0.0, 1.0)), WARN, WITH_MARKER,
    ),
    "ball that is not there": Case(
        "mocap.ball", "no rigid body 9; other bodies: 2", "devices.mocap.ball.id",
        {"mocap_stream": r.stream(other_bodies=(2,))}, WARN, WITH_BODY, (),
    ),
    "bar that is not there": Case(
        "mocap.bar", "no rigid body 3; other bodies: none", "devices.mocap.bar_id", {}, WARN, WITH_BAR,
    ),
    "ball out of sight": Case(
        "mocap.ball", "in 0% of the frames", "show the ball",
        {"mocap_stream": r.stream(other_bodies=(9,)), **markers()}, WARN, WITH_BODY,
    ),
    "bent markers": Case("mocap.error", "4.0 mm", "calibrate", {"mocap": r.mocap(marker_error_m=0.004)}, WARN),
    "stalling server": Case("mocap.clock", "jitter", "stalls", {"mocap": unsteady_clock()}, WARN),
    "another frame rate": Case(
        "mocap.clock", "5.000 ms", "rate_hz", {}, WARN, vehicle={"devices.mocap.rate_hz": 190.0}
    ),
    "paused": Case("mocap.clock", "does not advance", "paused", {"mocap": r.mocap(frame_number=5)}, WARN),
    "no arm": Case("arm.device", "expected it", "", failure("arm")),
    "another servo": Case("arm.model", "id 2: XM430-W350 (model 1020)", "servo_id", {"servos": r.servos(model=1020)}),
    "old firmware": Case("arm.firmware", "48 and 37", "Wizard", {"servos": r.servos(firmware=37)}),
    "two firmwares": Case("arm.firmware", "48 and 45", "Wizard", {"servos": r.servos(firmware=45)}, WARN),
    "another mode": Case("arm.mode", "3 (position)", "another program", {"servos": r.servos(operating_mode=3)}),
    "return delay": Case("arm.return_delay", "500 us", "start again", {"servos": r.servos(return_delay_us=500)}),
    "no watchdog": Case("arm.watchdog", "0 ms", "power", {"servos": r.servos(watchdog_ms=0)}),
    "weak servo": Case("arm.current_limit", "500 (1.75 N m)", "register 38", {"servos": r.servos(current_limit_counts=500)}),
    "low supply": Case("arm.voltage", "12.1 V and 9.6 V", "12 V", {"servos": r.servos(voltage_v=9.6)}),
    "warm": Case("arm.temperature", "66 degC", "cool", {"arm": r.arm(temperature_c=(30.0, 66.0))}, WARN),
    "hot": Case("arm.temperature", "76 degC", "cool", {"arm": r.arm(temperature_c=(76.0, 40.0))}),
    "servo error": Case("arm.error", "servo 2: overload", "companion arm reboot", {"arm": r.arm(hardware_error=(0, 32))}),
    "do not touch": Case("arm.error", "watchdog", "loose cable", {"arm": r.arm(hardware_error=(128, 0))}, WARN),
    "beyond a wall": Case(
        "arm.angles", "(30, 140)", "zero_count", {"arm": r.arm(angle_rad=(math.radians(30), r.ARM_RAD[1]))}, also=("mission.arm",)
    ),
    "sinking arm": Case(
        "arm.still", "moves by 5.0", "do not touch",
        {"arm": (*r.arm(angle_rad=(math.radians(160), r.ARM_RAD[1]))[:9], *r.arm()[9:])},
    ),
    "loose cable": Case("arm.reads", "20 of 1000", "loose cable", {"arm_reads": (1000, 20)}, WARN),
    "few cycles": Case("arm.reads", "5 of 20", "loose cable", {"arm_reads": (20, 5)}, WARN),
    "bad bus": Case("arm.reads", "200 of 1000", "loose cable", {"arm_reads": (1000, 200)}),
    "dead bus": Case("arm.reads", "0 of 0", "loose cable", {"arm_reads": (0, 0)}),
    "arm's latency timer": Case("arm.usb_latency", "16 ms", "udev", {"machine": r.machine(arm_latency_ms=16)}, WARN),
    "no force sensor": Case("force.device", "expected it", "", failure("force")),
    "vehicle without a force sensor": Case(
        "force.device", "a catch, a lost payload and a force on the empty net are not detected", "add devices.force",
        {"force": (), "force_stream": None}, WARN, vehicle={"devices.force": None},
    ),
    "vehicle with a momentum observer": Case(
        "force.device", "a momentum observer estimates the force", "compare both forces",
        {"force": (), "force_stream": None}, WARN, vehicle={"devices.force": None, "force_source": "observer"},
    ),
    "force sensor that is only logged": Case(
        "force.device", "but only logged; a momentum observer", "compare both forces", {}, WARN,
        vehicle={"force_source": "observer"},
    ),
    "force port lost": Case("force.device", "was lost", "plug", force_stream(samples=9, lost="was lost")),
    "slow force": Case("force.rate", "150 Hz", "cable", force_stream(samples=750), WARN),
    "very slow force": Case("force.rate", "50 Hz", "cable", force_stream(samples=250)),
    "too fast force": Case("force.rate", "400 Hz", "devices.force.rate_hz", force_stream(samples=2000)),
    "disturbed": Case("force.checksums", "3 wrong", "shielded", force_stream(bad_sums=3), WARN),
    "noisy": Case("force.noise", "N (one sigma)", "ground", {"force": r.force(noise_n=0.7)}, WARN),
    "very noisy": Case("force.noise", "N (one sigma)", "ground", {"force": r.force(noise_n=5.0)}),
    "overloaded": Case("force.overload", "1 of 1000", "remove the load", {"force": r.force(overload=True)}),
    "a force sensor that streams zeros": Case(
        "force.stuck", "for 5.", "power-cycle",
        {"force": tuple(replace(sample, force_sensor_n=(0.0, 0.0, 0.0)) for sample in r.force())},
    ),
    "leaning": Case("force.tare", "(13.7", "free the net", {"force": r.force(bias_n=14.0)}, WARN),
    "leaning hard": Case("force.tare", "(29.7", "net_mass_kg", {"force": r.force(bias_n=30.0)}),
    "touched": Case("force.still", "drifts by 2.", "touch", {"force": r.force(drift_n=3.0)}),
    "force's latency timer": Case("force.usb_latency", "16 ms", "udev", {"machine": r.machine(force_latency_ms=16)}, WARN),
    "weak tether": Case("tether.strength", "40 N", "stronger", {}, vehicle={"tether.load_rating_n": 40.0}),
    "vehicle without a tether": Case(
        "tether.line", "slack, tension, winding and clearance of a tether are not monitored", "add tether", {}, WARN,
        vehicle={"tether": None},
    ),
    "short tether": Case("tether.slack", "0.18 m", "nearer", {}, vehicle={"tether.length_m": 1.7}),
    "mission that cannot be flown": Case("mission.plan", "leaves the room", "correct the mission", {"plan": ("leaves the room",)}),
    "arm elsewhere": Case("mission.arm", "(150, 140)", "by hand", {"arm": r.arm(angle_rad=(math.radians(150), r.ARM_RAD[1]))}),
    "near the wall": Case("mission.room", "(-1.00,", "further in", {}, vehicle={"room.x_m": (-1.3, 2.2)}),
    "patient guardian": Case(
        "mission.takeover", "0.21 s", "raise safety.react_time_s", {}, WARN, vehicle={"safety.guardian_timeout_s": 0.11}
    ),
    "little disk": Case("machine.disk", "40 MB", "--out", {"machine": r.machine(disk_free_bytes=40_000_000)}, WARN),
    "full disk": Case("machine.disk", "20 MB", "delete", {"machine": r.machine(disk_free_bytes=20_000_000)}),
    "slow processor": Case("machine.governor", "powersave", "cpupower", {"machine": r.machine(governors=("powersave",))}, WARN),
    "normal priority": Case("machine.realtime", "refused", "limits.conf", {"machine": r.machine(realtime=None)}, WARN),
    "memory that may not stay": Case(
        "machine.memory_lock", "memory not locked", "memlock unlimited",
        {"machine": r.machine(memory_lock="memory not locked (8 kB)")}, WARN,
    ),
    "cores that are not there": Case("machine.cpus", "cores 0-3", "remove 4,6", {}, vehicle={"computer.cpus": (4, 2, 6)}),
    "no core beside the flight's": Case(
        "machine.cpus", "cores 0-3", "remove at least one core", {}, WARN, vehicle={"computer.cpus": (0, 1, 2, 3)}
    ),
    "no recorder": Case("machine.recorder", "no space", "this row names", {"recorder": "no space"}),
}  # fmt: skip


def config_with(changes: Mapping[str, Any] | None) -> FlightConfig:
    config = r.config()
    for key, value in (changes or {}).items():
        data = config.model_dump()
        part = data["vehicle"]
        *path, last = key.split(".")
        for name in path:
            part = part[name]
        part[last] = value
        config = FlightConfig.model_validate(data)
    return config


def judged(case: Case) -> dict[str, Row]:
    rows = evaluation.rows(replace(r.sound(), **case.seen), config_with(case.vehicle))
    assert len({row.id for row in rows}) == len(rows)
    return {row.id: row for row in rows}


def failed(rows: Mapping[str, Row]) -> set[str]:
    return {row.id for row in rows.values() if not row.ok}


def test_a_sound_machine_passes_every_row() -> None:
    rows = {row.id: row for row in evaluation.rows(r.sound(), r.config())}
    assert not failed(rows), [row.line() for row in rows.values() if not row.ok]
    assert set(rows) >= {check.id for check in evaluation.CHECKS} - {frames.HAND_TEST.id, mocap.BALL.id, mocap.BAR.id}
    assert all(row.read and row.why and not row.fix for row in rows.values())
    assert evaluation.unsettled(r.sound(), r.config()) is None


@pytest.mark.parametrize("name", CASES)
def test_what_is_wrong_is_reported_by_its_row(name: str) -> None:
    case = CASES[name]
    rows = judged(case)
    row = rows[case.row]
    assert not row.ok, row
    assert row.level is case.level
    assert case.read in row.read, row
    assert case.fix in row.fix, row
    assert bool(row.fix) == bool(case.fix)
    assert set(case.also) <= failed(rows)
    assert row.refuses == (case.level is Level.REFUSE)


def test_every_row_can_fail() -> None:
    here = {check.id for check in evaluation.CHECKS} - {check.id for check in frames.CHECKS}
    told = {case.row for case in CASES.values()}
    assert {row for row in told if not row.startswith(px4.PARAM_ID)} == here | {px4.FIRMWARE_ID}


# What is wrong in one place is reported in one place.
LONELY = ("killed", "no kill switch", "radio off", "no radio",
          "old heartbeat", "armed", "slow state", "flat battery", "hover thrust doubtful",
          "a parameter", "lost frames", "another body", "another mode",
          "servo error", "loose cable", "leaning hard", "overloaded", "weak tether", "arm elsewhere", "full disk", "no recorder",
          "memory that may not stay", "cores that are not there",
          "frozen ratios", "wandering")  # fmt: skip


@pytest.mark.parametrize("name", LONELY)
def test_no_other_row_fails_with_it(name: str) -> None:
    case = CASES[name]
    assert failed(judged(case)) == {case.row}


@pytest.mark.parametrize("device", ["autopilot", "mocap", "arm", "force"])
def test_a_missing_device_is_one_row_and_the_others_are_looked_at(device: str) -> None:
    gone = {
        "autopilot": {
            "firmware": None,
            "params": {},
            "vehicle": (),
            "status": (),
            "estimator": (),
            "state_counts": None,
        },
        "mocap": {"mocap": (), "mocap_stream": None},
        "arm": {"arm": (), "servos": (), "arm_reads": None},
        "force": {"force": (), "force_stream": None},
    }[device]
    seen = replace(r.sound(), **failure(device), **gone)  # type: ignore[arg-type]
    rows = evaluation.rows(seen, r.config())
    refusing = {row.id for row in rows if row.refuses}
    room = {"autopilot": "px4"}.get(device, device)
    assert refusing == {f"{room}.device"}
    assert len(rows) > 30


def test_waiting_is_worth_it_only_for_what_settles() -> None:
    young = replace(r.sound(), estimator=r.estimator(position_horizontal_accuracy_m=3.0))
    waiting = evaluation.unsettled(young, r.config())
    assert waiting is not None
    assert (waiting.what, waiting.longest_s) == ("EKF2 fuses motion capture", evaluation.SETTLE_S)
    hopeless = replace(young, failures={"arm": "gone"})
    waiting = evaluation.unsettled(hopeless, r.config())
    assert waiting is not None and waiting.longest_s == evaluation.BEGIN_S
    flat = replace(r.sound(), status=r.status(battery_remaining=0.1))
    assert evaluation.unsettled(flat, r.config()) is None


def test_what_the_vehicle_file_does_not_ask_for_is_no_warning() -> None:
    unlocked = replace(r.sound(), machine=r.machine(memory_lock="memory not locked (8 kB)"))
    rows = {row.id: row for row in evaluation.rows(unlocked, config_with({"computer.lock_memory": False}))}
    assert rows["machine.memory_lock"].ok
    assert "not requested" in rows["machine.memory_lock"].read
    own = {row.id: row for row in evaluation.rows(r.sound(), config_with({"computer.cpus": (2, 3)}))}["machine.cpus"]
    assert own.ok and (own.read, own.wanted) == ("computer.cpus 2-3", "among cores 0-3")


def test_a_row_is_one_line_with_read_wanted_and_fix() -> None:
    row = judged(CASES["flat battery"])["px4.battery"]
    assert row.line() == "battery: 25%, 16.2 V, wanted 30%, 13.2 V; charge the battery"


@pytest.mark.parametrize(
    ("ball", "seen"),
    [(WITH_MARKER, markers((1.0, 0.0, 1.0), (9.0, 0.0, 1.0))), (WITH_BODY, markers((1.0, 0.0, 1.0)))],
    ids=["marker", "body"],
)
def test_a_ball_that_is_shown_to_the_cameras_passes(ball: Mapping[str, Any], seen: Mapping[str, Any]) -> None:
    rows = judged(
        Case(
            "", "", "", {"mocap_stream": r.stream(other_bodies=(9,) if ball is WITH_BODY else ()), **seen}, vehicle=ball
        )
    )
    assert rows["mocap.ball"].ok and rows["mocap.body"].ok


def test_a_bar_in_the_stream_passes_and_is_not_taken_for_another_body() -> None:
    rows = judged(Case("", "", "", {"mocap_stream": r.stream(other_bodies=(3,))}, vehicle=WITH_BAR))
    assert rows["mocap.bar"].ok and rows["mocap.body"].ok


@pytest.mark.parametrize(("others", "ok"), [((2,), True), ((2, 7), False)])
def test_the_other_vehicle_of_a_team_is_no_body_to_disable(others: tuple[int, ...], ok: bool) -> None:
    team = {**WITH_BAR, "devices.team": {}}
    rows = judged(Case("", "", "", {"mocap_stream": r.stream(other_bodies=(3, *others))}, vehicle=team))
    assert rows["mocap.body"].ok == ok


def test_observations_of_nothing_refuse_and_do_not_fall_over() -> None:
    rows = evaluation.rows(Observations(start_s=0.0, duration_s=5.0), r.config())
    assert {"px4.heartbeat", "px4.vision", "mocap.device", "force.device"} <= {row.id for row in rows if row.refuses}


def test_the_docs_list_every_row() -> None:
    """Made by `python -m tools.docs.preflight docs/internals/preflight.md`."""
    page = (ROOT / "docs/internals/preflight.md").read_text(encoding="utf-8")
    assert written(page, tables()) == page
    told = {check.id for checks in ROOMS.values() for check in checks}
    assert told == {check.id for check in evaluation.CHECKS}
    assert all(f"| `{name}` |" in page for name in told)


def of_joints(state: ArmState, config: FlightConfig) -> ArmState:
    """The state with as many joints as the vehicle has, folded."""
    count = len(config.vehicle.arm.joints)
    fold_rad = tuple(map(math.radians, config.vehicle.fold_arm_deg))
    still, zeros = (0.0,) * count, (0,) * count
    temperature_c = (state.temperature_c[0],) * count
    return replace(
        state,
        angle_rad=fold_rad,
        velocity_rad_s=still,
        torque_nm=still,
        hardware_error=zeros,
        temperature_c=temperature_c,
    )


@pytest.mark.parametrize("count", [1, 4])
def test_every_joint_of_an_arm_is_checked(count: int) -> None:
    config = load_flight(HOVER, overrides=overrides_with_joints(count))
    states = tuple(of_joints(state, config) for state in r.sound().arm)
    servos = (r.sound().servos * count)[:count]
    seen = replace(r.sound(), arm=states, servos=servos)
    rows = {row.id: row for row in evaluation.rows(seen, config)}
    assert all(row.ok for row in rows.values() if row.id.startswith("arm.") or row.id == "mission.arm")
    beyond = tuple(replace(state, angle_rad=(*state.angle_rad[:-1], 3.5)) for state in states)
    hot = replace(servos[-1], voltage_v=5.0)
    wrong = {row.id: row for row in evaluation.rows(replace(seen, arm=beyond, servos=(*servos[:-1], hot)), config)}
    assert {id_ for id_, row in wrong.items() if row.ok is False and rows[id_].ok} == {
        "arm.angles", "arm.voltage", "mission.arm"
    }  # fmt: skip


def test_an_absent_arm_is_one_warning() -> None:
    config = load_flight(HOVER, overrides=overrides_with_joints(0))
    seen = replace(r.sound(), arm=(), servos=(), arm_reads=None)
    rows = [row for row in evaluation.rows(seen, config) if row.id.startswith("arm.") or row.id == "mission.arm"]
    assert [(row.id, row.level) for row in rows] == [("arm.device", Level.WARN)]
