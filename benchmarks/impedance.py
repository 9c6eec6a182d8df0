"""Measures the impedance of base and arm over frequency: how far a push on the net moves each, beside what the gains ask for.

    python -m benchmarks.impedance --table impedance.md --picture docs/internals/pictures/impedance.png      # 15 flights

A law hovers in the ideal world with the arm in the pose of the catch and no payload. A second flight with the same seed is pushed for a
moment. Noise is the same in both, so their difference is the answer to the push, and its Fourier transform over that of the push is the
compliance: of the base along x under a push along x, of a joint under the torque J'F of a push along z.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.ticker import NullFormatter

from benchmarks.report import publish, table_parser
from companion.analysis.plot_style import COLOURS, DASHED, REFERENCE, dress, figure_legend, new_figure, write_png
from companion.config.controller import AdaptiveConfig
from companion.control.arm_model import manipulator_of
from companion.model.flight_stage import SPOOL_S
from companion.model.types import Vec3
from companion.phases.arm import ArmMove
from companion.phases.hold import Hold
from companion.phases.takeoff import Takeoff
from companion.sitl_config.loader import SitlConfig, load_sitl
from companion.sitl_config.world import Push
from sitl.fast.loop import FastFlight
from sitl.faults.timing import ARMED_SEEN_S
from tools.docs.tables import markdown

COMPLIANT = "with base rows"
"""Added to a law's name: its base answers to the measured force, which is not fed forward then."""
LAWS = (
    "adaptive/recommended",
    f"adaptive/recommended {COMPLIANT}",
    "adaptive/paper_slow_leakage",
    "csc/tuned",
    "psc/tuned",
)
POSE_DEG = (100.0, 60.0)
TAKEOFF_S, UNFOLD_S, SETTLE_S, PUSH_S, ANSWER_S = 2.5, 2.0, 4.0, 0.15, 10.0
PUSH_AT_S = ARMED_SEEN_S + SPOOL_S + TAKEOFF_S + UNFOLD_S + SETTLE_S
"""Since arming."""
PUSH_N = 4.0
FORWARD, DOWN = (PUSH_N, 0.0, 0.0), (0.0, 0.0, -PUSH_N)
FREQUENCIES_HZ = np.geomspace(0.1, 3.0, 60)
TABLE_HZ = (0.1, 0.3, 1.0, 3.0)
PANES = ("base, x", "shoulder", "elbow")

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]


def config_of(law: str, force_world_n: Vec3 | None) -> SitlConfig:
    """Return the flight of a law, by its name in `LAWS`."""
    name, _, rows = law.partition(" ")
    config = load_sitl("catch", None, *name.split("/"), world="ideal")
    controller = config.controller
    if rows:
        changes = {"base_compliance_xyz": (1.0, 1.0, 1.0), "force_feedforward_xyz": (0.0, 0.0, 0.0)}
        controller = controller.model_copy(update=changes)
    phases = (
        Takeoff(type="takeoff", height_m=1.0, duration_s=TAKEOFF_S),
        ArmMove(type="arm", arm_deg=POSE_DEG, duration_s=UNFOLD_S),
        Hold(type="hold", duration_s=SETTLE_S + PUSH_S + ANSWER_S + 1.0),
        config.mission.phases[-1],
    )
    push = None if force_world_n is None else Push(t_s=PUSH_AT_S, duration_s=PUSH_S, force_world_n=force_world_n)
    mission = config.mission.model_copy(update={"name": "push", "phases": phases, "catch": None})
    world = config.world.model_copy(update={"payload_kg": 0.0, "push": push})
    return config.model_copy(update={"mission": mission, "world": world, "controller": controller})


def fly(law: str, force_world_n: Vec3 | None) -> Array:
    """Return the true motion after the push, a row for each tick: time since the push, x in m, joint angles in rad.

    Raises:
        RuntimeError: the flight ended before.
    """
    flight = FastFlight(config_of(law, force_world_n))
    rows = []
    for truth in flight.run(limit_s=PUSH_AT_S + PUSH_S + ANSWER_S + 5.0).truth:
        if flight.plant.armed_t_s is not None:
            t_s = truth.t_s - flight.plant.armed_t_s - PUSH_AT_S
            if 0.0 <= t_s <= ANSWER_S:
                rows.append((t_s, truth.position_world_m[0], *truth.joint_angle_rad))
    if not rows or rows[-1][0] < ANSWER_S - 0.02:
        raise RuntimeError(f"{law}: did not stay in the air")
    return np.array(rows)


def transform(t_s: Array, values: Array) -> Complex:
    """Return the Fourier transform at `FREQUENCIES_HZ`."""
    found: Complex = np.exp(-2j * np.pi * np.outer(FREQUENCIES_HZ, t_s)) @ (values * np.gradient(t_s))
    return found


def push_of(size: float) -> Complex:
    """Return the transform of a push, which begins at 0."""
    w = 2j * np.pi * FREQUENCIES_HZ
    found: Complex = size * (1.0 - np.exp(-w * PUSH_S)) / w
    return found


def torques_nm(law: str) -> Array:
    """Return the joint torques of the push downwards, J'F."""
    manipulator = manipulator_of(config_of(law, None).vehicle)
    a1, a2 = np.radians(POSE_DEG).tolist()
    return np.array(manipulator.joint_torque_from_force((a1, a2), DOWN))


def measured(law: str, rest: Array, forward: Array, down: Array) -> dict[str, Array]:
    """Return the size of the compliance by pane, m/N and rad/(N m), from the flights without a push and with each."""
    count = min(map(len, (rest, forward, down)))
    t_s, (rest, forward, down) = rest[:count, 0], (flown[:count] for flown in (rest, forward, down))
    answers = [forward[:, 1] - rest[:, 1], *(down[:, 2:] - rest[:, 2:]).T]
    pushes = [PUSH_N, *torques_nm(law)]
    return {
        pane: np.abs(transform(t_s, answer) / push_of(push))
        for pane, answer, push in zip(PANES, answers, pushes, strict=True)
    }


def wanted(law: str) -> dict[str, Array]:
    """Return what the gains of an adaptive law ask for; empty for another law. The base has an impedance with `COMPLIANT` only."""
    controller = config_of(law, None).controller
    if not isinstance(controller, AdaptiveConfig):
        return {}
    w = 2j * np.pi * FREQUENCIES_HZ
    found = {}
    for pane, row in zip(PANES, (0, 6, 7), strict=True):
        if row >= 6 or any(controller.base_compliance_xyz):
            mass, damping = controller.inertia_md[row], controller.damping_kd[row]
            compliance = 1.0 / (controller.stiffness_kp[row] + w * damping + w * w * mass)
            if row >= 6 and controller.desired_force_time_s is not None:  # of F - F_d, and F_d follows F
                compliance = compliance * (1.0 - 1.0 / (1.0 + w * controller.desired_force_time_s))
            found[pane] = np.abs(compliance)
    return found


def table(laws: Mapping[str, tuple[dict[str, Array], dict[str, Array]]]) -> str:
    """Return measured compliances, and in brackets their ratio to the wanted ones, as a Markdown table."""
    rows = []
    for pane in PANES:
        scale, unit = (1e3, "mm/N") if pane == PANES[0] else (1.0, "rad/(N m)")
        for law, (flown, asked) in laws.items():
            cells = []
            for at in [int(np.argmin(np.abs(FREQUENCIES_HZ - hz))) for hz in TABLE_HZ]:
                ratio = f" ({flown[pane][at] / asked[pane][at]:.2f})" if pane in asked else ""
                cells.append(f"{scale * flown[pane][at]:.3g}{ratio}")
            rows.append((f"{pane}, {unit}", law, *cells))
    return markdown(("", "law/preset", *(f"{hz:g} Hz" for hz in TABLE_HZ)), rows) + "\n"


def draw(laws: Mapping[str, tuple[dict[str, Array], dict[str, Array]]], path: Path) -> None:
    """Draw the compliances over frequency."""
    figure = new_figure(4.4)
    axes = figure.subplots(1, len(PANES))
    for ax, pane in zip(axes, PANES, strict=True):
        dress(ax)
        for k, (law, (flown, asked)) in enumerate(laws.items()):
            ax.loglog(FREQUENCIES_HZ, flown[pane], color=COLOURS[k], lw=1.6, label=law, zorder=3)
            if pane in asked:
                ax.loglog(FREQUENCIES_HZ, asked[pane], color=COLOURS[k], lw=1.1, ls=DASHED, zorder=4)
        ax.plot([], [], color=REFERENCE, lw=1.1, ls=DASHED, label="asked for by the gains")
        ax.set_title(pane, loc="left", fontsize=10)
        ax.set_xticks(TABLE_HZ, [f"{hz:g}" for hz in TABLE_HZ])
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.yaxis.set_minor_formatter(NullFormatter())
        ax.set_xlabel("frequency [Hz]")
        ax.set_ylabel("compliance [m/N]" if pane == PANES[0] else "compliance [rad/(N m)]")
    handles, names = axes[0].get_legend_handles_labels()
    figure_legend(figure, "How far a push moves base and arm", handles, names, columns=3)
    write_png(figure, path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line, fly, and write table and picture."""
    parser = table_parser((__doc__ or "").partition("\n")[0])
    parser.add_argument("--picture", type=Path, help="PNG file to write")
    a = parser.parse_args(arguments)
    flights = [(law, force) for law in LAWS for force in (None, FORWARD, DOWN)]
    with ProcessPoolExecutor(a.jobs) as pool:
        flown = list(pool.map(fly, *zip(*flights, strict=True)))
    laws = {law: (measured(law, *flown[3 * k : 3 * k + 3]), wanted(law)) for k, law in enumerate(LAWS)}
    publish(table(laws), "impedance", a.table)
    if a.picture is not None:
        draw(laws, a.picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
