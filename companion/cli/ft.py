"""`companion ft check`: the force sensor at rest and under a known weight. `companion ft tare`: its drift, and its own bias."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from typing import Any

from companion.commissioning.force_torque import fit as ft_fit
from companion.commissioning.force_torque.watch import FtSensor, angles_rad, arm_pose, until_hung
from companion.commissioning.sensor_report import Result, add_options, ask, finish, run_until_interrupted
from companion.config.document import ConfigError
from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle
from companion.control.manipulator import GRAVITY_M_S2
from companion.io.dynamixel.registers import usb_latency_ms
from companion.io.protocols import DeviceError
from companion.model.exit_codes import EXIT_ABORTED
from companion.model.observations import ForceStream, Observations
from companion.model.rows import Row
from companion.model.types import IDENTITY_QUAT, ArmState, ForceSample, Vec2, Vec3, VehicleState
from companion.preflight import force as preflight
from companion.preflight.arm import usb_latency
from companion.preflight.checks import Check
from companion.runtime.clock import flight_clock
from companion.runtime.console import tell

WATCH_S = 3.0
LOADED_S = 2.0
TARE_S = 1.0
"""As long as a flight tares."""
DRIFT_WARN_N_MIN = 0.3
ZERO_MAX_N = 0.3
WEIGHT_SPAN_KG = (0.1, 5.0)
SECONDS_SPAN = (5.0, 600.0)
_LEVEL_ROW = "the machine stands level on its legs"

DRIFT = Check(
    "ft.drift",
    "force sensor drift",
    "below 0.3 N in a minute",
    "what drifts after the tare is felt as a force; let the sensor warm up before a flight",
    warns=True,
)
BIAS_SET = Check(
    "ft.bias_set", "sensor's own bias", "the reading is zero right after it was set", "the sensor did not take it"
)
CHECKS = (DRIFT, BIAS_SET)


def add_parser(commands: Any) -> None:
    """Add `ft` to the sub-parsers of `companion`."""
    ft = commands.add_parser("ft", help="force sensor: check it with a known weight, its drift and bias")
    parts = ft.add_subparsers(dest="part", required=True, metavar="PART")
    check = parts.add_parser(
        "check",
        help="rate, noise, bias; with a known weight scale and direction",
        description="Watch the force sensor at rest; with --weight then under a known weight on the net. The arm hangs loose. Exit 0: "
        "fine; 3: something is wrong.",
    )
    add_options(check)
    check.add_argument(
        "--weight", type=float, metavar="KG", help="mass of what is hung on the net when it is asked for"
    )
    _add_pose(check)
    check.set_defaults(run=_check)
    tare = parts.add_parser(
        "tare",
        help="drift over a minute, and what a flight's own tare takes out",
        description="Watch the empty net. Nothing is written to the sensor unless --sensor or --clear is given. Exit 0: fine; 3: "
        "something is wrong; 4: not agreed to.",
    )
    add_options(tare, patches=False)
    tare.add_argument("--seconds", type=float, default=60.0, metavar="N", help="watch for so long (default: 60)")
    what = tare.add_mutually_exclusive_group()
    what.add_argument("--sensor", action="store_true", help="then make the present reading the sensor's own zero")
    what.add_argument("--clear", action="store_true", help="first take the sensor's own zero back")
    tare.add_argument("--yes", action="store_true", help="ask nothing")
    _add_pose(tare)
    tare.set_defaults(run=_tare)


def _add_pose(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--arm-pose",
        metavar="A1,A2",
        help="joint angles in deg, instead of reading the servos: 90,0 hangs straight down",
    )


# -- check -----------------------------------------------------------------------------------------------------------------------


def _check(arguments: argparse.Namespace) -> int:
    vehicle = load_vehicle(arguments.vehicle, arguments.overrides)
    low, high = WEIGHT_SPAN_KG
    weight_kg = arguments.weight
    if weight_kg is not None and not (math.isfinite(weight_kg) and low <= weight_kg <= high):
        raise ConfigError([f"--weight {weight_kg:g}: expected {low:g} to {high:g} kg"])
    given = _pose(arguments.arm_pose, vehicle)
    return finish(arguments, run_until_interrupted(check(vehicle, weight_kg, given)))


async def check(vehicle: Vehicle, weight_kg: float | None, given_rad: Vec2 | None) -> Result:
    """The sensor at rest, then under the weight."""
    clock, device = flight_clock(), vehicle.devices.force
    rows: list[Row] = []
    data: dict[str, Any] = {"rest": None, "weight": None}
    try:
        async with FtSensor(device, clock) as sensor, arm_pose(vehicle, clock, given_rad) as arm:
            tell(f"force sensor: {device.port}; {_LEVEL_ROW}, the net is empty, hands off for {WATCH_S:g} s")
            samples = await sensor.tare_samples(WATCH_S)
            arm_rad = await angles_rad(arm)
            rows += _at_rest(samples, sensor, vehicle, arm_rad)
            data["rest"] = _rest_json(samples, vehicle, arm_rad)
            if weight_kg is not None:
                weight_rows, changes, weight = await _weighed(sensor, samples, vehicle, weight_kg, arm)
                data["weight"] = weight
                return Result([*rows, *weight_rows], data, (), changes)
    except DeviceError as error:
        rows.append(preflight.DEVICE.bad(str(error), "", ""))
        return Result(rows, data)
    advice = ["with a known weight this tells scale and direction, too: companion ft check --weight KG"]
    return Result(rows, data, (), {}, advice)


async def _weighed(
    sensor: FtSensor, empty: list[ForceSample], vehicle: Vehicle, weight_kg: float, arm: Any
) -> tuple[list[Row], dict[Any, Any], dict[str, Any] | None]:
    weight_n = GRAVITY_M_S2 * weight_kg
    tell(
        f"hang {weight_kg:g} kg ({weight_n:.2f} N) on the net's centre and let it come to rest; it is recognised by itself"
    )
    if not await until_hung(sensor, ft_fit.mean_force(empty), weight_n):
        fix = "hang it on the net itself; a sensor that feels nothing of it has a broken cable or is by-passed by its mount"
        return [ft_fit.WEIGHT.bad("no force came and stayed", f"{weight_n:.2f} N", fix)], {}, None
    tell(f"seen; do not touch it for {LOADED_S:g} s")
    loaded = await sensor.tare_samples(LOADED_S)
    down = ft_fit.down_in_link2(await angles_rad(arm))
    pose = ft_fit.Loaded(ft_fit.mean_force(empty), ft_fit.mean_force(loaded), down)
    fit = ft_fit.fit_weight([pose], weight_kg, vehicle.tool.sensor_rpy_deg)
    tell("take the weight off")
    read = ft_fit.WEIGHT.good(f"{fit.measured_n:.2f} N")
    over = sum(sample.overload for sample in loaded)
    rows = [preflight.OVERLOAD.bad(f"{over} samples under the weight", "none", "a lighter weight")] if over else []
    return [read, *rows, *ft_fit.rows(fit)], ft_fit.changes(fit), ft_fit.as_json(fit)


def _at_rest(samples: list[ForceSample], sensor: FtSensor, vehicle: Vehicle, arm_rad: Vec2) -> list[Row]:
    """The preflight's own rows of what was watched, and whether the readings live."""
    health = sensor.health()
    product = f"{sensor.product_name}, firmware {sensor.firmware}" if sensor.firmware else sensor.product_name
    duration_s = samples[-1].stamp_s - samples[0].stamp_s
    still = VehicleState(
        0.0, 0.0, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), IDENTITY_QUAT, (0.0, 0.0, 0.0), (0.0, 0.0, GRAVITY_M_S2)
    )
    joints = ArmState(0.0, arm_rad, (0.0, 0.0), (0.0, 0.0), (0, 0), (0.0, 0.0), 0)
    observed = Observations(
        samples[0].stamp_s,
        duration_s,
        vehicle=(still,),
        arm=(joints,),
        force=tuple(samples),
        force_stream=ForceStream(len(samples) - 1, health.bad_sums, product, health.lost),
    )
    bias_fix = (
        "free the net; without a load correct tool.net_mass_kg, or loosen the sensor's mount; what then stays becomes the sensor's own "
        "zero by companion ft tare --sensor"
    )
    seen = preflight.rows(observed, vehicle)
    return [
        *(replace(row, fix=bias_fix) if row.id == preflight.TARE.id and not row.ok else row for row in seen),
        ft_fit.stuck_row(samples, vehicle),
        usb_latency(preflight.USB, usb_latency_ms(vehicle.devices.force.port)),
    ]


def _rest_json(samples: list[ForceSample], vehicle: Vehicle, arm_rad: Vec2) -> dict[str, Any]:
    duration_s = samples[-1].stamp_s - samples[0].stamp_s
    return {
        "rate_hz": (len(samples) - 1) / duration_s if duration_s > 0.0 else None,
        "mean_n": list(ft_fit.mean_force(samples)),
        "bias_n": list(_bias_n(samples, vehicle, arm_rad)),
        "arm_deg": [math.degrees(angle) for angle in arm_rad],
    }


# -- tare ------------------------------------------------------------------------------------------------------------------------


def _tare(arguments: argparse.Namespace) -> int:
    vehicle = load_vehicle(arguments.vehicle, arguments.overrides)
    low, high = SECONDS_SPAN
    if not math.isfinite(arguments.seconds) or not low <= arguments.seconds <= high:
        raise ConfigError([f"--seconds {arguments.seconds:g}: expected {low:g} to {high:g}"])
    given = _pose(arguments.arm_pose, vehicle)
    for wanted, question in (
        (arguments.sensor, "make the present reading the sensor's own zero?"),
        (arguments.clear, "take the sensor's own zero back?"),
    ):
        if wanted and not ask(question, yes=arguments.yes):
            return EXIT_ABORTED
    result = run_until_interrupted(
        tare(vehicle, arguments.seconds, given, set_zero=arguments.sensor, clear_zero=arguments.clear)
    )
    return finish(arguments, result)


async def tare(
    vehicle: Vehicle, seconds: float, given_rad: Vec2 | None, *, set_zero: bool = False, clear_zero: bool = False
) -> Result:
    """The empty net for some time; perhaps the sensor's own zero."""
    clock, device = flight_clock(), vehicle.devices.force
    samples: list[ForceSample] = []
    rows: list[Row] = []
    try:
        async with FtSensor(device, clock) as sensor, arm_pose(vehicle, clock, given_rad) as arm:
            if clear_zero:
                sensor.set_bias(False)
            tell(f"force sensor: {device.port}; {_LEVEL_ROW}, the net is empty, hands off for {seconds:g} s")
            first = await sensor.tare_samples(TARE_S)
            samples += first
            while samples[-1].stamp_s - samples[0].stamp_s < seconds:
                samples += await sensor.tare_samples(TARE_S)
            arm_rad = await angles_rad(arm)
            if set_zero:
                sensor.set_bias(True)
                await sensor.tare_samples(0.1)  # what was on its way
                rows.append(_zero_row(await sensor.tare_samples(TARE_S)))
    except DeviceError as error:
        return Result([*rows, preflight.DEVICE.bad(str(error), "", "")], {"drift": None, "tare": None})
    drifts = ft_fit.drift(samples)
    bias = _bias_n(first, vehicle, arm_rad)
    worst = max(drifts, key=lambda one: abs(one.per_minute_n))
    read, wanted = f"{abs(worst.per_minute_n):.2f} N a minute on the worst axis", f"{DRIFT_WARN_N_MIN:g} N a minute"
    drifting = abs(worst.per_minute_n) > DRIFT_WARN_N_MIN
    fix = "leave it powered for twenty minutes and do it again; keep sun and motors' heat from it"
    rows.append(DRIFT.bad(read, wanted, fix) if drifting else DRIFT.good(read, wanted))
    rows.append(ft_fit.stuck_row(samples, vehicle))
    data = {
        "drift": [
            {
                "axis": axis,
                "mean_n": d.mean_n,
                "noise_n": d.noise_n,
                "per_minute_n": d.per_minute_n,
                "standard_error_n": d.standard_error_n,
            }
            for axis, d in zip("xyz", drifts, strict=True)
        ],
        "tare": {"bias_n": list(bias), "net_mass_kg": vehicle.tool.net_mass_kg},
        "temperature_c": None,
    }
    return Result(rows, data, _tare_text(drifts, bias, vehicle))


def _tare_text(drifts: tuple[ft_fit.Drift, ...], bias: Vec3, vehicle: Vehicle) -> list[str]:
    lines = [
        f"  F{axis}  mean {d.mean_n:+7.2f} N   noise {d.noise_n:.3f} N   drift {d.per_minute_n:+.3f} +- {d.standard_error_n:.3f} "
        "N a minute"
        for axis, d in zip("xyz", drifts, strict=True)
    ]
    x, y, z = bias
    return [
        *lines,
        f"  a flight's tare takes out ({x:+.2f}, {y:+.2f}, {z:+.2f}) N beside the net's {vehicle.tool.net_mass_kg:g} kg",
        "  temperature: the sensor's protocol does not tell it",
        "",
    ]


def _zero_row(samples: list[ForceSample]) -> Row:
    left_n = math.hypot(*ft_fit.mean_force(samples))
    read, wanted = f"reads {left_n:.2f} N right after it was set", f"{ZERO_MAX_N:g} N"
    if left_n <= ZERO_MAX_N:
        return BIAS_SET.good(read, wanted)
    return BIAS_SET.bad(read, wanted, "power-cycle the sensor and do it again")


# -- both ------------------------------------------------------------------------------------------------------------------------


def _bias_n(samples: list[ForceSample], vehicle: Vehicle, arm_rad: Vec2) -> Vec3:
    """What a flight's tare takes out here: the mean reading less the net's weight."""
    from companion.control.manipulator import Manipulator
    from companion.control.sensing import ForceSensing

    sensing = ForceSensing(vehicle.tool, Manipulator(vehicle.arm, vehicle.tool))
    for sample in samples:
        sensing.collect(sample, IDENTITY_QUAT, arm_rad)
    sensing.finish_tare()
    assert sensing.bias_sensor_n is not None
    return sensing.bias_sensor_n


def _pose(text: str | None, vehicle: Vehicle) -> Vec2 | None:
    """Both angles in rad.

    Raises:
        ConfigError: not two angles within the joints' walls.
    """
    if text is None:
        return None
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError([f"--arm-pose {text}: expected two angles in deg, as 165,140"]) from None
    for angle, joint, number in zip((first, second), vehicle.arm.joints, (1, 2), strict=True):
        low, high = joint.angle_deg
        if not low <= angle <= high:
            raise ConfigError([f"--arm-pose {text}: joint {number} goes from {low:g} to {high:g} deg, got {angle:g}"])
    return (math.radians(first), math.radians(second))
