"""Checks of the contract of control laws, which the author of a law calls from their own tests.

`check_law("NAME")` runs all checks; `sitl.testing.check_catch` flies the law. A law has no reset method, so each flight and each
check builds a new instance.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from pathlib import Path

from msgspec.structs import replace

from companion.config.controller import PRESETS
from companion.config.loader import FlightConfig, load_flight
from companion.config.vehicle import Vehicle
from companion.control.trial import at_rest, build_law, hover, problem_of, try_law
from companion.control.types import Law, PlantState, Wrench
from companion.model.codec import differences, to_packet
from companion.model.constants import GRAVITY_M_S2, TICK_PERIOD_S
from companion.model.frames import quat_from_euler_zyx, quat_rotate, tilt_rad
from companion.model.types import Joints, Reference, Vec3
from companion.testing.devices import check_arm as check_arm
from companion.testing.devices import check_force_sensor as check_force_sensor
from companion.testing.mocap import check_mocap as check_mocap
from companion.testing.phases import check_phases as check_phases

RANDOM_TICKS = 300
THRUST_TOLERANCE = 0.03
"""Largest error of the hover thrust, as a fraction of the weight."""
HELD_S = 5.0
TILT_TOLERANCE_RAD = math.radians(1.0)
Tick = tuple[float, PlantState, Reference, float]
"""Arguments of one call of a law's `step`."""


def check_law(law: str, preset: str | None = None, vehicle: str | Path | None = None) -> None:
    """Run every check on an installed control law.

    Args:
        preset: one of the law's presets; None to check all of them in turn.
        vehicle: vehicle file, or the name of a shipped one; None for the vehicle of the shipped missions.

    Raises:
        AssertionError: a check fails; the text states the preset and what was found.
        PluginError: the law cannot be used at all, or fails the trial that precedes every flight.
        ConfigError: a preset does not fit the law's settings.
    """
    for name in PRESETS[law] if preset is None else (preset,):
        config = load_flight("hover", vehicle, law, name)
        arm_rad = tuple([math.radians(angle_deg) for angle_deg in config.mission.start.arm_deg])
        try_law(config.controller, config.vehicle, arm_rad)
        _check_random_inputs(config, f"{law}/{name}")
        _check_hover(config, f"{law}/{name}", arm_rad)


def _check_random_inputs(config: FlightConfig, label: str) -> None:
    """Check that the law's commands can be sent and depend only on its inputs, and that the law does not change its inputs."""
    ticks = list(_random_ticks(config.vehicle))
    settings, inputs = config.model_dump_json(), to_packet(ticks)
    first = _commands(config, ticks)
    assert (config.model_dump_json(), to_packet(ticks)) == (settings, inputs), (
        f"{label}: the law has changed its inputs"
    )
    for number, wrench in enumerate(first):
        problem = problem_of(wrench, joints=len(config.vehicle.arm.joints))
        assert problem is None, f"{label}: tick {number} of random inputs: step returns {problem}"
    second = _commands(config, ticks)
    for number, (one, other) in enumerate(zip(first, second, strict=True)):
        found = differences(one, other)
        assert found is None, (
            f"{label}: the same inputs twice: tick {number}: {found[0]} = {found[1]!r}, then {found[2]!r}"
        )
    assert (config.model_dump_json(), to_packet(ticks)) == (settings, inputs), (
        f"{label}: the law has changed its inputs"
    )


def _check_hover(config: FlightConfig, label: str, arm_rad: Joints) -> None:
    """Check that a law hovers level with hover thrust, and that its integrators do not wind up: time during which the ground or an
    actuator limit keeps the vehicle from its reference must have no effect on later commands.
    """
    weight_n = config.vehicle.airframe.mass_kg * GRAVITY_M_S2

    def hovering(offset_m: Vec3, airborne: bool, duration_s: float) -> tuple[float, float]:
        """Hold the vehicle `offset_m` off for `duration_s`, then at the reference for 2 s; return thrust (of weight) and tilt, rad."""
        law = build_law(config.controller, config.vehicle)
        wrench = _held(law, config.vehicle, arm_rad, offset_m, airborne, duration_s, None)
        wrench = _held(law, config.vehicle, arm_rad, (0.0, 0.0, 0.0), True, 2.0, wrench)
        assert wrench is not None
        return wrench.collective_n / weight_n, tilt_rad(wrench.attitude_wxyz)

    share, tilt = hovering((0.0, 0.0, 0.0), True, 0.0)
    assert abs(share - 1.0) <= THRUST_TOLERANCE, f"{label}: the thrust at hover is {share:.3f} of the weight"
    assert tilt <= TILT_TOLERANCE_RAD, f"{label}: the attitude at hover is tilted by {math.degrees(tilt):.1f} deg"
    for what, offset_m, airborne in (
        ("on the ground, 0.3 m from the reference on each axis", (-0.3, -0.3, -0.3), False),
        ("of saturated thrust", (0.0, 0.0, -20.0), True),
        ("at the tilt limit", (-20.0, 0.0, 0.0), True),
    ):
        (share, tilt), (once, tilt_once) = (hovering(offset_m, airborne, s) for s in (HELD_S, TICK_PERIOD_S))
        found = f"{label}: after {HELD_S:g} s {what}, the command at hover differs from the command after one such tick"
        assert abs(share - once) <= THRUST_TOLERANCE, f"{found}: thrust {share:.3f} and {once:.3f} of the weight"
        degrees = f"{math.degrees(tilt):.1f} and {math.degrees(tilt_once):.1f} deg"
        assert abs(tilt - tilt_once) <= TILT_TOLERANCE_RAD, f"{found}: tilt {degrees}"


def _held(
    law: Law,
    vehicle: Vehicle,
    arm_rad: Joints,
    offset_m: Vec3,
    airborne: bool,
    duration_s: float,
    wrench: Wrench | None,
) -> Wrench | None:
    """Run the law with a constant position error, accelerating as commanded in the air, and return its last command."""
    resting, reference = at_rest(arm_rad), hover(arm_rad)
    x, y, z = resting.position_world_m
    position: Vec3 = (x + offset_m[0], y + offset_m[1], z + offset_m[2])
    for _ in range(round(duration_s / TICK_PERIOD_S)):
        state = replace(resting, position_world_m=position, airborne=airborne)
        if airborne and wrench is not None:
            mass_kg, attitude = vehicle.airframe.mass_kg, wrench.attitude_wxyz
            fx, fy, fz = quat_rotate(attitude, (0.0, 0.0, wrench.collective_n))
            felt = (fx / mass_kg, fy / mass_kg, fz / mass_kg - GRAVITY_M_S2)
            state = replace(state, acceleration_world_m_s2=felt, attitude_wxyz=attitude)
        wrench = law.step(TICK_PERIOD_S, state, reference, 1.0)
    return wrench


def _commands(config: FlightConfig, ticks: list[Tick]) -> list[Wrench]:
    law = build_law(config.controller, config.vehicle)
    return [law.step(*tick) for tick in ticks]


def _random_ticks(vehicle: Vehicle) -> Iterator[Tick]:
    """Yield random inputs, which are the same on every call: states within the limits of a flight, and short and long ticks."""
    draw = random.Random(1)

    def three(most: float) -> Vec3:
        return (draw.uniform(-most, most), draw.uniform(-most, most), draw.uniform(-most, most))

    def each(most: float) -> Joints:
        return tuple([draw.uniform(-most, most) for _ in vehicle.arm.joints])

    def angles() -> Joints:
        return tuple([math.radians(draw.uniform(*joint.angle_deg)) for joint in vehicle.arm.joints])

    for _ in range(RANDOM_TICKS):
        roll, pitch = draw.uniform(-0.6, 0.6), draw.uniform(-0.6, 0.6)
        airborne = draw.random() < 0.8
        state = PlantState(
            position_world_m=three(2.0),
            velocity_world_m_s=three(2.0),
            acceleration_world_m_s2=three(5.0),
            attitude_wxyz=quat_from_euler_zyx(roll, pitch, draw.uniform(-math.pi, math.pi)),
            angular_rate_body_rad_s=three(2.0),
            arm_rad=angles(),
            arm_rate_rad_s=each(3.0),
            force_ext_world_n=three(10.0) if draw.random() < 0.7 else None,
            airborne=airborne,
        )
        reference = Reference(
            position_world_m=three(2.0),
            velocity_world_m_s=three(2.0),
            acceleration_world_m_s2=three(2.0),
            yaw_rad=draw.uniform(-math.pi, math.pi),
            yaw_rate_rad_s=draw.uniform(-1.0, 1.0),
            arm_rad=angles(),
            arm_rate_rad_s=each(2.0),
            arm_acceleration_rad_s2=each(5.0),
            jerk_world_m_s3=three(5.0),
        )
        yield draw.uniform(0.001, 0.05), state, reference, 1.0 if airborne else draw.random()
