"""`companion px4 params`: compare the connected PX4's parameters with a file, or write the file's values to PX4."""

from __future__ import annotations

import argparse
import asyncio
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion.cli.options import time_stamp
from companion.config.devices import AutopilotDevice
from companion.config.document import ConfigError
from companion.config.loader import load_vehicle
from companion.config.shipped import DEFAULT_VEHICLE
from companion.io.protocols import DeviceError
from companion.io.px4.transfer import Comparison, Difference, WriteResult, compare, write
from companion.model.exit_codes import EXIT_OK, EXIT_REFUSED
from companion.model.link_address import parse_address
from companion.px4 import params_file
from companion.px4.params_file import PACKAGED, VEHICLE_ID, ParamsFile, skipped_lines, value_text
from companion.runtime.clock import flight_clock
from companion.runtime.console import print_error

if TYPE_CHECKING:
    from companion.io.px4.driver import MavsdkAutopilot

_HEARTBEAT_DEADLINE_S = 5.0


def add_parser(commands: Any) -> None:
    px4 = commands.add_parser("px4", help="compare PX4's parameters with a file, or write them")
    parts = px4.add_subparsers(dest="part", required=True, metavar="PART")
    params = parts.add_parser(
        "params",
        help="compare or write parameters",
        description="Compare the connected PX4's parameters with a file in QGroundControl's format, or write the differing values. "
        "Exit 0: no value differs (after writing); 3: a value differs or could not be written.",
    )
    what = params.add_mutually_exclusive_group(required=True)
    what.add_argument("--diff", action="store_true", help="only compare")
    what.add_argument("--write", action="store_true", help="write the differing values; refused while PX4 is armed")
    params.add_argument(
        "file",
        nargs="?",
        type=Path,
        metavar="FILE",
        help="parameter file (default: the one in configs/px4/, for indoor motion capture)",
    )
    where = params.add_mutually_exclusive_group()
    where.add_argument(
        "--vehicle",
        metavar="FILE",
        default=DEFAULT_VEHICLE,
        help=f"vehicle file with PX4's address (default: {DEFAULT_VEHICLE})",
    )
    where.add_argument("--address", help="address of the link, e.g. udpin://0.0.0.0:14540")
    params.add_argument(
        "--backup", type=Path, metavar="FILE", help="file for the old values (default: px4_TIME.params)"
    )
    params.add_argument("--json", action="store_true", help="print the result as JSON and nothing else")
    params.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Compare PX4's parameters with the file, write the differences if requested, and print the result; return the exit code.

    Raises:
        ConfigError: the parameter file, the vehicle file or --address is invalid, or the parameters are of another vehicle.
    """
    path = arguments.file or PACKAGED
    file = params_file.read(path)
    if arguments.address is None:
        device = load_vehicle(arguments.vehicle).devices.autopilot
    else:
        try:
            parse_address(arguments.address)
        except ValueError as error:
            raise ConfigError(f"--address: {error}") from None
        device = AutopilotDevice(address=arguments.address)
    try:
        return asyncio.run(_run(arguments, file, device, path))
    except DeviceError as error:
        print_error(error)
        return EXIT_REFUSED


async def _run(arguments: argparse.Namespace, file: ParamsFile, device: AutopilotDevice, path: Path) -> int:
    # MAVSDK's library is slow to load, so not every command imports it
    from companion.io.px4.driver import MavsdkAutopilot
    from companion.io.px4.params import ALWAYS_THERE

    async with MavsdkAutopilot(device, flight_clock()) as autopilot:
        names = {name: None for values in file.values.values() for name in values}
        found = await autopilot.read_params([*names, ALWAYS_THERE])
        system = int(found.get(ALWAYS_THERE, VEHICLE_ID))
        wanted, skipped = file.of_vehicle(system)
        comparison = compare(wanted, found, skipped)
        if not arguments.write or not comparison.differences:
            _print(arguments, comparison, None, None)
            return EXIT_OK if comparison.same else EXIT_REFUSED
        if await _armed(autopilot):
            print_error(
                f"autopilot {device.address}: expected a disarmed PX4, but it is armed; land and disarm before writing"
            )
            return EXIT_REFUSED
        backup = arguments.backup or Path(f"px4_{time_stamp()}.params")
        _back_up(backup, comparison.differences, await autopilot.firmware(), path.name, system)
        result = await write(autopilot, comparison.differences)
    _print(arguments, comparison, result, backup)
    return EXIT_OK if result.problem is None and not comparison.absent else EXIT_REFUSED


async def _armed(autopilot: MavsdkAutopilot) -> bool:
    async with asyncio.timeout(_HEARTBEAT_DEADLINE_S):
        while (status := autopilot.status()) is None:  # noqa: ASYNC110 - written by MAVSDK's threads
            await asyncio.sleep(0.02)
    return status.armed


def _back_up(path: Path, differences: Sequence[Difference], firmware: str, source: str, system: int) -> None:
    """Save the old values; raises ConfigError if they cannot be saved, so that nothing may be written."""
    heading = [f"Values, before writing, of the parameters that {source} changes, read from {firmware}.", ""]
    values = {difference.name: difference.px4 for difference in differences}
    text = params_file.text(values, heading, vehicle_id=system)
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise ConfigError(f"--backup {path}: already exists; choose another name (nothing was written)") from None
    except OSError as error:
        raise ConfigError(
            f"--backup {path}: {error.strerror or error}; choose a writable path (nothing was written)"
        ) from None


def _print(
    arguments: argparse.Namespace, comparison: Comparison, result: WriteResult | None, backup: Path | None
) -> None:
    if arguments.json:
        print(json.dumps(jsonable(comparison, result, backup), indent=2, allow_nan=False))
        return
    for line in lines(comparison, result):
        print(line)
    if backup is not None:
        print(f"old values: {backup}")


def jsonable(comparison: Comparison, result: WriteResult | None, backup: Path | None) -> dict[str, Any]:
    """Return the result for scripts. `reboot` is null if unknown; a comparison has no `written`."""
    done: dict[str, Any] = {}
    ok = comparison.same
    if result is not None:
        ok = result.problem is None and not comparison.absent
        done = {
            "written": [difference.name for difference in result.written],
            "problem": result.problem,
            "backup": str(backup),
            "reboot": [difference.name for difference in result.written if difference.reboot],
        }
    return {
        "schema_version": 1,
        "ok": ok,
        "differs": [{"name": d.name, "px4": d.px4, "file": d.file, "reboot": d.reboot} for d in comparison.differences],
        "absent": list(comparison.absent),
        "absent_port": list(comparison.absent_port),
        "skipped": [
            {"vehicle": vehicle, "component": component, "names": names}
            for (vehicle, component), names in comparison.skipped.items()
        ],
        "measured": [{"name": d.name, "px4": d.px4, "file": d.file} for d in comparison.measured],
        **done,
    }


def lines(comparison: Comparison, result: WriteResult | None) -> list[str]:
    """Return the result as text."""
    shown = [
        f"{d.name:16}  {value_text(d.px4):>12} -> {value_text(d.file)}{'  (after a reboot)' if d.reboot else ''}"
        for d in (comparison.differences if result is None else result.written)
    ]
    shown += [f"{name:16}  PX4 does not have this parameter" for name in comparison.absent]
    differ = len(shown)
    shown += [f"{name:16}  this PX4 has no such serial port; skipped" for name in comparison.absent_port]
    shown += [
        f"{d.name:16}  {value_text(d.px4):>12}, measured for each vehicle and left unchanged (the file has {value_text(d.file)})"
        for d in comparison.measured
    ]
    shown += [f"skipped, because it is not this vehicle's PX4: {line}" for line in skipped_lines(comparison.skipped)]
    if result is None:
        shown.append("nothing differs" if comparison.same else f"{differ} differ")
        return shown
    shown.append(f"{len(result.written)} of {len(comparison.differences)} written, each read back")
    if result.problem is not None:
        shown.append(result.problem)
    reboot = [difference.name for difference in result.written if difference.reboot]
    if reboot:
        shown.append(f"reboot PX4: {', '.join(reboot)}")
    if any(difference.reboot is None for difference in result.written):
        shown.append("it is not known whether parameters other than this project's need a reboot")
    return shown
