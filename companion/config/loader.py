"""Loads the configuration of a flight from its files and the command line."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from companion.config.arm import NO_ARM
from companion.config.base import Location, Model
from companion.config.controller import LAWS, PRESETS, AnyControllerConfig, ControllerConfig, law_class, preset_file
from companion.config.device_checks import missing_on_hardware, unusable_devices
from companion.config.document import (
    RANK_MISSING,
    ConfigError,
    Document,
    key_path,
    problem_lines,
)
from companion.config.explain import another_kind, did_you_mean, validate
from companion.config.mission import ControllerChoice, Mission
from companion.config.overrides import Override, Section, apply_overrides, parse_overrides
from companion.config.phase import usable_class
from companion.config.shipped import named_file, names, near
from companion.config.urdf import read_urdf
from companion.config.vehicle import Vehicle
from companion.config.yaml_strict import read_document

M = TypeVar("M", bound=Model)

POLICY_SUFFIX = ".onnx"
MOVED = {
    ("tether", "react_time_s"): ("safety", "react_time_s"),
    ("tether", "stop_deceleration_m_s2"): ("safety", "stop_deceleration_m_s2"),
    ("safety", "joint_wall_warn_deg"): ("safety", "joint_limit_warn_deg"),
    ("safety", "joint_wall_max_deg"): ("safety", "joint_limit_max_deg"),
}
"""Keys of vehicle files and logs of version 0.1.0, and their present place."""


class Sources(Model):
    """Origins of the parts of a `FlightConfig`, for messages and for the log."""

    mission: str
    vehicle: str
    controller: str
    phases: tuple[str, ...]
    """Origin of each phase of the mission as file:line:column."""
    overrides: tuple[str, ...]
    """`--set` options as the user gave them, without those of the simulated world."""


class FlightConfig(Model):
    """The effective configuration of a flight."""

    mission: Mission
    vehicle: Vehicle
    controller: AnyControllerConfig
    sources: Sources
    agreed: str | None = None
    """Digest of what the computers of both members of a team must have alike (`companion.phases.carry.pair.agreement`); None for a
    vehicle that flies alone.
    """


def load_flight(
    mission_path: str | Path,
    vehicle_path: str | Path | None = None,
    controller_law: str | None = None,
    preset: str | None = None,
    overrides: Sequence[str | Override] = (),
    *,
    hardware: bool = False,
) -> FlightConfig:
    """Read all files of a flight, apply the overrides and check the result.

    Args:
        mission_path: mission file, or the name of a shipped one (`companion.config.shipped`).
        vehicle_path: vehicle file in place of the mission's, or the name of a shipped one.
        controller_law: control law (a key of `PRESETS`), controller file (`*.yaml`) or policy (`*.onnx`) in place of the mission's.
        preset: built-in preset of that law in place of the mission's.
        overrides: `--set` options, `section.key[index].key=value`, applied before anything is checked. Options of the section
            `world` are ignored, because they belong to the simulated world (`companion.sitl_config`).
        hardware: whether the vehicle file's device addresses are used instead of those of SITL. If so, `devices.mocap.interface`
            must name one network, and the types of the devices must be installed.

    Raises:
        ConfigError: the files have problems; the exception has one message per problem.
    """
    parsed = parse_overrides(overrides)
    lines: list[str] = []
    of_vehicle: list[str] = []
    mission_file = read_document(named_file("missions", mission_path, "mission"))
    _override(mission_file, "mission", parsed, lines)
    _rename_phase_keys(mission_file)

    vehicle: Vehicle | None = None
    vehicle_file = _open_named(mission_file, ("vehicle",), vehicle_path, of_vehicle)
    if vehicle_file is not None:
        _override(vehicle_file, "vehicle", parsed, of_vehicle)
        vehicle = vehicle_of(vehicle_file, of_vehicle)
        if hardware and vehicle is not None:
            of_vehicle += missing_on_hardware(vehicle, vehicle_file) + unusable_devices(vehicle, vehicle_file)
    _place_arm(mission_file, vehicle)
    mission = validated(Mission, mission_file, lines)
    lines += of_vehicle

    controller: ControllerConfig | None = None
    controller_file: Document | None = None
    choice = mission.controller if mission is not None else _controller_choice(mission_file)
    if controller_law is None and choice is not None and choice.file is not None:
        controller_file = _open_named(mission_file, ("controller", "file"), None, lines, read_controller)
        if controller_file is not None:
            _suits(controller_file, mission_file, preset, lines)
    elif controller_law is not None or preset is not None:
        controller_file = _open_controller(controller_law or (choice.law if choice is not None else None), preset)
    elif choice is not None:
        controller_file = _open_controller(choice.law, choice.preset)
    if controller_file is not None:
        controller = _check_controller(controller_file, parsed, lines)

    if lines or mission is None or vehicle is None or controller is None:
        raise ConfigError(lines)
    assert vehicle_file is not None
    assert controller_file is not None
    for_vehicle = getattr(law_class(controller.law), "for_vehicle", None)
    if for_vehicle is not None:
        controller = for_vehicle(vehicle, controller)
    return FlightConfig(
        mission=mission,
        vehicle=vehicle,
        controller=controller,
        sources=Sources(
            mission=mission_file.source,
            vehicle=vehicle_file.source,
            controller=controller_file.source,
            phases=tuple(str(mission_file.origin(("phases", index))) for index in range(len(mission.phases))),
            overrides=tuple(str(text) for text, one in zip(overrides, parsed, strict=True) if one.section != "world"),
        ),
    )


def load_vehicle(path: str | Path, overrides: Sequence[str] = ()) -> Vehicle:
    """Read and check a single vehicle file, given by its path or by the name of a shipped one, with the `vehicle.` overrides.

    Raises:
        ConfigError: the file has problems; the exception has one message per problem.
    """
    lines: list[str] = []
    document = read_document(named_file("vehicles", path, "--vehicle"))
    _override(document, "vehicle", parse_overrides(overrides), lines)
    vehicle = vehicle_of(document, lines)
    if vehicle is not None:
        lines += unusable_devices(vehicle, document)
    if vehicle is None or lines:
        raise ConfigError(lines)
    return vehicle


def logged_flight(config_json: str) -> FlightConfig:
    """Return the flight configuration in a log, without the configuration of the simulated world, which older logs contain too.

    Raises:
        ValueError: the text is not JSON, or not a configuration of this version.
    """
    data = json.loads(config_json)
    if isinstance(data, dict):
        data.pop("world", None)
        if isinstance(data.get("vehicle"), dict):
            _move_keys(Document("log", data["vehicle"]))
        if isinstance(data.get("mission"), dict):
            _rename_phase_keys(Document("log", data["mission"]))
    return FlightConfig.model_validate_json(json.dumps(data))


def vehicle_of(document: Document, lines: list[str]) -> Vehicle | None:
    """Return the vehicle of a vehicle file; if it has problems, add one line for each of them and return None."""
    _move_keys(document)
    if document.data.get("arm", NO_ARM) is None:
        document.replace(("arm",), copy.deepcopy(NO_ARM), document.origin(("arm",)))
    _read_urdf(document)
    return validated(Vehicle, document, lines)


def _read_urdf(document: Document) -> None:
    """Replace the name of a URDF file in a vehicle file by the file's links; the name stays, to be shown and logged."""
    location: Location = ("arm", "urdf")
    name, base, tip = (document.find(("arm", key)) for key in ("urdf", "urdf_base", "urdf_tip"))
    if not isinstance(name, str) or not isinstance(base, str | None) or not isinstance(tip, str | None):
        return  # not given, or not text: the check of the vehicle reports it
    origin = document.origin(location)
    if document.find(("arm", "links")) is not None:
        document.report(location, "expected urdf or links, got both")
        return
    folder = Path(document.source).parent if origin.line else Path()
    try:
        arm = read_urdf(Path(os.path.normpath(folder / name)), base, tip)
    except ConfigError as error:
        for line in error.lines:
            document.report(location, line)
        return
    for key, value in arm.items():
        document.replace(("arm", key), value, origin)


def _move_keys(document: Document) -> None:
    """Move the keys of older vehicle files and logs to their present place, unless that has a value too."""
    for (old_part, old_key), (part, key) in MOVED.items():
        old, new = document.data.get(old_part), document.data.setdefault(part, {})
        if isinstance(old, dict) and isinstance(new, dict) and old_key in old and key not in new:
            document.replace((part, key), old[old_key], document.origin((old_part, old_key)))
            del old[old_key]


def _rename_phase_keys(document: Document) -> None:
    """Replace old spellings of keys in the phases of a mission file or of a log."""
    phases = document.data.get("phases")
    for index, phase in enumerate(phases if isinstance(phases, list) else ()):
        if isinstance(phase, dict) and isinstance(name := phase.get("type"), str):
            for old, new in getattr(usable_class(name), "renamed", {}).items():
                document.rename(("phases", index), old, new)


def _place_arm(document: Document, vehicle: Vehicle | None) -> None:
    """Replace poses' names in a mission by joint angles (empty without a valid vehicle), and check the number of angles."""
    phases = document.find(("phases",))
    places: list[Location] = [("start", "arm_deg")]
    places += [("phases", index, "arm_deg") for index in range(len(phases) if isinstance(phases, list) else 0)]
    for place in places:
        given = document.find(place)
        if isinstance(given, str):
            poses_deg = vehicle.poses_deg if vehicle is not None else {given: ()}
            if given not in poses_deg:
                if vehicle is not None and vehicle.arm.joints:
                    text = f'expected joint angles or a pose of the vehicle ({", ".join(poses_deg)}), got "{given}"'
                    text += did_you_mean(given, list(poses_deg)) or "; define it in arm.poses of the vehicle file"
                else:
                    text = f'the mission moves the arm to "{given}", but the vehicle has no arm; choose a mission without arm '
                    text += "motion, such as hover, or a vehicle with an arm"
                document.report(place, text)
            document.replace(place, list(poses_deg.get(given, ())), document.origin(place))
        elif isinstance(given, list) and vehicle is not None and len(given) != len(vehicle.arm.joints):
            text = f"expected {len(vehicle.arm.joints)} joint angles, as many as the vehicle has, got {len(given)}"
            document.report(place, text)


def _check_controller(document: Document, overrides: list[Override], lines: list[str]) -> ControllerConfig | None:
    _override(document, "controller", overrides, lines)
    law = document.find(("law",))
    if isinstance(law, str) and law in LAWS:
        return validated(LAWS[law], document, lines)
    expected = f"expected one of {', '.join(LAWS)}"
    another = another_kind({"properties": {"law": {}}}, document)
    if another is not None:
        lines.append(f"{document.source}: {another}")
        return None
    if law is None:
        document.report(("law",), f"missing; {expected}", RANK_MISSING)
    else:
        document.report(("law",), f"{expected}, got {json.dumps(law)}{did_you_mean(str(law), list(LAWS))}")
    lines += problem_lines(document.problems)
    return None


def _override(document: Document, section: Section, overrides: list[Override], lines: list[str]) -> None:
    try:
        apply_overrides(document, section, overrides)
    except ConfigError as error:
        lines += error.lines


def validated(model: type[M], document: Document, lines: list[str]) -> M | None:
    """Return the model of a document; if it has problems, add one line for each of them and return None."""
    built = validate(model, document)
    lines += problem_lines(document.problems)
    return built


def _open_named(
    mission_file: Document,
    location: Location,
    given: str | Path | None,
    lines: list[str],
    read: Callable[[str], Document] = read_document,
) -> Document | None:
    """Read the file `given` or, if that is None, the file that the mission names, relative to the mission file. A vehicle
    may be named as `--vehicle` names it.
    """
    where = hint = ""
    try:
        if given is not None:
            return read_document(named_file("vehicles", given, "--vehicle"))
        named = mission_file.find(location)
        if not isinstance(named, str):
            return None  # missing or not text: the check of the mission reports it
        origin = mission_file.origin(location)
        base = Path(mission_file.source).parent if origin.line else Path()
        where = f"{origin}: {key_path(location)}: "
        path = base / named
        if location == ("vehicle",) and not path.suffix and not path.exists():
            path = named_file("vehicles", named)
        elif location == ("vehicle",) and path.stem in names("vehicles") and not path.exists():
            hint = f"; the shipped file is named without a path: vehicle: {path.stem}"
        return read(os.path.normpath(path))
    except ConfigError as error:
        lines += [where + line + hint for line in error.lines]
        return None


def _controller_choice(mission_file: Document) -> ControllerChoice | None:
    """Return the controller choice of an otherwise invalid mission, so that problems of the controller file are reported too."""
    try:
        return ControllerChoice.model_validate(mission_file.find(("controller",)) or {})
    except ValidationError:
        return None


def is_controller_file(law: str) -> bool:
    """Return whether the name of a controller file or of a policy was given in place of a control law."""
    return Path(law).suffix in (".yaml", ".yml", POLICY_SUFFIX)


def read_controller(path: str) -> Document:
    """Read a controller file; for a policy return the one that names it.

    Raises:
        ConfigError: the file cannot be read.
    """
    if Path(path).suffix != POLICY_SUFFIX:
        return read_document(path)
    return Document(path, {"schema_version": 1, "law": "policy", "preset": Path(path).stem, "file": path})


def preset_of_file(path: str) -> str:
    """Return the name that a controller file gives its gains; an invalid one is left to validation.

    Raises:
        ConfigError: the file cannot be read.
    """
    return str(read_controller(path).data.get("preset"))


def _suits(document: Document, mission_file: Document, preset: str | None, lines: list[str]) -> None:
    """Add a line if the controller file of a mission is not that of the law or of the preset which is given as well."""
    own, law = document.data.get("law"), mission_file.find(("controller", "law"))
    if law not in (None, own):
        text = f"expected {json.dumps(own)}, the law of controller.file, got {json.dumps(law)}; leave it out"
        lines.append(f"{mission_file.origin(('controller', 'law'))}: controller.law: {text}")
    try:
        _has_preset(document, preset)
    except ConfigError as error:
        lines += error.lines


def _has_preset(document: Document, preset: str | None) -> None:
    own = document.data.get("preset")
    if preset not in (None, own):
        raise ConfigError(
            f"--preset {preset}: the file {document.source} has the gains {json.dumps(own)}; leave --preset out"
        )


def _open_controller(law: str | None, preset: str | None) -> Document:
    """Read the file of a law's preset, or the file whose path is given in place of the law."""
    law = law or next(iter(PRESETS))
    if is_controller_file(law):
        document = read_controller(law)
        _has_preset(document, preset)
        return document
    if law not in PRESETS:
        raise ConfigError(
            f"--controller {law}: no such controller; available: {', '.join(PRESETS)}, or a file (*.yaml, *.onnx)"
            + did_you_mean(law, list(PRESETS))
        )
    if LAWS[law].needs_file:
        raise ConfigError(f"control law '{law}' has no presets: name its file in place of the law, such as {law}.onnx")
    preset = preset or PRESETS[law][-1]
    if preset not in PRESETS[law]:
        hint = did_you_mean(preset, list(PRESETS[law]))
        raise ConfigError(f"--preset {preset}: no such preset of '{law}'; available: {', '.join(PRESETS[law])}{hint}")
    return read_document(near(preset_file(law, preset)))
