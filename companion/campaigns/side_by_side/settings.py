"""The keys in which the effective configurations of flights differ, and whether the flights can be compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from companion.analysis.flat import flat
from companion.campaigns.side_by_side.flight import Flight

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
"""Keys that the simulated world sets for each flight."""
_NOT_SETTINGS = ("sources.phases", "sources.overrides")
"""Keys that hold the origin of values; the values have their own keys."""

_NAMES = ("sources.", "mission.vehicle")
"""Keys that hold names of files; the files' contents have their own keys."""

_SECTIONS = ("mission", "controller", "vehicle", "world", "sources")
_KEYS_SHOWN = 4
"""Maximum number of keys that a sentence names; the table has all of them."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One configuration key and its value in each flight's effective configuration."""

    key: str
    values: tuple[Any, ...]
    present: tuple[bool, ...]
    """Whether the configuration of each flight has the key."""


def simulated(config: dict[str, Any]) -> bool:
    """Return whether the flight was simulated: its arm is on a pseudo-terminal or, without an arm, its mocap on this computer."""
    devices = _part(_part(config, "vehicle"), "devices")
    port = _part(devices, "arm").get("port")
    if port is None:
        return _part(devices, "mocap").get("server") == "127.0.0.1"
    return str(port).startswith("/dev/pts/")


def payload_kg(flight: Flight) -> float | None:
    """Return the mass thrown, from the summary of a simulated flight or else from its configuration; None if unknown."""
    known = flight.summary["payload_kg"]
    if known is None and simulated(flight.config):
        known = _part(flight.config, "world").get("payload_kg")
    return None if known is None else float(known)


def settings_of(configs: Sequence[dict[str, Any]]) -> tuple[list[Setting], list[Setting]]:
    """Return the differing settings, and separately the differing addresses chosen by the simulated world.

    The section `world` of a flight on hardware is meaningless and left out.
    """
    in_world = [simulated(config) for config in configs]
    named = [
        {key: value for key, value in flat(config, _of_sections) if simulation or not key.startswith("world")}
        for config, simulation in zip(configs, in_world, strict=True)
    ]
    keys = list(dict.fromkeys(key for one in named for key in one))
    settings: list[Setting] = []
    addresses: list[Setting] = []
    # Sections keep their order; a key that only a later flight has is appended to its section.
    for key in sorted(keys, key=lambda key: _rank(key.partition(".")[0])):
        present = tuple(key in one for one in named)
        values = tuple(one.get(key) for one in named)
        if key.startswith(_NOT_SETTINGS) or (all(present) and all(_same(value, values[0]) for value in values)):
            continue
        if not any(values) and any(other.startswith((f"{key}.", f"{key}[")) for other in keys):
            continue  # empty in one flight; the keys below it show the values of another flight
        chosen = key in _ADDRESSES and all(in_world)
        (addresses if chosen else settings).append(Setting(key, values, present))
    return settings, addresses


def fairness(flights: Sequence[Flight], settings: Sequence[Setting]) -> tuple[str, list[str], bool]:
    """Return one sentence on the differences, the cautions, and whether all flights flew the same mission."""
    kinds: dict[str, list[Setting]] = {}
    for setting in settings:
        if not setting.key.startswith(_NAMES):
            kinds.setdefault(_kind(setting.key), []).append(setting)
    law = kinds.pop("law", [])
    cautions = [_caution(flights, kind, these) for kind, these in kinds.items()]
    same_mission = "mission" not in kinds
    cautions += _circumstances(flights, any(s.key == "world.payload_kg" for s in kinds.get("payload", ())))
    digests = [flight.digest for flight in flights]
    same_recording = len(set(digests)) == 1
    for n, flight in enumerate(flights):
        first = digests.index(flight.digest)
        if first < n and not same_recording:
            cautions.append(f"{flight.letter} is the same recording as {flights[first].letter}.")
    if same_recording:
        fair = f"The same recording {len(flights)} times: nothing differs."
    elif not law and not cautions:
        fair = "No setting differs: the differences below are scatter between flights."
    elif not law:
        fair = "The law and its gains are the same."
    elif not cautions:
        fair = f"Only the law or its gains differ ({_count(law)})."
    else:
        fair = f"The law or its gains differ ({_count(law)}), and so do the settings below: the metrics show the combined effect."
    failed = [f"{flight.letter} ({flight.summary['outcome']})" for flight in flights if not flight.completed]
    if failed:
        cautions.append(f"Not completed: {', '.join(failed)}. RMS errors of an incomplete mission are not marked.")
    cautions += [f"{flight.letter}: {end}." for flight in flights if (end := flight.summary["log_end_missing"])]
    if not same_mission:
        cautions.append("RMS errors of different missions are not marked better or worse.")
    return fair, cautions, same_mission


def text_of(value: Any) -> str:
    """Return a value in the format of a configuration file."""
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
    told = ", ".join(setting.key for setting in settings[:_KEYS_SHOWN])
    return f"Different {kind} ({_count(settings)}): {told}{', ...' if len(settings) > _KEYS_SHOWN else '.'}"


def _circumstances(flights: Sequence[Flight], payload_told: bool) -> list[str]:
    """Return the differences that are not in the configurations."""
    out: list[str] = []

    def differ(what: str, texts: Sequence[str]) -> None:
        if len(set(texts)) > 1:
            out.append(f"{what}: {', '.join(f'{f.letter} {text}' for f, text in zip(flights, texts, strict=True))}.")

    in_world = [simulated(flight.config) for flight in flights]
    differ("Flown in different places", ["in the simulated world" if one else "on the vehicle" for one in in_world])
    payloads = [payload_kg(flight) for flight in flights]
    if not payload_told and None not in payloads:
        differ("Different payload", [f"{payload:g} kg" for payload in payloads])
    elif not payload_told:
        unknown = ", ".join(f.letter for f, payload in zip(flights, payloads, strict=True) if payload is None)
        out.append(f"The payload of {unknown} is not known; it may differ.")
    autopilots = [flight.summary.get("autopilot") or {} for flight in flights]
    differ("Different autopilots", [f"{a.get('kind') or '–'}, {a.get('firmware') or 'unknown'}" for a in autopilots])
    rates = [flight.summary["loop"]["rate_hz"] for flight in flights]
    if all(rates) and max(rates) > 1.02 * min(rates):
        differ("Different rates of the control loop", [f"{rate:.0f} Hz" for rate in rates])
    abouts = [flight.metadata.get("companion", {}) for flight in flights]
    differ(
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


def _of_sections(values: Sequence[Any]) -> bool:
    """Return whether a list holds sections, as that of the phases; a list of plain values is one value."""
    return any(isinstance(value, dict) for value in values)


def _part(tree: dict[str, Any], name: str) -> dict[str, Any]:
    part = tree.get(name)
    return part if isinstance(part, dict) else {}
