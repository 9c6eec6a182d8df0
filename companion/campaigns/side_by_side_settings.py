"""In what the effective configurations of flights differ, key by key, and what that means for comparing them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from companion.campaigns.side_by_side_course import Flight

_ADDRESSES = frozenset(
    f"vehicle.devices.{key}"
    for key in (
        "autopilot.address",
        "mocap.server",
        "mocap.interface",
        "mocap.transport",
        "mocap.command_port",
        "mocap.data_port",
        "mocap.multicast_group",
        "arm.port",
        "force.port",
    )
)
"""What the simulated world chooses anew for each flight."""
_NOT_SETTINGS = ("sources.phases", "sources.overrides")
"""Where a value came from; what it is stands under its own key."""

_NAMES = ("sources.", "mission.vehicle")
"""Files by name: what is in them stands under its own keys."""

_SECTIONS = ("mission", "controller", "vehicle", "world", "sources")
_KEYS_TOLD = 4
"""In a sentence; the table has all of them."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One key of the effective configurations, of every flight."""

    key: str
    values: tuple[Any, ...]
    present: tuple[bool, ...]
    """Whether the flight's configuration has the key at all."""


def simulated(config: dict[str, Any]) -> bool:
    """Whether the flight was one in the simulated world: its arm hung on a pseudo-terminal, which no USB adapter is."""
    devices = _part(_part(config, "vehicle"), "devices")
    return str(_part(devices, "arm").get("port", "")).startswith("/dev/pts/")


def payload_kg(flight: Flight) -> float | None:
    """What was thrown, if anybody knows: the launcher of a simulated flight, else its configuration."""
    known = flight.summary["payload_kg"]
    if known is None and simulated(flight.config):
        known = _part(flight.config, "world").get("payload_kg")
    return None if known is None else float(known)


def settings_of(configs: Sequence[dict[str, Any]]) -> tuple[list[Setting], list[Setting]]:
    """Keys that differ, and apart from them those of addresses that the simulated world chose by itself.

    The section `world` of a flight on the vehicle says nothing and is left out.
    """
    in_world = [simulated(config) for config in configs]
    flat = [_flat(config if real else _without_world(config)) for config, real in zip(configs, in_world, strict=True)]
    keys = list(dict.fromkeys(key for one in flat for key in one))
    settings: list[Setting] = []
    addresses: list[Setting] = []
    # Sections in their own order; a key that only a later flight has goes to the end of its section.
    for key in sorted(keys, key=lambda key: _rank(key.partition(".")[0])):
        present = tuple(key in one for one in flat)
        values = tuple(one.get(key) for one in flat)
        if key.startswith(_NOT_SETTINGS) or (all(present) and all(_same(value, values[0]) for value in values)):
            continue
        if not any(values) and any(other.startswith((f"{key}.", f"{key}[")) for other in keys):
            continue  # nothing there in one flight, and in another one what stands under the keys below it
        chosen = key in _ADDRESSES and all(in_world)
        (addresses if chosen else settings).append(Setting(key, values, present))
    return settings, addresses


def fairness(flights: Sequence[Flight], settings: Sequence[Setting]) -> tuple[str, list[str], bool]:
    """One sentence on what the flights differ in; why care is needed, if it is; whether all flew the same mission."""
    kinds: dict[str, list[Setting]] = {}
    for setting in settings:
        if not setting.key.startswith(_NAMES):
            kinds.setdefault(_kind(setting.key), []).append(setting)
    law = kinds.pop("law", [])
    cautions = [_caution(flights, kind, these) for kind, these in kinds.items()]
    same_mission = "mission" not in kinds
    cautions += _circumstances(flights, any(s.key == "world.payload_kg" for s in kinds.get("payload", ())))
    digests = [flight.digest for flight in flights]
    cautions += [
        f"{flight.letter} is the same recording as {flights[digests.index(flight.digest)].letter}."
        for n, flight in enumerate(flights)
        if len(set(digests)) > 1 and digests.index(flight.digest) < n
    ]
    if len(set(digests)) == 1:
        fair = f"The same recording {len(flights)} times: nothing differs."
    elif not law and not cautions:
        fair = "Nothing that was set differs: what differs below is the flights' own scatter."
    elif not law:
        fair = "The law and its gains are the same."
    elif not cautions:
        fair = f"Only the law or its gains differ ({_count(law)})."
    else:
        fair = f"The law or its gains differ ({_count(law)}), and not they alone: the figures show the sum of everything below."
    failed = [f"{flight.letter} ({flight.summary['outcome']})" for flight in flights if not flight.completed]
    if failed:
        cautions.append(f"Not completed: {', '.join(failed)}. RMS figures of a part of the mission are not marked.")
    if not same_mission:
        cautions.append("RMS figures of different missions are not marked better or worse.")
    return fair, cautions, same_mission


def text_of(value: Any) -> str:
    """A value as the files write it."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.10g}"
    if isinstance(value, list):
        return f"[{', '.join(text_of(part) for part in value)}]"
    return str(value)


def _kind(key: str) -> str:
    if key == "controller" or key.startswith(("controller.", "mission.controller.")):
        return "law"
    if key.startswith("vehicle.ground."):
        return "ground station"
    if key == "world.payload_kg":
        return "payload"
    if key == "world.seed":
        return "seed"
    return key.partition(".")[0]


def _caution(flights: Sequence[Flight], kind: str, settings: Sequence[Setting]) -> str:
    if kind in ("payload", "seed"):
        unit = " kg" if kind == "payload" else ""
        values = zip(flights, settings[0].values, settings[0].present, strict=True)
        told = ", ".join(f"{f.letter} {text_of(value) + unit if there else '–'}" for f, value, there in values)
        return f"Different {kind}: {told}."
    told = ", ".join(setting.key for setting in settings[:_KEYS_TOLD])
    return f"Different {kind} ({_count(settings)}): {told}{', ...' if len(settings) > _KEYS_TOLD else '.'}"


def _circumstances(flights: Sequence[Flight], payload_told: bool) -> list[str]:
    """What no configuration holds."""
    out: list[str] = []

    def told(what: str, texts: Sequence[str]) -> None:
        if len(set(texts)) > 1:
            out.append(f"{what}: {', '.join(f'{f.letter} {text}' for f, text in zip(flights, texts, strict=True))}.")

    in_world = [simulated(flight.config) for flight in flights]
    told("Flown in different places", ["in the simulated world" if one else "on the vehicle" for one in in_world])
    payloads = [payload_kg(flight) for flight in flights]
    if not payload_told and None not in payloads:
        told("Different payload", [f"{payload:g} kg" for payload in payloads])
    elif not payload_told:
        unknown = ", ".join(f.letter for f, payload in zip(flights, payloads, strict=True) if payload is None)
        out.append(f"The payload of {unknown} is not known: nobody can say whether it was the same.")
    autopilots = [flight.summary.get("autopilot") or {} for flight in flights]
    told("Different autopilots", [f"{a.get('kind') or '–'}, {a.get('firmware') or 'unknown'}" for a in autopilots])
    rates = [flight.summary["loop"]["rate_hz"] for flight in flights]
    if all(rates) and max(rates) > 1.02 * min(rates):
        told("Different rates of the control loop", [f"{rate:.0f} Hz" for rate in rates])
    abouts = [flight.metadata.get("companion", {}) for flight in flights]
    told(
        "Different versions of companion",
        [f"{a.get('version_companion', '–')} {a.get('version_git', '')[:12]}".strip() for a in abouts],
    )
    names = {name for about in abouts for name in about if name.startswith("version_")}
    others = sorted(
        name.removeprefix("version_")
        for name in names - {"version_companion", "version_git"}
        if len({about.get(name) for about in abouts}) > 1
    )
    if others:
        out.append(f"Different versions of {', '.join(others)}.")
    return out


def _count(settings: Sequence[Setting]) -> str:
    return "1 key" if len(settings) == 1 else f"{len(settings)} keys"


def _same(one: Any, other: Any) -> bool:
    return bool(one == other) and isinstance(one, bool) == isinstance(other, bool)


def _rank(section: str) -> int:
    return _SECTIONS.index(section) if section in _SECTIONS else len(_SECTIONS)


def _part(tree: dict[str, Any], name: str) -> dict[str, Any]:
    part = tree.get(name)
    return part if isinstance(part, dict) else {}


def _without_world(config: dict[str, Any]) -> dict[str, Any]:
    return {name: part for name, part in config.items() if name != "world"}


def _flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Values by dotted key; a list of plain values is one value."""
    if isinstance(tree, dict) and tree:
        parts = [(f"{prefix}.{key}" if prefix else key, value) for key, value in tree.items()]
    elif isinstance(tree, list) and any(isinstance(value, dict) for value in tree):
        parts = [(f"{prefix}[{n}]", value) for n, value in enumerate(tree)]
    else:
        return {prefix: tree}
    return {key: value for name, part in parts for key, value in _flat(part, name).items()}
