"""`companion check`: run every check that a flight runs before it arms. Nothing moves or is armed."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.padding import Padding
from rich.status import Status
from rich.table import Table
from rich.text import Text

from companion.cli.campaign import wide_console
from companion.config.document import ConfigError
from companion.config.left_out import figures_left_out
from companion.config.loader import FlightConfig
from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.control.scaled_gains import scale_text
from companion.io.devices import open_available
from companion.io.protocols import DeviceError
from companion.launcher.launcher import replace_device_settings
from companion.launcher.sitl_process import SitlProcess
from companion.mission.check import check_mission
from companion.mission.plan import Plan
from companion.model.check_row import Level, Row, refusals
from companion.model.exit_codes import EXIT_OK, EXIT_REFUSED
from companion.model.launcher_messages import WorldMessage, WorldProgress
from companion.model.observations import Observations
from companion.plugins import CONTROL_LAWS, find
from companion.preflight import run as preflight
from companion.preflight.hand_test.command import run_hand_test
from companion.preflight.hand_test.record import record_path
from companion.preflight.observe import Progress
from companion.preflight.px4 import PARAM_ID
from companion.recorder.client import RecorderProcess
from companion.runtime.clock import flight_clock
from companion.runtime.compiled import COMPILED
from companion.runtime.console import console_on, print_error
from companion.runtime.event_loop import run_until_interrupted
from companion.runtime.subprocesses import LaunchError
from companion.sitl_config.loader import SitlConfig

GROUPS = {
    "px4": "PX4",
    "mocap": "Motion capture",
    "frames": "Axes and frames",
    "hand": "Hand test",
    "arm": "Arm",
    "force": "Force sensor",
    "tether": "Tether",
    "mission": "Mission",
    "machine": "Computer",
}
"""Table headings, keyed by the first part of a row's id."""
_MARK_WIDTH, _TITLE_WIDTH, _WIDTH_MAX, _GAP = 4, 34, 160, 2
_STYLES = {"ok": "green", "WARN": "yellow", "FAIL": "bold red"}


def run(arguments: argparse.Namespace, config: SitlConfig, world: SitlProcess | None = None) -> int:
    """Run the command and return the exit code.

    Args:
        world: with `--sitl`, a world that runs already; None to start one.
    """
    found = check_mission(config.mission, config.vehicle, phase_origins=config.sources.phases)
    if arguments.plan_only:
        return _plan_only(arguments, config, found)
    people = console_on(sys.stderr)
    scratch = Path(tempfile.mkdtemp(prefix="companion-check-"))
    try:
        rows = _rows(arguments, config, tuple(found), scratch, people, world)
    except LaunchError as error:  # it names a log, which is kept
        print_error(f"companion check: {error}")
        return EXIT_REFUSED
    except BaseException:
        shutil.rmtree(scratch, ignore_errors=True)
        raise
    shutil.rmtree(scratch, ignore_errors=True)
    if arguments.json:
        print(json.dumps(preflight.as_json(rows)))
    else:
        show(wide_console(), rows, config, simulated=arguments.sitl is not None)
    return EXIT_REFUSED if refusals(rows) else EXIT_OK


def _plan_only(arguments: argparse.Namespace, config: FlightConfig, found: list[str]) -> int:
    if found:
        raise ConfigError(found)
    print(f"{arguments.mission}: mission {config.mission.name!r} can be flown by {config.vehicle.name}")
    for line in _poses(config.vehicle):
        print(f"  {line}")
    if left_out := figures_left_out(config.vehicle):
        print(f"  left out of the vehicle file, so that the values of the Tarot 650 are used: {'; '.join(left_out)}")
    if scaled := scale_text(config.controller):
        print(f"  {scaled}")
    return EXIT_OK


def _poses(vehicle: Vehicle) -> Iterator[str]:
    """Return a line for each pose of the arm with the position of its tip, so that an axis or an angle in a wrong unit is noticed."""
    if not vehicle.arm.joints:
        return
    arm = manipulator_of(vehicle)
    tip = vehicle.tip_name
    for name, angles_deg in vehicle.poses_deg.items():
        # Adding 0 turns -0.0 into 0.0.
        x_m, y_m, z_m = (round(m, 2) + 0.0 for m in arm.net_body_m(tuple(map(math.radians, angles_deg))))
        angles = ", ".join(f"{angle:g}" for angle in angles_deg)
        at = f"{x_m:+.2f} m forward, {y_m:+.2f} m left and {z_m:+.2f} m up from the body origin"
        yield f"pose {name}, {angles} deg: the {tip} is {at}"


def _rows(
    arguments: argparse.Namespace,
    sitl_config: SitlConfig,
    plan: tuple[str, ...],
    scratch: Path,
    people: Console,
    world: SitlProcess | None,
) -> list[Row]:
    """Return the rows of all checks; raises LaunchError if the simulated world cannot be started."""
    config = sitl_config.flight
    with contextlib.ExitStack() as stack:
        status = stack.enter_context(people.status("companion check"))

        def line(text: str, _share: float = 0.0) -> None:
            status.update(f"companion check: {escape(text)}")

        def on_world(message: WorldMessage) -> None:
            if isinstance(message, WorldProgress):
                if not people.is_terminal:
                    print_error(f"companion check: {message.text}")
                line(message.text)

        if arguments.sitl is not None:
            line("starting the simulated world")
            if world is None:
                world = SitlProcess.start(sitl_config, scratch, px4=arguments.sitl == "px4")
                stack.callback(world.stop)
            config = replace_device_settings(config, world.devices(on_world))
        line("recorder")
        known = Observations(
            start_s=0.0,
            duration_s=0.0,
            plan=plan,
            left_out=tuple(figures_left_out(sitl_config.vehicle)),
            mission_s=None if plan else Plan.build(config.mission, config.vehicle).duration_s,
            recorder=_recorder(config, scratch),
        )
        return run_until_interrupted(_look(arguments, config, known, line, status))


async def _look(
    arguments: argparse.Namespace, config: FlightConfig, known: Observations, line: Progress, status: Status
) -> list[Row]:
    clock, sitl = flight_clock(), arguments.sitl is not None
    async with open_available(config, clock, lambda device: line(f"opening: {device}", 0.0)) as devices:
        rows, _ = await preflight.preflight(
            devices, config, clock, out=Path("flights"), progress=line, known=known, sitl=sitl
        )
        if arguments.hand:
            status.stop()
            record = None if sitl else record_path()
            rows += await run_hand_test(devices, config, status.console, arguments.json, record=record)
        return rows


def _recorder(config: FlightConfig, scratch: Path) -> str:
    """Return why the recorder process could not open a log; empty if it could."""
    try:
        recorder = RecorderProcess.start(
            scratch / "check.mcap", config_json=config.model_dump_json(), epoch_offset_ns=time.time_ns()
        )
    except DeviceError as error:
        return str(error)
    return recorder.finish().error or ""


def show(console: Console, rows: list[Row], config: SitlConfig, *, simulated: bool) -> None:
    """Print one table per device with a remedy below each failed row, then the verdict."""
    where = " (SITL)" if simulated else ""
    build = ", compiled build" if COMPILED else ""
    law = find(CONTROL_LAWS, config.controller.law)
    title = f"{config.vehicle.name}{where}, mission '{config.mission.name}', {law}{build}"
    console.print(Text(title, style="bold"))
    for prefix, heading in GROUPS.items():
        group = [row for row in rows if row.id.partition(".")[0] == prefix]
        if not group:
            continue
        console.print()
        console.print(_line(console, "", heading, "read", "wanted", header=True))
        params = [row for row in group if row.id.startswith(PARAM_ID)]
        fine = [row for row in params if row.ok]
        for row in group:
            if row in fine:
                continue
            mark = "ok" if row.ok else "WARN" if row.level is Level.WARN else "FAIL"
            console.print(_line(console, mark, row.title, row.read, row.wanted))
            if not row.ok:
                console.print(_under(row))
        if fine:
            all_of_them = "all" if fine == params else "the other"
            console.print(_line(console, "ok", "parameters", f"{all_of_them} {len(fine)} are correct", "docs/px4.md"))
    refused = refusals(rows)
    warned = [row for row in rows if not row.ok and row.level is Level.WARN]
    console.print()
    verdict = Text()
    if refused:
        verdict.append(f"{len(refused)} of {len(rows)} checks failed: the vehicle may not fly.", style="bold red")
    else:
        verdict.append(f"{len(rows)} checks: the vehicle may fly.", style="bold green")
    if warned:
        verdict.append(f" {len(warned)} warnings.", style="yellow")
    console.print(verdict, soft_wrap=True)


def _line(console: Console, mark: str, title: str, read: str, wanted: str, *, header: bool = False) -> Table:
    """Return one row of the table. If there is no expected value, the measured value also uses its column."""
    width = min(console.width, _WIDTH_MAX)
    title_width = min(_TITLE_WIDTH, width // 3)
    left = max(20, width - _MARK_WIDTH - title_width - 4 * _GAP)
    read_width = round(0.6 * left)
    table = Table.grid(padding=(0, _GAP, 0, 0))
    table.add_column(width=_MARK_WIDTH, no_wrap=True, style="bold" if header else _STYLES[mark])
    table.add_column(width=title_width, style="bold" if header else "")
    table.add_column(width=read_width if wanted else left, overflow="fold", style="bold" if header else "")
    cells = [Text(mark), Text(title), Text(read)]
    if wanted:
        table.add_column(width=left - read_width, overflow="fold", style="bold" if header else "dim")
        cells.append(Text(wanted))
    table.add_row(*cells)
    return table


def _under(row: Row) -> Padding:
    """Return the remedy for a row that does not pass, and the reason for the check."""
    table = Table.grid(padding=(0, 1, 0, 0))
    if row.fix:
        table.add_row("->", Text(row.fix, style="bold"))
    table.add_row("", Text(row.why, style="dim"))
    return Padding(table, (0, 0, 0, _MARK_WIDTH + _GAP))
