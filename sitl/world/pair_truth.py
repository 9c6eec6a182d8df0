"""What truly happened to the bar that two vehicles carry."""

from __future__ import annotations

import math

from companion.model.frames import quat_rotate
from companion.model.outputs import Outputs
from companion.model.team import CarryState, Grip
from sitl.world.scene import Scene


class PairTruth:
    """Collects the errors of the bar while both carry it; call `watch` after each tick of a member.

    Args:
        scene: a scene with a bar.
    """

    def __init__(self, scene: Scene) -> None:
        assert scene.bar is not None
        self._bar = scene.bar
        self._scene = scene
        self._squares = [0.0, 0.0, 0.0]
        """Sums of squares of the place error, the tilt and the internal force."""
        self._count = 0
        self._lifts = [0.0, 0.0]
        """Sums of what each vehicle lifts."""
        self._planned: CarryState | None = None
        self._carries = [False, False]

    def watch(self, number: int, outputs: Outputs) -> None:
        """Take the state of the bar after a tick of a member: 0 is the left one."""
        self._carries[number] = (
            outputs.carry is not None and outputs.team is not None and outputs.team.grip is Grip.CARRYING
        )
        if number == 0:
            self._planned = outputs.carry
            return
        planned, bar = self._planned, self._bar
        if planned is None or not all(self._carries) or not all(bar.gripped):
            return
        at, attitude = bar.pose
        along = quat_rotate(attitude, (1.0, 0.0, 0.0))
        pulls = [bar.force_world_n(machine) for machine in (0, 1)]
        # The force that stretches the bar: half the difference of what its ends are pulled with, outwards.
        internal = 0.5 * sum(
            sign * sum(a * b for a, b in zip(pull, along, strict=True))
            for sign, pull in zip((1, -1), pulls, strict=True)
        )
        tilt_rad = math.asin(max(-1.0, min(1.0, along[2])))
        for n, value in enumerate((math.dist(at, planned.centre_world_m), tilt_rad, internal)):
            self._squares[n] += value * value
        for machine, pull in enumerate(pulls):
            self._lifts[machine] += pull[2]
        self._count += 1

    def report(self) -> dict[str, float | None]:
        """Return the figures of `summary.json`; None where the bar was never carried."""
        if not self._count:
            return {
                "bar_p_rms_m": None,
                "bar_tilt_rms_deg": None,
                "internal_force_rms_n": None,
                "share": None,
                "let_go": self._bar.let_go_m,
            }
        place, tilt, internal = (math.sqrt(square / self._count) for square in self._squares)
        return {
            "bar_p_rms_m": place,
            "bar_tilt_rms_deg": math.degrees(tilt),
            "internal_force_rms_n": internal,
            "share": self._lifts[0] / sum(self._lifts),
            "let_go": self._bar.let_go_m,
        }
