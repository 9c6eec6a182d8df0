"""What truly happened to the bar that two vehicles carry, in the fast loop."""

from __future__ import annotations

from companion.analysis.pair import PairFigures, carries
from companion.model.outputs import Outputs
from companion.model.team import CarryState
from sitl.world.scene import Scene


class PairTruth:
    """Collects the errors of the bar while both carry it; call `watch` after each tick of a member.

    Args:
        scene: a scene with a bar.
    """

    def __init__(self, scene: Scene) -> None:
        assert scene.bar is not None
        self._bar = scene.bar
        self._figures = PairFigures()
        self._planned: CarryState | None = None
        self._carries = [False, False]

    def watch(self, number: int, outputs: Outputs) -> None:
        """Take the state of the bar after a tick of a member: 0 is the left one."""
        self._carries[number] = carries(outputs)
        if number == 0:
            self._planned = outputs.carry
            return
        planned, bar = self._planned, self._bar
        if planned is not None and all(self._carries) and all(bar.gripped):
            pulls = [bar.force_world_n(machine) for machine in (0, 1)]
            self._figures.add(*bar.pose, pulls, planned.centre_world_m)

    def report(self) -> dict[str, float | None]:
        """Return the figures of `summary.json`; None where the bar was never carried."""
        return self._figures.report(self._bar.let_go_m)
