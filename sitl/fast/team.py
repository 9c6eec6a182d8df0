"""The fast closed loop of two vehicles that carry one bar: two flights in one scene, with the link between them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from companion.model.team import PartnerState, TeamState
from companion.model.types import OperatorCommand
from companion.sitl_config.team import TeamConfig
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult, garbage_collection_paused
from sitl.world.pair import pair_scene
from sitl.world.pair_truth import PairTruth

LINK_PERIOD_S: Final = 0.02
LINK_DELAY_S: Final = 0.002


@dataclass
class TeamResult:
    """Record of the flight of a team."""

    members: tuple[FastResult, FastResult] = field(default_factory=lambda: (FastResult(), FastResult()))
    """Record of each member, the left one first."""
    truth: PairTruth | None = None
    """What the bar did."""


class FastTeam:
    """One flight of two vehicles.

    Args:
        commands: the operator's commands to each member, by time.
        link_delay_s: delay of what a member says at a time; infinite for what is lost.
    """

    def __init__(
        self,
        config: TeamConfig,
        commands: Sequence[Mapping[float, OperatorCommand]] = ({}, {}),
        link_delay_s: Callable[[float], float] = lambda t_s: LINK_DELAY_S,
    ) -> None:
        configs = [each for _, each in config.members]
        self.scene = pair_scene(configs)
        self.flights = tuple(
            FastFlight(each, own, scene=self.scene, number=number)
            for number, (each, own) in enumerate(zip(configs, commands, strict=True))
        )
        self._links = (_Link(link_delay_s), _Link(link_delay_s))
        """What each member has sent and the other has not received yet."""

    def run(self, limit_s: float = 120.0) -> TeamResult:
        """Fly until both flights have ended, at most until world time `limit_s`."""
        result = TeamResult()
        scene, flights = self.scene, self.flights
        result.truth = truth = PairTruth(scene)
        with garbage_collection_paused():
            for flight, record in zip(flights, result.members, strict=True):
                flight.begin(record, limit_s)
            while not all(flight.over for flight in flights):
                for flight in flights:
                    flight.plant.act(flight.px4.armed)
                scene.step(airborne=False)
                t_s = scene.t_s
                for number, flight in enumerate(flights):
                    said = self._links[1 - number].take(t_s)
                    if said is not None:
                        flight.partner = PartnerState(stamp_s=t_s, said=said)
                    outputs = flight.after_step()
                    self._links[number].send(t_s, flight.announced(outputs))
                    if outputs is not None:
                        truth.watch(number, outputs)
        return result


class _Link:
    """One direction of the link between the vehicles."""

    def __init__(self, delay_s: Callable[[float], float]) -> None:
        self._delay_s, self._due_s = delay_s, 0.0
        self._sent: list[tuple[float, TeamState]] = []

    def send(self, t_s: float, said: TeamState | None) -> None:
        """Send an announcement, if one is due."""
        if said is None or t_s < self._due_s:
            return
        self._due_s = t_s + LINK_PERIOD_S - 1e-9
        arrives_s = t_s + self._delay_s(t_s)
        if arrives_s < math.inf:
            self._sent.append((arrives_s, said))

    def take(self, t_s: float) -> TeamState | None:
        """Return the newest announcement that has arrived since the last call; None if there is none."""
        newest = None
        while self._sent and self._sent[0][0] <= t_s + 1e-9:
            newest = self._sent.pop(0)[1]
        return newest
