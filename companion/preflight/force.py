"""Checks of the force-torque sensor at rest: rate, noise, overload, and whether the tare fits an empty net. Pure functions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence

from companion.config.arm import Tool
from companion.config.devices import ForceDevice
from companion.config.vehicle import OBSERVER, Vehicle
from companion.control.arm_model import manipulator_of
from companion.control.sensing import ForceSensing
from companion.model.check_row import Row
from companion.model.observations import ForceStream, Observations
from companion.model.types import ForceSample, Joints, Quat, Vec3
from companion.preflight.arm import usb_latency
from companion.preflight.checks import Check, longest_unchanged_s

DEVICE = Check(
    "force.device",
    "force sensor",
    "the port opens, and an RFT60 answers and streams; a vehicle without `devices.force` only warns",
    "the controller needs the force of the payload",
)
RATE = Check(
    "force.rate",
    "force sensor rate",
    "at least 90 % of `devices.force.rate_hz`; refused below 50 % and above 150 %",
    "a catch is detected late, or not at all: readings of a faster sensor may wait, and are taken for new ones",
)
CHECKSUMS = Check(
    "force.checksums",
    "force sensor packets",
    "none with an invalid checksum",
    "interference causes samples to be lost, and in flight even more of them",
    warns=True,
)
NOISE = Check(
    "force.noise",
    "force sensor noise",
    "at most 0.3 N (one sigma); refused above 1.5 N",
    "the controller responds to every measured force, so noise becomes motion",
)
OVERLOAD = Check(
    "force.overload", "force sensor overload", "none", "an overloaded sensor saturates, and may be permanently damaged"
)
TARE = Check(
    "force.tare",
    "force sensor tare",
    "bias below 5 % of `devices.force.force_max_n`; refused above 10 %",
    "the tare removes every force at rest except the empty net's weight, so a load on the net at that time would be missing in flight",
)
STILL = Check(
    "force.still",
    "force sensor at rest",
    "drifts less than `safety.force_drift_n`",
    "a tare taken while the net is touched is wrong for the whole flight",
)
STUCK = Check(
    "force.stuck",
    "force sensor alive",
    "the same reading for at most `safety.force_stuck_s`",
    "a stuck sensor, or one that streams zeros, reports plausible values and measures nothing",
)
USB = Check(
    "force.usb_latency",
    "force sensor's USB latency timer",
    "1 ms, or no FTDI adapter",
    "samples arrive in bursts, up to 16 ms late",
    warns=True,
)
CHECKS = (DEVICE, RATE, CHECKSUMS, NOISE, OVERLOAD, TARE, STILL, STUCK, USB)

_OBSERVED = (
    "a momentum observer estimates the force: gusts are part of it, payloads below 0.1 kg and a force on the empty net are not "
    "detected, and a snagged tether may count as a catch"
)
_COMPARE = "fly a catch with force sensor and force_source: observer first, and compare both forces in the report"
RATE_GOOD, RATE_MIN, RATE_MAX = 0.9, 0.5, 1.5
NOISE_GOOD_N, NOISE_MAX_N = 0.3, 1.5
TARE_GOOD, TARE_MAX = 0.05, 0.10


def rows(o: Observations, vehicle: Vehicle) -> Iterator[Row]:
    """Return the rows of the force sensor, or one warning if the vehicle has none."""
    if vehicle.devices.force is None and vehicle.force_source == OBSERVER:
        yield DEVICE.doubtful(f"none; {_OBSERVED}", "", _COMPARE)
        return
    if vehicle.devices.force is None:
        fix = (
            "add devices.force to the vehicle file if the sensor is mounted, or set force_source: observer; without either, the "
            "controller measures no force"
        )
        yield DEVICE.doubtful("none; a catch, a lost payload and a force on the empty net are not detected", "", fix)
        return
    failure, stream = o.failures.get("force"), o.force_stream
    if failure is not None or stream is None:
        yield DEVICE.bad(failure or "not checked")
        return
    pose = (o.vehicle[-1].attitude_wxyz, o.arm[-1].angle_rad) if o.vehicle and o.arm else None
    yield from stream_rows(stream, o.force, o.duration_s, vehicle, vehicle.devices.force, pose)
    if o.machine is not None and stream.lost is None:
        yield usb_latency(USB, o.machine.force_latency_ms)


def stream_rows(
    stream: ForceStream,
    samples: Sequence[ForceSample],
    duration_s: float,
    vehicle: Vehicle,
    device: ForceDevice,
    pose: tuple[Quat, Joints] | None,
) -> Iterator[Row]:
    """Return the rows of a sensor that was recorded at rest.

    Args:
        pose: attitude of the body and joint angles, rad; None if unknown, which omits the row on the tare.
    """
    if stream.lost is not None:
        yield DEVICE.bad(stream.lost, "the sensor keeps streaming", "check plug and cable")
        return
    tool = vehicle.tool
    assert tool is not None, "a vehicle file with a force sensor has a tool"
    product = stream.product or "answers"
    if vehicle.force_source == OBSERVER:
        yield DEVICE.doubtful(f"{product}, but only logged; {_OBSERVED}", "", _COMPARE)
    else:
        yield DEVICE.good(product)
    yield _rate(stream.samples / duration_s, device)
    fix = "use a shielded cable, away from motors and their wires"
    yield CHECKSUMS.row(not stream.bad_sums, f"{stream.bad_sums or 'none'} wrong", "none", fix)
    if len(samples) >= 10:
        yield _noise(samples)
        yield _overload(samples, device)
        if pose is not None:
            yield _tare(tare_bias_n(samples, vehicle, *pose), tool, device)
        yield _still(samples, vehicle)
        yield stuck_row(samples, vehicle)


def _rate(rate_hz: float, device: ForceDevice) -> Row:
    expected_hz = device.rate_hz
    read, wanted = f"{rate_hz:.0f} Hz", f"{expected_hz} Hz"
    if rate_hz > RATE_MAX * expected_hz:
        return RATE.bad(read, wanted, "set the sensor, or devices.force.rate_hz, to the other's rate")
    fix = "check cable and adapter; power-cycle the sensor"
    return RATE.graded(rate_hz >= RATE_GOOD * expected_hz, rate_hz >= RATE_MIN * expected_hz, read, wanted, fix)


def _noise(samples: Sequence[ForceSample]) -> Row:
    """Return the row on the differences between consecutive samples. Drift has its own row."""
    axes = zip(*(sample.force_sensor_n for sample in samples), strict=True)
    squares = max(sum((now - before) ** 2 for before, now in itertools.pairwise(axis)) for axis in axes)
    noise_n = math.sqrt(squares / (2 * (len(samples) - 1)))
    read, wanted = f"{noise_n:.2f} N (one sigma)", f"{NOISE_GOOD_N:g} N"
    fix = "remove sources of vibration; ground the sensor; route its cable away from motors"
    return NOISE.graded(noise_n <= NOISE_GOOD_N, noise_n <= NOISE_MAX_N, read, wanted, fix)


def _overload(samples: Sequence[ForceSample], device: ForceDevice) -> Row:
    count = sum(sample.overload for sample in samples)
    read = f"{count} of {len(samples)} samples" if count else "none"
    limit_n = device.force_max_n
    fix = f"remove the load; if there is none, the sensor or its mount is damaged (devices.force.force_max_n is {limit_n:g} N)"
    return OVERLOAD.row(not count, read, "none", fix)


def _tare(bias_n: Vec3, tool: Tool, device: ForceDevice) -> Row:
    size_n, full_n = math.hypot(*bias_n), device.force_max_n
    x, y, z = bias_n
    kind, tool_kg = tool.kind, tool.beyond_sensor_kg
    read = f"({x:.1f}, {y:.1f}, {z:.1f}) N besides the {kind}'s {tool_kg:g} kg"
    wanted = f"{TARE_GOOD * full_n:g} N"
    fix = (
        f"free the {kind}; if it is free, correct tool.{tool.mass_key}, loosen the sensor's mount or set its bias with the vendor's "
        "tool"
    )
    return TARE.graded(size_n <= TARE_GOOD * full_n, size_n <= TARE_MAX * full_n, read, wanted, fix)


def tare_bias_n(samples: Sequence[ForceSample], vehicle: Vehicle, attitude: Quat, arm_rad: Joints) -> Vec3:
    """Return the bias that a flight's tare would find: the mean reading minus the weight of the net, in the sensor frame."""
    sensing = ForceSensing(vehicle.tool, manipulator_of(vehicle))
    for sample in samples:
        sensing.collect(sample, attitude, arm_rad)
    sensing.finish_tare()
    assert sensing.bias_sensor_n is not None
    return sensing.bias_sensor_n


def _still(samples: Sequence[ForceSample], vehicle: Vehicle) -> Row:
    """Return the row on the differences between the means of five consecutive intervals."""
    size = max(1, len(samples) // 5)
    means = [mean_force_n(samples[i : i + size]) for i in range(0, len(samples) - size + 1, size)]
    drift_n = max(max(mean[axis] for mean in means) - min(mean[axis] for mean in means) for axis in range(3))
    limit_n = vehicle.safety.force_drift_n
    read, wanted = f"drifts by {drift_n:.2f} N", f"{limit_n:g} N"
    fix = "do not touch the net; let the sensor warm up for a few minutes"
    return STILL.row(drift_n <= limit_n, read, wanted, fix)


def stuck_row(samples: Sequence[ForceSample], vehicle: Vehicle) -> Row:
    """Return the row on the longest time with an unchanged reading."""
    longest_s = longest_unchanged_s((one.stamp_s, (one.force_sensor_n, one.torque_sensor_nm)) for one in samples)
    limit_s = vehicle.safety.force_stuck_s
    read = f"the same reading for {longest_s:.2f} s at most"
    return STUCK.row(longest_s <= limit_s, read, f"{limit_s:g} s", "power-cycle the sensor; check its cable")


def mean_force_n(samples: Sequence[ForceSample]) -> Vec3:
    """Return the mean force in the sensor frame."""
    x, y, z = (sum(sample.force_sensor_n[axis] for sample in samples) / len(samples) for axis in range(3))
    return (x, y, z)
