"""Push test: a known force on the net of the hovering machine, its response beside the ideal target impedance.

The ideal is M_d e'' + K_d e' + K_p e = e_tau (eq. Simplified_Impedance_Dynamics) under the true force, no sensor and no machine in
between. On the joint rows e_tau = J' (F - F_d), with F_d the law's own low-pass of F where it has one; on the position rows e_tau = F:
what a fully compliant base would do, whether or not the law's base rows are on. PSC has no impedance of the base: its position
controller, times the nominal mass, stands in.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from companion.config.controller import AdaptiveConfig, ControllerConfig, CscConfig, PscConfig
from companion.config.mission import ArmMove, Hold, Land, Takeoff
from companion.control.manipulator import Manipulator
from companion.model.flight_stage import SPOOL_S
from companion.model.types import Vec2, Vec3
from companion.sitl_config.loader import SitlConfig
from companion.sitl_config.world import Push
from sitl.fast.loop import FastFlight

Array = npt.NDArray[np.float64]

CATCH_POSE_DEG: Vec2 = (100.0, 60.0)
_TAKEOFF_S, _UNFOLD_S, _SETTLE_S, _AFTER_S = 3.0, 2.5, 6.0, 4.0
_PUSH_S = SPOOL_S + _TAKEOFF_S + _UNFOLD_S + _SETTLE_S
"""On the world's mission clock."""
_REST_S = 0.5
"""Deflections count from the mean over so long before the push."""
_SUBSTEP_S = 0.0005


class PushTestError(Exception):
    """The test cannot be made, or the machine did not stay in the air until its end."""


@dataclass(frozen=True)
class TargetImpedance:
    """Diagonals on the rows x, y, z, alpha_1, alpha_2."""

    inertia_md: Array
    damping_kd: Array
    stiffness_kp: Array
    desired_force_time_s: float | None
    """T_d of F_d; None: F_d = 0."""


_ROWS = [0, 1, 2, 6, 7]


def target_of(law: ControllerConfig, mass_kg: float) -> TargetImpedance:
    """The impedance that a law promises.

    Args:
        law: any law's configuration.
        mass_kg: nominal, of the whole machine; for PSC's base.
    """
    if isinstance(law, PscConfig):
        gains = (
            (*[mass_kg] * 3, *law.arm_inertia_md),
            (*(mass_kg * k for k in law.position_kd_xyz), *law.arm_damping_kd),
            (*(mass_kg * k for k in law.position_kp_xyz), *law.arm_stiffness_kp),
        )
        m_d, k_d, k_p = (np.array(gain) for gain in gains)
    else:
        m_d, k_d, k_p = (np.array(gain)[_ROWS] for gain in (law.inertia_md, law.damping_kd, law.stiffness_kp))
    return TargetImpedance(m_d, k_d, k_p, law.desired_force_time_s)


def _base_rows(law: ControllerConfig) -> bool:
    if isinstance(law, AdaptiveConfig):
        return any(law.base_compliance_xyz)
    return isinstance(law, CscConfig) and any(law.external_xyz)


def _with_base_rows(law: ControllerConfig) -> ControllerConfig:
    if isinstance(law, AdaptiveConfig):
        # What is fed forward must not be answered a second time.
        update = {"base_compliance_xyz": (1.0, 1.0, 1.0), "force_feedforward_xyz": (0.0, 0.0, 0.0)}
        return law.model_copy(update=update)
    if isinstance(law, CscConfig):
        return law.model_copy(update={"external_xyz": (1.0, 1.0, 1.0), "desired_force_xyz": (0.0, 0.0, 0.0)})
    raise PushTestError(f"the law {law.law} has no base rows: its vehicle is position-controlled")


@dataclass(frozen=True)
class Response:
    """Deflection of one part: rows are time, columns its coordinates."""

    measured: Array
    ideal: Array

    @property
    def peak_measured(self) -> float:
        """Largest norm of the measured deflection."""
        return float(np.linalg.norm(self.measured, axis=1).max())

    @property
    def peak_ideal(self) -> float:
        """Largest norm of the ideal deflection."""
        return float(np.linalg.norm(self.ideal, axis=1).max())

    @property
    def peak_ratio(self) -> float | None:
        """Measured peak over ideal peak: 1 is perfect; None where the ideal does not move at all."""
        ideal = self.peak_ideal
        return self.peak_measured / ideal if ideal > 0.0 else None

    @property
    def rms_difference(self) -> float:
        """RMS over time of ||measured - ideal||."""
        return float(np.sqrt(np.mean(np.sum((self.measured - self.ideal) ** 2, axis=1))))


@dataclass(frozen=True)
class PushResult:
    """One push."""

    law: str
    preset: str
    force_world_n: Vec3
    duration_s: float
    base_rows: bool
    """The law's base rows are on: F_ext enters e_tau there."""
    t_s: Array
    """Since the push began."""
    arm_rad: Response
    """alpha_1, alpha_2."""
    base_m: Response
    """x, y, z, world."""


def push_config(
    config: SitlConfig, force_world_n: Vec3 = (0.0, 0.0, -2.0), duration_s: float = 1.0, base_rows: bool = False
) -> SitlConfig:
    """The same machine and law on the test's mission: up, arm into the catch pose, hover, push.

    Args:
        config: nothing is thrown, whatever its world says.
        force_world_n: on the net's centre.
        duration_s: of the push.
        base_rows: let all of F_ext enter e_tau on the position rows; otherwise the law stays as it is.

    Raises:
        PushTestError: base rows are asked of a law that has none.
    """
    phases = (
        Takeoff(type="takeoff", height_m=1.2, duration_s=_TAKEOFF_S),
        ArmMove(type="arm", arm_deg=CATCH_POSE_DEG, duration_s=_UNFOLD_S),
        Hold(type="hold", duration_s=_SETTLE_S + duration_s + _AFTER_S + 1.0),
        Land(type="land", speed_m_s=0.35),
    )
    mission = config.mission.model_copy(update={"name": "push", "phases": phases, "catch": None})
    push = Push(t_s=_PUSH_S, duration_s=duration_s, force_world_n=force_world_n)
    world = config.world.model_copy(update={"payload_kg": 0.0, "push": push})
    controller = _with_base_rows(config.controller) if base_rows else config.controller
    return config.model_copy(update={"mission": mission, "world": world, "controller": controller})


def push_test(config: SitlConfig, target: TargetImpedance | None = None) -> PushResult:
    """Fly a configuration of `push_config` in the fast loop.

    Args:
        config: with `world.push`.
        target: the ideal; absent: that of the law that flies.

    Raises:
        PushTestError: the machine refused, crashed or came down before the response was over.
    """
    push = config.world.push
    if push is None:
        raise PushTestError("world.push is not set; make the configuration with push_config")
    flight = FastFlight(config)
    after_s = push.duration_s + _AFTER_S
    rows: list[tuple[float, ...]] = []
    log = flight.run(limit_s=60.0)
    armed_s = flight.plant.armed_t_s
    if armed_s is None:
        raise PushTestError(f"the machine did not take off: {log.outputs[-1].events or log.outputs[-1].phase}")
    for outputs, truth in zip(log.outputs, log.truth, strict=True):
        t_s = truth.t_s - armed_s - push.t_s
        reference = outputs.reference
        if reference is None or not -_REST_S <= t_s <= after_s:
            continue
        where, alpha = truth.position_world_m, truth.joint_angle_rad
        to, arm = reference.position_world_m, reference.arm_rad
        rows.append((t_s, *(a - b for a, b in zip((*where, *alpha), (*to, *arm), strict=True))))
    table = np.array(rows)
    if not len(table) or log.crashed or table[-1, 0] < after_s - 0.02:
        raise PushTestError(f"the machine came down early: {log.outputs[-1].outcome}")
    rest = table[table[:, 0] < 0.0, 1:].mean(axis=0)
    table = table[table[:, 0] >= 0.0]
    times_s, deflection = table[:, 0], table[:, 1:] - rest
    ideal = target or target_of(config.controller, config.vehicle.airframe.mass_kg)
    base, joints = ideal_response(ideal, config, times_s)
    return PushResult(
        law=config.controller.law,
        preset=config.controller.preset,
        force_world_n=push.force_world_n,
        duration_s=push.duration_s,
        base_rows=_base_rows(config.controller),
        t_s=times_s,
        arm_rad=Response(deflection[:, 3:5], joints),
        base_m=Response(deflection[:, 0:3], base),
    )


def ideal_response(target: TargetImpedance, config: SitlConfig, t_s: Array) -> tuple[Array, Array]:
    """Deflection of base (m, world) and joints (rad) of the ideal machine, level, at the times since the push began."""
    push = config.world.push
    assert push is not None
    manipulator = Manipulator(config.vehicle.arm, config.vehicle.tool)
    pose = np.radians(CATCH_POSE_DEG)
    e, rate = np.zeros(5), np.zeros(5)
    desired = np.zeros(3)
    yaw = math.radians(config.mission.start.yaw_deg)
    out = []
    now_s = 0.0
    for until_s in t_s.tolist():
        while now_s < until_s:
            force = np.array(push.force_world_n) if now_s < push.duration_s else np.zeros(3)
            fx, fy, fz = (force - desired).tolist()
            forward = math.cos(yaw) * fx + math.sin(yaw) * fy
            alpha = pose + e[3:5]
            about = manipulator.joint_torque_from_force((float(alpha[0]), float(alpha[1])), (forward, 0.0, fz))
            e_tau = np.array((*force, *about))
            rate += _SUBSTEP_S * (e_tau - target.damping_kd * rate - target.stiffness_kp * e) / target.inertia_md
            e += _SUBSTEP_S * rate
            if target.desired_force_time_s is not None:
                desired += _SUBSTEP_S / target.desired_force_time_s * (force - desired)
            now_s += _SUBSTEP_S
        out.append(e.copy())
    table = np.array(out)
    return table[:, 0:3], table[:, 3:5]


def plot(results: list[PushResult], path: Path) -> None:
    """Response (solid) and ideal (dashed) of arm and base, one row of axes per push, as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 2.9 * len(results)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(results), 2, squeeze=False)
    for (left, right), result in zip(grid, results, strict=True):
        fx, fy, fz = result.force_world_n
        rows = "base rows on" if result.base_rows else "base rows off"
        parts = (
            (left, result.arm_rad, 180.0 / math.pi, "arm", "deg", ("alpha_1", "alpha_2")),
            (right, result.base_m, 1000.0, "base", "mm", ("x", "y", "z")),
        )
        for axes, response, scale, part, unit, names in parts:
            axes.axvspan(0.0, result.duration_s, color="0.93")
            for k, name in enumerate(names):
                (line,) = axes.plot(result.t_s, scale * response.measured[:, k], label=name)
                axes.plot(result.t_s, scale * response.ideal[:, k], "--", color=line.get_color(), linewidth=1.0)
            axes.set_title(f"{result.law} {result.preset}, {rows}: {part} under ({fx:g}, {fy:g}, {fz:g}) N", fontsize=9)
            axes.set_xlabel("s since the push began")
            axes.set_ylabel(unit)
            axes.legend(fontsize=8)
            axes.grid(alpha=0.3)
    figure.savefig(path, dpi=120)
