"""Writes the results of a search: controller file, JSON, page and text."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from rich.console import Console

from companion.analysis.page import Page, Picture, Section, write_page
from companion.analysis.table import Column, Table, for_terminal, number, table
from companion.campaigns.cost import TERMS, cost_of, flight_cost, terms_of
from companion.campaigns.runner import catches_text, counted, no_plots, print_lines, to_json
from companion.campaigns.tune.result import Gain, HeldOut, Result, completed, flown
from companion.control.scaled_gains import controller_yaml as controller_file
from companion.runtime.console import print_error

CONTROLLER_FILE, RESULT_FILE, PAGE_FILE = "controller.yaml", "result.json", "page.html"
SENSITIVITY = (
    "Spread: factor by which the search still varied the gain when it ended; a wide one means that the cost hardly depends on the "
    "gain. Rank correlation: of the gain with the cost, over all candidates in the first laboratories."
)


def gains_table(gains: Sequence[Gain]) -> Table:
    """Return the found gains beside the start."""
    columns = (
        Column("gain", lambda gain: gain.name, left=True),
        Column("start", lambda gain: f"{gain.start:.4g}"),
        Column("found", lambda gain: f"{gain.found:.4g}"),
        Column("from", lambda gain: f"{gain.low:.3g}"),
        Column("to", lambda gain: f"{gain.high:.3g}"),
        Column("spread", lambda gain: number(gain.spread, ".2f", "–")),
        Column("rank\ncorrelation", lambda gain: number(gain.correlation, "+.2f", "–")),
        Column("", lambda gain: "near a bound" if gain.near_bound else "", left=True, kind="warning"),
    )
    return table(columns, gains, title="Gains (the first value of each list)")


def costs_table(judged: HeldOut) -> Table:
    """Return the cost in the held-out laboratories, and what each term contributes to it in completed flights."""
    sides = {"before": judged.before, "after": judged.after}

    def share(key: str) -> Any:
        def show(side: str) -> str:
            known = [found[key] for row in sides[side] if flown(row) and key in (found := terms_of(row))]
            return f"{fmean(known):.4f}" if known else "–"

        return show

    columns = (
        Column("", lambda side: side, left=True),
        Column("flights", lambda side: counted(sides[side]), left=True),
        Column("catches false,\nundetected", lambda side: catches_text(sides[side])),
        Column("cost", lambda side: f"{cost_of([*map(flight_cost, sides[side])]):.4f}"),
        Column("worst\nflight", lambda side: f"{max(map(flight_cost, sides[side])):.4f}"),
        *(Column(term.key.removeprefix("rms.").replace(".", "\n"), share(term.key)) for term in TERMS),
    )
    return table(columns, sides, title="Held-out laboratories: cost, and mean contribution of each term, m")


def write(result: Result, out: Path) -> Path | None:
    """Write the files of a result into a folder; return the controller file, or None if the result is no better than the start."""
    file = out / CONTROLLER_FILE if result.better else None
    (out / CONTROLLER_FILE).unlink(missing_ok=True)
    if file is not None:
        file.write_text(controller_yaml(result), encoding="utf-8")
    try:
        from companion.campaigns.tune.plots import write_pictures

        pictures = write_pictures(result, out)
    except ImportError:
        print_error(no_plots("tune"))
        pictures = []
    write_page(page(result, pictures), out / PAGE_FILE)
    data = result.data(file)
    evaluations = [
        {"generation": one.generation, "costs": one.costs, "gains": result.space.values(one.point)}
        for one in result.search.evaluations
    ]
    # This file is written last: if it exists, all the others exist.
    (out / RESULT_FILE).write_text(to_json({**data, "candidates": evaluations}), encoding="utf-8")
    return file


def show(result: Result, out: Path, console: Console | None, file: Path | None) -> None:
    """Print gains, costs, and the line that flies the gains.

    Args:
        out: folder of the result's files.
        console: where to print; None to print JSON instead.
        file: the controller file, or None.
    """
    if console is None:
        sys.stdout.write(to_json(result.data(file)))
        sys.stdout.flush()
        return
    for shown in (gains_table(result.gains), costs_table(result.judged)):
        console.print(for_terminal(shown), highlight=False)
    print_lines(console, result.verdict, *([] if file is None else [f"to fly it:  {result.fly_line(file)}"]))
    print_lines(console, f"report  {out / PAGE_FILE}")


def page(result: Result, pictures: Sequence[Picture]) -> Page:
    """Return the content of the page."""
    s = result.settings
    search = result.search
    lead = (
        f"{len(search.evaluations)} candidates in {result.training.text}; found gains and start whole missions in "
        f"{result.held_out.text}, which the search has not seen."
    )
    terms = "; ".join(f"{term.weight:g} {term.unit} × {term.text}".replace("  ", " ") for term in TERMS)
    record = {"Settings": to_json(s), "Command": result.command}
    return Page(
        "Gains found for a machine",
        f"{s['controller']}/{s['preset']} · {s['vehicle']} · {s['mission']} · world {s['world']} · seed {s['seed']}",
        [
            Section("In held-out laboratories", lead, [costs_table(result.judged)], text=f"Cost, m: {terms}."),
            Section("Gains", SENSITIVITY, [gains_table(result.gains)], pictures),
            Section("Record", folded=record),
        ],
        verdict=f"{result.verdict[0].upper()}{result.verdict[1:]}.",
        good=result.better,
    )


def controller_yaml(result: Result) -> str:
    """Return the found gains as a controller file with their provenance."""
    s, (before, after) = result.settings, result.judged.costs()
    settings = result.space.settings(result.search.best.point)
    version = s["versions"].get("git") or s["versions"]["companion"]
    remarks = [
        f"Found by `{result.command}`",
        f"at commit {version}, from {s['controller']}/{s['preset']} ({s['controller_file']}).",
        f"Vehicle {s['vehicle']}; mission {s['mission']}; world {s['world']}; seed {s['seed']}; "
        f"{len(result.search.evaluations)} candidates.",
        f"Cost in {result.training.text}: {result.search.start.cost:.4f} before, {result.search.best.cost:.4f} after.",
        f"Cost of whole missions in {result.held_out.text}, held out: {before:.4f} before, {after:.4f} after;",
        f"completed {completed(result.judged.before)} before, {completed(result.judged.after)} after.",
    ]
    return controller_file(settings, f"{settings.preset}_tuned", remarks)
