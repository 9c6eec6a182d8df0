"""Checks of PX4's firmware and parameters against the table `companion.px4.required`. Pure functions."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

from companion.config.vehicle import Vehicle
from companion.model.check_row import Level, Row
from companion.preflight.checks import Check
from companion.px4.required import ROTOR_COUNT, WANTED
from companion.px4.rotors import differences
from companion.px4.versions import KNOWN_GOOD, OLDEST, varies
from companion.px4.wanted import Value, Wanted

ROTORS = Check(
    "px4.rotors",
    "rotors in PX4",
    "`CA_ROTORi_PX`, `CA_ROTORi_PY` and the sign of `CA_ROTORi_KM` place every rotor and its spin direction as in the vehicle file",
    "with another order of rotors or another spin direction, the vehicle flips or spins at take-off",
)
CHECKS = (ROTORS,)
FIRMWARE_ID = "px4.firmware"
UNREAD = Check("px4.params", "PX4 parameters", why="PX4's behaviour would be unknown")
PARAM_ID = "px4.param."
"""Prefix of the id of a parameter's row; the parameter's name follows it."""

_FIRMWARE = re.compile(r"PX4 (\d+)\.(\d+)\.(\d+) (\w+)")
_FIRMWARE_WHY = "the meaning of parameters and the behaviour of EKF2 change between versions"
_WRITE = "companion px4 params --write"


def rows(firmware: str | None, params: Mapping[str, Value], vehicle: Vehicle) -> list[Row]:
    """Return one row for the firmware and one per parameter.

    Args:
        firmware: text returned by `MavsdkAutopilot.firmware`; None to return no row on the firmware.
        params: PX4's parameters by name; parameters that PX4 does not have are absent.
    """
    found = [] if firmware is None else [firmware_row(firmware)]
    if not params:
        if firmware is not None:
            found.append(UNREAD.bad("none could be read", "", "check the link, then try again"))
        return found
    return [*found, *_param_rows(params, vehicle), *_rotor_rows(params, vehicle)]


def firmware_row(firmware: str) -> Row:
    """Return the row of the firmware, such as `PX4 1.16.1 release (git ...)`: 1.16 and 1.18 pass, before 1.15 fails, others warn."""
    wanted = "1.16.x or 1.18.x, a release"

    def row(ok: bool, level: Level = Level.WARN, fix: str = "") -> Row:
        return Row(
            id=FIRMWARE_ID,
            title="PX4 firmware",
            ok=ok,
            read=firmware,
            wanted=wanted,
            why=_FIRMWARE_WHY,
            fix=fix,
            level=level,
        )

    match = _FIRMWARE.match(firmware)
    if match is None:
        return row(False, fix="flash a release of PX4 1.15 to 1.18")
    version, kind = (int(match[1]), int(match[2])), match[4]
    if version < OLDEST:
        return row(
            False, Level.REFUSE, "flash a release of PX4 1.15 to 1.18: parameters of this version have different names"
        )
    if version not in KNOWN_GOOD:
        return row(False, fix="this version was not tested: flash 1.15 to 1.18, or fly with care on a tether")
    if kind != "release":
        return row(False, fix=f"this is a {kind} build: flash a release build")
    return row(True)


def _param_rows(params: Mapping[str, Value], vehicle: Vehicle) -> Iterator[Row]:
    serial = vehicle.devices.autopilot.address.startswith("serial")
    for wanted in WANTED:
        if wanted.hardware and not serial:
            continue
        value = params.get(wanted.name)
        text = wanted.text(vehicle)
        check = Check(PARAM_ID + wanted.name, wanted.name, why=wanted.why, warns=wanted.level is Level.WARN)
        if value is not None:
            yield check.row(wanted.accepts(value, vehicle), text_of(value), text, fix_of(wanted))
        elif not varies(wanted.name):
            fix = "check the firmware: PX4 1.16 and 1.18 have this parameter"
            yield check.doubtful("PX4 does not have this parameter", text, fix)


def _rotor_rows(params: Mapping[str, Value], vehicle: Vehicle) -> Iterator[Row]:
    layout = vehicle.airframe.rotor_layout
    if params.get(ROTOR_COUNT, layout.count) != layout.count:
        return  # the row of the parameter refuses
    wanted = "as in the vehicle file: airframe.layout or airframe.rotors"
    found = differences(params, layout)
    if found is None:
        yield ROTORS.doubtful(
            "PX4 lacks CA_ROTORi_PX, _PY or _KM", wanted, "check motor order and spin directions by hand"
        )
    elif found:
        fix = "select the machine's airframe in QGroundControl, or correct airframe.layout or airframe.rotors"
        yield ROTORS.bad("; ".join(found), wanted, fix)
    else:
        yield ROTORS.good(f"{layout.count} rotors in the same places, with the same spin directions", wanted)


def fix_of(wanted: Wanted) -> str:
    """Return the remedy for a value that is not accepted."""
    if wanted.fix:
        fix = wanted.fix
    else:
        fix = f"set {wanted.name} to {text_of(wanted.value)} ({_WRITE})" if wanted.value is not None else ""
    return f"{fix}, then reboot PX4" if wanted.reboot else fix


def text_of(value: Value | None) -> str:
    """Return a value as text, with at most seven significant digits for a REAL32."""
    return f"{value:.7g}" if isinstance(value, float) else f"{value}"
