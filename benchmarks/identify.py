"""`companion identify` against worlds whose truth is known: `python -m benchmarks.identify [--worlds 50] [--mission catch]`.

Every laboratory is flown in the fast loop; the identification sees the flight's log only. The truth is read from the world, or measured
in it: for the responses, the same world without noise, gusts and arm effects is excited with sines, and its true motion is compared
with the setpoints; for the bandwidth with the arm folded and unfolded, and the mean of both responses counts. Prints how often each
95 % interval holds the truth, and how wide it is.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt

from companion.commissioning.identify.identification import Identification, identify
from companion.commissioning.identify.quantity import SIGMAS_95
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import euler_zyx_from_quat, quat_from_euler_zyx, quat_multiply, quat_rotate
from companion.sitl_config.effects.rotors import BODY_DRAG_N_PER_M_S
from companion.sitl_config.loader import SitlConfig, load_sitl
from companion.sitl_config.per_joint import of_joints
from companion.sitl_config.world import World
from sitl.autopilot.setpoints import OffboardTarget
from sitl.autopilot.types import AttitudeTarget
from sitl.campaigns.flights import log_of
from sitl.fast.loop import FastFlight
from sitl.world.effects.rotors import Rotors

Array = npt.NDArray[np.float64]
ROLL_PITCH_HZ = np.array([0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0])
THRUST_HZ = np.array([1.5, 2.25])
"""Slower, the ground effect and the drag turn the phase; faster, the phase is no longer that of a delay."""
_AMPLITUDES_RAD = np.radians([3.0, 1.5, 1.0, *[0.8] * 7])
_THRUST_AMPLITUDE = 0.008
_BEGIN_S, _PERIOD_S, _PERIODS = 8.0, 4.0, 3
_HEIGHT_M = 1.0
_QUIET = (
    "air",
    "imu",
    "mocap",
    "downwash",
    "tether_line",
    "net",
    "thrower",
    "force_sensor",
    "compliance",
    "servo_mechanics",
)
_WITHOUT_NOISE = ("payload_kg", "mocap_noise_m", "mocap_noise_deg", "gyro_noise_rad_s", "accel_noise_m_s2")


@dataclass(frozen=True)
class Flown:
    """One laboratory: what was identified, and the truth by the same keys."""

    seed: int
    found: Identification
    truth: dict[str, float]


def flown(mission: str, seed: int, *, respond: bool = True) -> Flown:
    """Fly a laboratory and identify it.

    Args:
        mission: mission file, or the name of a shipped one.
        seed: seed of the laboratory.
        respond: whether the truth of the responses is measured, too, which takes another flight.
    """
    config = load_sitl(mission, overrides=[f"world.seed={seed}"], world="lab")
    fast = FastFlight(config)
    result = fast.run()
    # The log gets no event from the world: a catch that the flight did not notice stays unknown.
    found = identify(log_of(fast.config.flight, result, None))
    return Flown(seed, found, truth_of(fast, found) | (responses(seed) if respond else {}))


def truth_of(fast: FastFlight, found: Identification) -> dict[str, float]:
    """Return what the world knows of the quantities."""
    config, plant = fast.config, fast.plant
    world, vehicle, weight_n = config.world, config.vehicle, plant.machine.weight_n
    truth = {"mocap_delay_s": world.mocap_latency_s + world.mocap.delivery_jitter_s}
    truth["drag_1_s"] = world.rotors.drag_s_m * GRAVITY_M_S2 + BODY_DRAG_N_PER_M_S * GRAVITY_M_S2 / weight_n
    if found.hover is not None and found.hover.voltage_mean_v is not None:
        layout = vehicle.airframe.rotor_layout
        rotors = Rotors(world.rotors, layout, 0.002)
        each_n = weight_n / layout.count / rotors.ground_effect(_HEIGHT_M + layout.height_m)
        share = (found.hover.voltage_mean_v / world.battery.full_thrust_v) ** 2
        full_n = vehicle.airframe.thrust_max_n / layout.count * share
        truth["hover_thrust"] = rotors.hover_command(each_n, full_n, world.thr_mdl_fac)
    if plant.scene.payload.caught_t_s is not None:
        truth["payload_kg"] = world.payload_kg
    return truth | _servo_truth(world, config, found)


def _servo_truth(world: World, config: SitlConfig, found: Identification) -> dict[str, float]:
    """Return each joint's torque constant, and its mean friction at the mean speed and load that the identification states."""
    servo, arm = world.servo_mechanics, config.vehicle.arm
    warm_k = servo.warm_up_k * -math.expm1(-(servo.warm_since_s + 10.0) / servo.warm_up_s)
    truth = dict[str, float]()
    errors = of_joints(servo.torque_per_amp_error, len(arm.joints))
    for number, (nm_a, error) in enumerate(zip(arm.torque_constants_nm_a, errors, strict=True), start=1):
        truth[f"joint{number}_torque_per_amp_nm_a"] = (
            nm_a / (1.0 + error) * (1.0 + servo.torque_constant_per_k * warm_k)
        )
        words = found[f"joint{number}_friction_nm"].how.split()
        if "rad/s" in words:
            speed, load = float(words[words.index("rad/s") - 1]), 2.0 * float(words[words.index("rad/s") + 2])
            rest = math.exp(-((speed / servo.stribeck_rad_s) ** servo.stribeck_exponent))
            torque = servo.friction_nm + servo.load_friction * load + servo.viscous_nms * speed
            torque += rest * (servo.stiction_nm + servo.load_stiction * load)
            truth[f"joint{number}_friction_nm"] = (1.0 + servo.friction_per_k * warm_k) * torque
    return truth


def responses(seed: int) -> dict[str, float]:
    """Return lag and bandwidth of the attitude loop and the lag of the thrust, measured in the world with sines."""
    folded, unfolded = _quiet_hover(seed, "folded"), _quiet_hover(seed, "unfolded")
    attitude = _excited(folded, ROLL_PITCH_HZ, _tilted, _tilt)
    mean = 0.5 * (attitude + _excited(unfolded, ROLL_PITCH_HZ, _tilted, _tilt))
    thrust = _excited(folded, THRUST_HZ, _pushed, _lift)
    truth: dict[str, float] = {}
    for axis, name in enumerate(("roll", "pitch")):
        truth[f"{name}_lag_s"] = float(-np.angle(attitude[0, axis]) / (2.0 * np.pi * ROLL_PITCH_HZ[0]))
        size = np.abs(mean[:, axis])
        after = int(np.flatnonzero(size < math.sqrt(0.5))[0])
        truth[f"{name}_bandwidth_hz"] = float(
            np.interp(math.sqrt(0.5), size[[after, after - 1]], ROLL_PITCH_HZ[[after, after - 1]])
        )
    truth["thrust_lag_s"] = float(np.mean(-np.angle(thrust[:, 0]) / (2.0 * np.pi * THRUST_HZ)))
    return truth


def _quiet_hover(seed: int, arm: str) -> SitlConfig:
    """Return a hover flight with the arm in this pose, in the laboratory without noise, gusts and arm effects."""
    with TemporaryDirectory() as folder:
        mission = Path(folder) / "mission.yaml"
        text = Path("configs/missions/hover.yaml").read_text(encoding="utf-8")
        text = text.replace("duration_s: 5.0", "duration_s: 24.0").replace("arm_deg: folded", f"arm_deg: {arm}")
        mission.write_text(text.replace("../vehicles/", f"{Path('configs/vehicles').resolve()}/"), encoding="utf-8")
        off = [f"world.{name}.on=false" for name in _QUIET] + [f"world.{name}=0" for name in _WITHOUT_NOISE]
        return load_sitl(mission, overrides=[f"world.seed={seed}", *off], world="lab")


Excite = Callable[[AttitudeTarget, Array], tuple[AttitudeTarget, tuple[float, ...]]]
"""Adds the sines' present values, one per axis, to a setpoint; returns it and the commanded quantities."""


def _excited(config: SitlConfig, hertz: Array, excite: Excite, sense: Callable[[FastFlight], tuple[float, ...]]) -> Any:
    """Return the frequency response, (frequencies, axes)."""
    fast = FastFlight(config)
    phases = np.random.default_rng(config.world.seed).uniform(0.0, 2.0 * np.pi, (2, len(hertz)))
    times, inputs, outputs = list[float](), list[tuple[float, ...]](), list[tuple[float, ...]]()
    send = fast.px4.on_setpoint

    def changed(t_s: float, target: OffboardTarget) -> None:
        if isinstance(target, AttitudeTarget) and t_s > _BEGIN_S:
            scale = _AMPLITUDES_RAD if len(hertz) == len(_AMPLITUDES_RAD) else np.full(len(hertz), _THRUST_AMPLITUDE)
            target, wanted = excite(target, (scale * np.sin(2.0 * np.pi * hertz * t_s + phases)).sum(axis=1))
            times.append(t_s)
            inputs.append(wanted)
            outputs.append(sense(fast))
        send(t_s, target)

    fast.px4.on_setpoint = changed  # type: ignore[method-assign]
    fast.run(_BEGIN_S + (_PERIODS + 1) * _PERIOD_S)
    t_s = np.array(times)
    last = t_s > t_s[-1] - _PERIODS * _PERIOD_S + 1e-6
    wave = np.exp(-2j * np.pi * hertz[:, None] * t_s[last])
    return (wave @ np.array(outputs)[last]) / (wave @ np.array(inputs)[last])


def _tilted(target: AttitudeTarget, angles: Array) -> tuple[AttitudeTarget, tuple[float, ...]]:
    turned = quat_multiply(target.attitude_ned_frd, quat_from_euler_zyx(float(angles[0]), float(angles[1]), 0.0))
    roll, pitch, _ = euler_zyx_from_quat(turned)
    return AttitudeTarget(turned, target.thrust), (roll, pitch)


def _tilt(fast: FastFlight) -> tuple[float, ...]:
    roll, pitch, _ = euler_zyx_from_quat(fast.plant.truth.attitude_wxyz)
    return roll, -pitch


def _pushed(target: AttitudeTarget, values: Array) -> tuple[AttitudeTarget, tuple[float, ...]]:
    thrust = target.thrust + float(values[0])
    return AttitudeTarget(target.attitude_ned_frd, thrust), (thrust,)


def _lift(fast: FastFlight) -> tuple[float, ...]:
    truth = fast.plant.truth
    return (quat_rotate(truth.attitude_wxyz, truth.specific_force_body_m_s2)[2],)


def table(flights: list[Flown]) -> list[str]:
    """Return one line per quantity: flights in which it was found, truth inside, median half width, and error in sigmas."""
    keys = dict.fromkeys(one.key for flight in flights for one in flight.found.quantities)
    lines = [
        "| quantity | found | truth inside | median half width | RMS error / sigma | mean error / sigma |",
        "|---|---|---|---|---|---|",
    ]
    inside_all = known_all = 0
    for key in keys:
        pairs = [
            (flight.found[key], flight.truth[key])
            for flight in flights
            if key in flight.truth and flight.found[key].known
        ]
        if not pairs:
            continue
        inside = sum(one.contains(truth) for one, truth in pairs)
        off = np.array([(one.value - truth) / one.sigma for one, truth in pairs if one.value is not None])
        half = float(np.median([SIGMAS_95 * one.sigma / abs(truth) for one, truth in pairs]))
        rms = float(np.sqrt(np.mean(off**2)))
        found = f"{len(pairs)} of {len(flights)} | {inside}"
        lines.append(f"| `{key}` | {found} | {100 * half:.0f} % | {rms:.2f} | {off.mean():+.2f} |")
        inside_all, known_all = inside_all + inside, known_all + len(pairs)
    return [*lines, f"truth inside in {inside_all} of {known_all}: {100 * inside_all / max(1, known_all):.1f} %"]


def main() -> None:
    """Fly and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--mission", default="catch")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    flights: list[Flown] = []
    began = time.process_time()
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.worlds):
        try:
            flights.append(flown(arguments.mission, seed))
        except ValueError as error:
            print(f"seed {seed}: {error}", file=sys.stderr)
    print("\n".join(table(flights)))
    print(f"{len(flights)} flights, {time.process_time() - began:.0f} s of processor time")
    if arguments.json is not None:
        rows = [
            {"seed": one.seed, "truth": one.truth, "found": [q.as_json() for q in one.found.quantities]}
            for one in flights
        ]
        arguments.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
