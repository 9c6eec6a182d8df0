"""`companion ft check`: measure the force sensor at rest and with a known weight. `companion ft tare`: measure its drift and set
its own zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Final

import msgspec

from companion.commissioning.force_torque import fit as ft_fit
from companion.commissioning.force_torque.watch import (
    arm_angles,
    force_device,
    pose_rad,
    tool_of,
    until_loaded,
)
from companion.commissioning.tool import SENSORS, Cancelled, Report, Session, Tool
from companion.config.device_plugins import RFT60
from companion.config.document import ConfigError
from companion.config.vehicle import Vehicle
from companion.io.dynamixel.port import usb_latency_ms
from companion.io.force_torque.driver import RobotousForceTorque
from companion.io.force_torque.plugin_driver import open_force
from companion.io.protocols import DeviceError
from companion.model.check_row import Row
from companion.model.constants import GRAVITY_M_S2
from companion.model.observations import ForceStream
from companion.model.types import IDENTITY_QUAT, ForceSample, Joints
from companion.preflight import force as preflight
from companion.preflight.arm import usb_latency
from companion.preflight.checks import Check
from companion.preflight.force import mean_force_n, tare_bias_n
from companion.runtime.clock import flight_clock

WATCH_S: Final = 3.0
LOADED_S: Final = 2.0
TARE_S: Final = 1.0
"""Duration of a flight's tare."""
DRIFT_WARN_N_MIN: Final = 0.3
ZERO_MAX_N: Final = 0.3
_EMPTY: Final = "leave the vehicle level on its landing gear, and the net empty and untouched,"

DRIFT = Check(
    "ft.drift",
    "force sensor drift",
    why="drift after the tare looks like a force; let the sensor warm up before a flight",
    warns=True,
)
BIAS_SET = Check("ft.bias_set", "sensor's own bias", why="the sensor ignored the command")


@dataclass(frozen=True, slots=True)
class Watched:
    """Measurement of the sensor at rest and, if requested, with a known weight."""

    empty: Sequence[ForceSample]
    arm_rad: Joints
    stream: ForceStream
    usb_latency_ms: int | None
    weight_kg: float | None
    """Known weight given by the user; None if none was given."""
    loaded: Sequence[ForceSample] = ()
    """Samples with the weight on the net; empty if no weight was detected."""
    loaded_arm_rad: Joints = ()
    problem: str = ""
    """Why a device failed after the measurement at rest; empty if none did."""


async def watch(session: Session) -> Watched:
    """Measure the sensor at rest, then with the known weight if one was given."""
    vehicle, weight_kg = session.vehicle, session.arguments.weight
    clock, device = flight_clock(), force_device(vehicle)
    given_rad = pose_rad(session.arguments.arm_pose, vehicle)
    async with open_force(device, clock) as sensor, arm_angles(vehicle, clock, given_rad) as angles_rad:
        session.say(f"force sensor: {device.port or device.type}; {_EMPTY} for {WATCH_S:g} s")
        empty = await sensor.tare_samples(WATCH_S)
        health = sensor.counts()
        product = f"{sensor.product_name}, firmware {sensor.firmware}" if sensor.firmware else sensor.product_name
        stream = ForceStream(samples=len(empty) - 1, bad_sums=health.bad_sums, product=product, lost=health.lost)
        seen = Watched(
            empty=empty,
            arm_rad=await angles_rad(),
            stream=stream,
            usb_latency_ms=usb_latency_ms(device.port),
            weight_kg=weight_kg,
        )
        if weight_kg is None:
            return seen
        try:
            weight_n = GRAVITY_M_S2 * weight_kg
            session.say(
                f"hang {weight_kg:g} kg ({weight_n:.2f} N) on the net's centre and let it come to rest; it is detected automatically"
            )
            if not await until_loaded(sensor, mean_force_n(empty), weight_n):
                return seen
            session.say(f"weight detected; do not touch it for {LOADED_S:g} s")
            loaded = await sensor.tare_samples(LOADED_S)
            seen = replace(seen, loaded=loaded, loaded_arm_rad=await angles_rad())
            session.say("remove the weight")
        except DeviceError as error:
            return replace(seen, problem=str(error))
        return seen


def judge(seen: Watched, vehicle: Vehicle) -> Report:
    """Return the report on the sensor at rest, and on scale and direction if a weight was given."""
    rows = _rest_rows(seen, vehicle)
    duration_s = seen.empty[-1].stamp_s - seen.empty[0].stamp_s
    rest = {
        "rate_hz": (len(seen.empty) - 1) / duration_s if duration_s > 0.0 else None,
        "mean_n": list(mean_force_n(seen.empty)),
        "bias_n": list(tare_bias_n(seen.empty, vehicle, IDENTITY_QUAT, seen.arm_rad)),
        "arm_deg": [math.degrees(angle) for angle in seen.arm_rad],
    }
    data = {"rest": rest, "weight": None}
    if seen.problem:
        return Report([*rows, preflight.DEVICE.bad(seen.problem)], data)
    if seen.weight_kg is None:
        return Report(
            rows, data, advice=["to check scale and direction with a known weight: companion ft check --weight KG"]
        )
    if not seen.loaded:
        fix = "hang the weight on the net itself; if that changes nothing, the sensor's cable is broken or its mount is bypassed"
        wanted = f"{GRAVITY_M_S2 * seen.weight_kg:.2f} N"
        return Report([*rows, ft_fit.WEIGHT.bad("no steady force appeared", wanted, fix)], data)
    fit = ft_fit.fit_weight(
        mean_force_n(seen.empty),
        mean_force_n(seen.loaded),
        ft_fit.down_at_tip(vehicle, seen.loaded_arm_rad),
        seen.weight_kg,
        tool_of(vehicle).sensor_rpy_deg,
    )
    rows.append(ft_fit.WEIGHT.good(f"{fit.measured_n:.2f} N"))
    if over := sum(sample.overload for sample in seen.loaded):
        rows.append(preflight.OVERLOAD.bad(f"{over} samples with the weight", "none", "use a lighter weight"))
    return Report([*rows, *ft_fit.rows(fit)], {**data, "weight": ft_fit.as_json(fit)}, changes=ft_fit.changes(fit))


def _rest_rows(seen: Watched, vehicle: Vehicle) -> list[Row]:
    samples, tool = seen.empty, tool_of(vehicle)
    duration_s = samples[-1].stamp_s - samples[0].stamp_s
    bias_fix = (
        f"free the {tool.kind}; if it is free, correct tool.{tool.mass_key} or loosen the sensor's mount, then remove the remaining "
        "force with companion ft tare --sensor"
    )
    return [
        *(
            msgspec.structs.replace(row, fix=bias_fix) if row.id == preflight.TARE.id and not row.ok else row
            for row in preflight.stream_rows(
                seen.stream, samples, duration_s, vehicle, force_device(vehicle), (IDENTITY_QUAT, seen.arm_rad)
            )
        ),
        usb_latency(preflight.USB, seen.usb_latency_ms),
    ]


@dataclass(frozen=True, slots=True)
class Tared:
    """Samples with an empty net, before and after the sensor's own zero was set."""

    samples: Sequence[ForceSample]
    first: Sequence[ForceSample]
    """The first samples, as many as the tare of a flight uses."""
    arm_rad: Joints
    zeroed: Sequence[ForceSample] = ()
    """Samples after the sensor's own zero was set; empty if it was not."""


async def watch_drift(session: Session) -> Tared:
    """Measure with an empty net; set or clear the sensor's own zero on request."""
    arguments, vehicle = session.arguments, session.vehicle
    given_rad, device = pose_rad(arguments.arm_pose, vehicle), force_device(vehicle)
    if (arguments.sensor or arguments.clear) and device.type != RFT60:
        option = "--sensor" if arguments.sensor else "--clear"
        text = f"{option}: only the {RFT60} has a zero of its own to set; devices.force.type is {device.type}"
        raise ConfigError(f"companion ft tare: {text}")
    if arguments.clear and not session.confirm("clear the sensor's own zero?"):
        raise Cancelled("nothing was written to the sensor")
    clock = flight_clock()
    async with open_force(device, clock) as sensor, arm_angles(vehicle, clock, given_rad) as angles_rad:
        if arguments.clear and isinstance(sensor, RobotousForceTorque):
            await sensor.set_bias(False)
        session.say(f"force sensor: {device.port or device.type}; {_EMPTY} for {arguments.seconds:g} s")
        first = await sensor.tare_samples(TARE_S)
        samples = list(first)
        while samples[-1].stamp_s - samples[0].stamp_s < arguments.seconds:
            samples += await sensor.tare_samples(TARE_S)
        seen = Tared(samples, first, await angles_rad())
        if not (arguments.sensor and isinstance(sensor, RobotousForceTorque)):
            return seen
        if not arguments.yes:
            session.show(judge_drift(seen, vehicle))
        if not session.confirm("set the sensor's own zero to the current reading?"):
            raise Cancelled("nothing was written to the sensor")
        await sensor.set_bias(True)
        return replace(seen, zeroed=await sensor.tare_samples(TARE_S))


def judge_drift(seen: Tared, vehicle: Vehicle) -> Report:
    """Return the report on the drift of each axis, and on whether the sensor's own zero was set."""
    rows = []
    if seen.zeroed:
        left_n = math.hypot(*mean_force_n(seen.zeroed))
        read = f"reads {left_n:.2f} N just after it was set"
        rows.append(BIAS_SET.row(left_n <= ZERO_MAX_N, read, f"{ZERO_MAX_N:g} N", "power-cycle the sensor and repeat"))
    axes = dict(zip("xyz", ft_fit.drift(seen.samples), strict=True))
    worst_n = max(abs(axis.per_minute_n) for axis in axes.values())
    fix = "leave it powered for 20 minutes and repeat; keep it away from sunlight and from the heat of the motors"
    read = f"{worst_n:.2f} N per minute on the worst axis"
    rows.append(DRIFT.row(worst_n <= DRIFT_WARN_N_MIN, read, f"{DRIFT_WARN_N_MIN:g} N per minute", fix))
    rows.append(preflight.stuck_row(seen.samples, vehicle))
    x, y, z = bias_n = tare_bias_n(seen.first, vehicle, IDENTITY_QUAT, seen.arm_rad)
    net_kg = tool_of(vehicle).beyond_sensor_kg
    data = {
        "drift": [{"axis": name, **asdict(axis)} for name, axis in axes.items()],
        "tare": {"bias_n": list(bias_n), "net_mass_kg": net_kg},
        "temperature_c": None,
    }
    text = [
        *(
            f"  F{name}  mean {one.mean_n:+7.2f} N   noise {one.noise_n:.3f} N   drift {one.per_minute_n:+.3f} "
            f"+- {one.standard_error_n:.3f} N per minute"
            for name, one in axes.items()
        ),
        f"  a flight's tare would remove ({x:+.2f}, {y:+.2f}, {z:+.2f}) N besides the net's {net_kg:g} kg",
        "  temperature: the sensor's protocol does not report it",
        "",
    ]
    return Report(rows, data, text)


TOOLS: Final = {
    "check": Tool(
        name="ft check",
        family=SENSORS,
        collect=watch,
        fit=judge,
        device=preflight.DEVICE,
        no_data={"rest": None, "weight": None},
    ),
    "tare": Tool(
        name="ft tare",
        family=SENSORS,
        collect=watch_drift,
        fit=judge_drift,
        device=preflight.DEVICE,
        no_data={"drift": None, "tare": None},
    ),
}
