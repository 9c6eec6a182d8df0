"""Loads a team file: the configuration of each member, checked against that of the other."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from companion.config.document import ConfigError, Document
from companion.config.ground import topic_name
from companion.config.loader import validated
from companion.config.overrides import Override, override_of
from companion.config.shipped import named_file
from companion.config.team import Member, Team
from companion.config.yaml_strict import read_document
from companion.phases.carry.bar import End
from companion.phases.carry.pair import agreement, pair_problems
from companion.sitl_config.loader import SitlConfig, load_sitl

TEAM_WORLD = "pair"
"""The world of a simulated team whose command names none."""
ENDS: tuple[End, End] = ("left", "right")
SEED_APART = 1_000_000
"""Difference of the seeds of the two members' laboratories; the bar is that of the left one."""
TEAM_PORT = 14700


@dataclass(frozen=True, slots=True)
class TeamConfig:
    """The checked configuration of both members."""

    name: str
    source: str
    left: SitlConfig
    right: SitlConfig

    @property
    def members(self) -> tuple[tuple[End, SitlConfig], tuple[End, SitlConfig]]:
        """The members, the left one first."""
        return ("left", self.left), ("right", self.right)


def load_team(
    path: str | Path,
    overrides: Sequence[str] = (),
    *,
    controller_law: str | None = None,
    preset: str | None = None,
    on_hardware: End | None = None,
    world: str = TEAM_WORLD,
    real_px4: bool = False,
) -> TeamConfig:
    """Read a team file and all files that it names, and check them.

    Args:
        path: team file, or the name of a shipped one.
        overrides: `--set` options for both members, or for one of them with `left.` or `right.` in front, after those of the file.
        controller_law: as in `load_flight`, for both members.
        preset: as in `load_flight`, for both members.
        on_hardware: the member that this computer flies on hardware, with what only hardware needs; None in simulation.
        world: name of a built-in world, or path of a file.
        real_px4: as in `load_sitl`.

    Raises:
        ConfigError: the files have problems, or the members do not go together; the exception has one message per problem.
        PluginError: as in `load_sitl`.
    """
    document = read_document(named_file("teams", path, "team"))
    lines: list[str] = []
    team = validated(Team, document, lines)
    if team is None:
        raise ConfigError(lines)
    folder = Path(document.source).parent
    mission = folder / team.mission
    grips = _grips_of(mission, document)
    configs: dict[str, SitlConfig] = {}
    for end in ENDS:
        member: Member = getattr(team.members, end)
        own = [*_overrides_of(team.name, end, member, document, grips), *_of_member(end, overrides)]
        if end == "right" and configs:
            origin = document.origin(("members", end))
            own.append(override_of("world.seed", configs["left"].world.seed + SEED_APART, origin))
        if not real_px4:  # which has one by the number of its instance
            own.insert(
                0, override_of("world.px4_params.MAV_SYS_ID", ENDS.index(end) + 1, document.origin(("members", end)))
            )
        try:
            configs[end] = load_sitl(
                mission,
                None if member.vehicle is None else folder / member.vehicle,
                controller_law or (None if member.controller is None else str(folder / member.controller)),
                preset,
                own,
                hardware=end == on_hardware,
                world=world,
                real_px4=real_px4,
            )
        except ConfigError as error:
            lines += [line for line in error.lines if line not in lines]
    if lines:
        raise ConfigError(lines)
    found = TeamConfig(team.name, document.source, configs["left"], configs["right"])
    if lines := [f"{document.source}: {text}" for text in pair_problems(found.left, found.right)]:
        raise ConfigError(lines)
    agreed = {"agreed": agreement(found.left, found.right)}
    left, right = (config.model_copy(update=agreed) for _, config in found.members)
    return replace(found, left=left, right=right)


def _of_member(end: End, overrides: Sequence[str]) -> list[str]:
    named = [(text.lstrip().partition("."), text) for text in overrides]
    return [rest if head in ENDS else text for (head, _, rest), text in named if head not in ENDS or head == end]


def _grips_of(mission: Path, document: Document) -> list[int]:
    """Return the indices of a member's phases of type grip; raises ConfigError if the mission is unreadable or has none."""
    phases = read_document(mission).find(("phases",))
    found = [
        index
        for index, phase in enumerate(phases if isinstance(phases, list) else ())
        if isinstance(phase, dict) and phase.get("type") == "grip"
    ]
    if not found:
        raise ConfigError(
            f"{document.origin(('mission',))}: mission: {mission} has no phase of type grip, so that no team is needed"
        )
    return found


def _overrides_of(
    team: str, end: End, member: Member, document: Document, grips: Sequence[int]
) -> Iterator[str | Override]:
    at = document.origin(("members", end))
    for index in grips:
        yield override_of(f"mission.phases[{index}].end", end, at)
    ports = {"left": TEAM_PORT, "right": TEAM_PORT + 1}
    other = "right" if end == "left" else "left"
    yield override_of("vehicle.devices.team.port", ports[end], at)
    yield override_of("vehicle.devices.team.partner_port", ports[other], at)
    yield override_of("vehicle.ground.topic", topic_name(None, f"{team}-{end}"), at)
    for name, value in member.set.items():
        yield override_of(name, json.loads(json.dumps(value)), document.key_origin(("members", end, "set", name)))
