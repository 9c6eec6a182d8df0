"""`companion team fly --sitl`: the flights of two vehicles that carry a bar in one simulated world."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from rich.console import Console

from companion.analysis.log import FlightLog
from companion.analysis.pair import BarTruth, figure_texts, figures_of
from companion.analysis.summary import write_summary
from companion.launcher.launcher import FlightResult, Launcher, Sitl
from companion.launcher.reports import LAND_SIGNALS
from companion.launcher.run import report_of, summary_of
from companion.launcher.sitl_process import SitlProcess
from companion.model.codec import RecordError, from_jsonable
from companion.model.exit_codes import EXIT_CODES
from companion.model.types import Outcome
from companion.phases.carry.bar import End
from companion.runtime.console import FlightDisplay, prefixed_console, print_error, print_team_result
from companion.runtime.subprocesses import LaunchError, signals_call
from companion.sitl_config.loader import SitlConfig
from companion.sitl_config.team import TeamConfig

KEY_FILE = "team.key"
"""File with the key of the link, in the team's folder."""
BAR_FILE = "bar.json"
"""File with the true course of the bar, which the world writes into the left member's folder."""
_KEY_BYTES = 32
_WORSE = (Outcome.COMPLETED, Outcome.ABORTED, Outcome.REFUSED, Outcome.CRASHED, Outcome.LOST)


def linked(team: TeamConfig, out: Path) -> dict[End, SitlConfig]:
    """Write a key for the link between the vehicles, and return the configurations of both, the left one first, with that key and
    free ports.

    Raises:
        OSError: the key cannot be written.
    """
    key = (out / KEY_FILE).resolve()
    with open(os.open(key, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
        file.write(os.urandom(_KEY_BYTES))
    ports = _free_ports(2)
    found: dict[End, SitlConfig] = {}
    for (end, config), port, partner in zip(team.members, ports, ports[::-1], strict=True):
        devices = config.vehicle.devices
        assert devices.team is not None
        own = {"key_file": str(key), "port": port, "partner": "127.0.0.1", "partner_port": partner}
        link = devices.team.model_copy(update=own)
        vehicle = config.vehicle.model_copy(update={"devices": devices.model_copy(update={"team": link})})
        found[end] = config.model_copy(update={"vehicle": vehicle})
    return found


def _free_ports(count: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        found = []
        for _ in range(count):
            opened = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            opened.bind(("127.0.0.1", 0))
            found.append(int(opened.getsockname()[1]))
        return found


class TeamLauncher:
    """Runs the flights of both members in one world, each with a launcher of its own.

    Args:
        worlds: the world, as each member sees it.
    """

    def __init__(self, worlds: Sequence[SitlProcess], launchers: Sequence[Launcher]) -> None:
        self._launchers = launchers
        self._over = threading.Barrier(len(launchers))
        for number, world in enumerate(worlds):
            world.before_stop = self._waiting_for(launchers[1 - number])

    def request_landing(self) -> None:
        """Request a landing of both (Ctrl-C)."""
        for launcher in self._launchers:
            launcher.request_landing()

    def run(self) -> list[FlightResult]:
        """Run both flights."""
        with ThreadPoolExecutor(len(self._launchers)) as threads:
            return list(threads.map(self._run, self._launchers))

    def _run(self, launcher: Launcher) -> FlightResult:
        try:
            return launcher.run()
        except LaunchError as error:
            return FlightResult(Outcome.REFUSED, lines=(str(error),))
        finally:
            self._over.abort()  # after an error before `stop`; otherwise nobody waits any more

    def _waiting_for(self, other: Launcher) -> Callable[[], None]:
        """Return what a member does at the end of its flight: it waits for the other, which does not take off any more."""

        def wait() -> None:
            if not other.begun:
                other.request_landing()
            with contextlib.suppress(threading.BrokenBarrierError):
                self._over.wait()

        return wait


def run_team(
    team: TeamConfig,
    out: Path,
    *,
    console: Console,
    report: bool = True,
    speed: float | None = None,
    px4: bool = False,
) -> int:
    """Fly a team in the simulated world, write the summaries and, if requested, the reports; return the exit code.

    Args:
        out: existing folder of the flight; each member has a folder in it.
        speed: simulated seconds in a second of real time at most; None for a flight in real time.
        px4: whether two real PX4 fly in place of two stubs.
    """
    try:
        members = linked(team, out)
        folders = {end: out / end for end in members}
        for folder in folders.values():
            folder.mkdir(exist_ok=True)
        worlds = SitlProcess.start_all([(config, folders[end]) for end, config in members.items()], speed, px4=px4)
    except (OSError, LaunchError) as error:
        print_error(f"companion team fly: {error}")
        return EXIT_CODES[Outcome.REFUSED]
    console.print(f"[bold]{team.name}[/]: two vehicles carry a bar in SITL  (Ctrl-C lands both)", highlight=False)
    launchers = []
    for (end, config), world in zip(members.items(), worlds, strict=True):
        display = FlightDisplay(prefixed_console(f"{end:<6}"), "")
        shown, folder = display.on_message, folders[end]
        sitl: Sitl = "px4" if px4 else "stub"
        launchers.append(Launcher(config, folder, sitl=sitl, on_message=shown, speed=speed, world=world))
    launcher = TeamLauncher(worlds, launchers)
    with signals_call(LAND_SIGNALS, launcher.request_landing):
        results = dict(zip(members, launcher.run(), strict=True))
        for end, result in results.items():
            for line in result.lines:
                print_error(f"{end}: {line}")
        outcome = max((result.outcome for result in results.values()), key=_WORSE.index)
        try:
            found, logs, truth = _summaries(members, results, folders, speed)
            summary = {"name": team.name, "outcome": outcome.value, **found}
            write_summary(summary, out / "summary.json")
        except OSError as error:
            print_error(f"{out}: summary.json cannot be written: {error.strerror}")
            return EXIT_CODES[outcome]
    path = _write_reports(console, logs, truth, summary, out) if report else None
    print_team_result(console, summary, figure_texts(summary["team"]), path or out)
    return EXIT_CODES[outcome]


def _summaries(
    members: Mapping[End, SitlConfig],
    results: Mapping[End, FlightResult],
    folders: Mapping[End, Path],
    speed: float | None,
) -> tuple[dict[str, Any], dict[End, FlightLog | None], BarTruth | None]:
    """Write summary.json of each member; return the summary of both, the logs and the true course of the bar."""
    logs, summaries = {}, {}
    for end, config in members.items():
        logs[end], summaries[end] = summary_of(config, results[end], folders[end], speed)
    truth = None
    with contextlib.suppress(OSError, ValueError, RecordError):  # a world that was killed has written none
        truth = from_jsonable(BarTruth, json.loads((folders["left"] / BAR_FILE).read_text(encoding="utf-8")))
    return {"team": figures_of(truth, logs["left"], logs["right"]), "members": summaries}, logs, truth


def _write_reports(
    console: Console,
    logs: Mapping[End, FlightLog | None],
    truth: BarTruth | None,
    summary: Mapping[str, Any],
    out: Path,
) -> Path | None:
    """Write the report of each member and that of both; return the path of the latter, None if there is none."""
    try:
        with console.status("writing the reports"):
            for end, log in logs.items():
                if log is not None:
                    report_of(log, summary["members"][end], out / end)
            left, right = logs["left"], logs["right"]
            if left is not None and right is not None and truth is not None:
                with contextlib.suppress(ImportError):  # a flight does not need matplotlib
                    from companion.analysis.pair_report import write_pair_report

                    return write_pair_report(summary, truth, left, right, out)
    except KeyboardInterrupt:
        print_error("reports cancelled; write them with: companion report FLIGHT.mcap")
    except OSError as error:
        print_error(f"the reports cannot be written: {error.strerror}")
    return None
