"""`companion robustness` as a campaign: one mission in many worlds, drawn at random or read from a file of cases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from companion.analysis.page import Page, Picture, Section
from companion.analysis.table import Cell, Column, Table, for_terminal, number, table
from companion.campaigns.process import Message
from companion.campaigns.robustness.cases import Case, Cases, as_cases, case_name, fly_command, worse_than, write_cases
from companion.campaigns.robustness.draws import DRAWN, DRIVERS, SAFE, drivers, influence, thirds, why_of, worst
from companion.campaigns.runner import Campaign, Row, catches, counted, outcomes, print_lines
from companion.model.types import Outcome


@dataclass(kw_only=True)
class Drawn(Campaign):
    """A campaign of flights with names, in worlds that a seed draws."""

    name = "robustness"
    csv_name = "draws.csv"

    seed: int

    def label(self, row: Row) -> str:
        """Return the label that distinguishes a flight from the others."""
        return str(row["name"])

    def good(self, rows: Sequence[Row]) -> bool:
        """Return whether every flight ended safely."""
        return all(row["outcome"] in SAFE for row in rows)


@dataclass(kw_only=True)
class Robustness(Drawn):
    """A campaign in randomly drawn worlds, or in the cases of a file."""

    mission: str
    """Mission file as named by the user."""
    cases: Sequence[Case] = ()
    """The cases to fly; empty to fly draws."""
    cases_file: str | None = None
    keep: str | None = None
    """File to which the worst flights, or the flown cases, are written."""
    vehicle: str | None = None
    """Vehicle file; None for the mission's."""
    controller: str | None = None
    """Control law, or controller file, as named by the user; None for the mission's."""

    @property
    def law(self) -> tuple[str, str]:
        """Control law, or controller file, and preset."""
        controller = self.configs[0].controller
        return self.controller or controller.law, controller.preset

    def job(self) -> Message:
        """Return the job for `sitl.campaigns`."""
        fixed = [key for override in self.overrides if (key := world_key(override))]
        return {**super().job(), "seed": self.seed, "fixed": fixed}

    def settings(self) -> dict[str, Any]:
        """Return the settings of the campaign for the results file."""
        law, preset = self.law
        own = {"mission": self.mission, "controller": law, "preset": preset}
        return {**super().settings(), **own, "seed": None if self.cases else self.seed, "cases": self.cases_file}

    def summary(self, rows: Sequence[Row]) -> dict[str, Any]:
        """Return outcomes, catches, the distribution of the error and its correlations."""
        false, undetected = catches(rows)
        return {
            "summary": {
                "flights": len(rows),
                "outcomes": outcomes(rows),
                "caught": sum(bool(row["caught"]) for row in rows),
                "missed": _missed(rows),
                "false_catches": false,
                "undetected_catches": undetected,
                "not_thrown": sum(not row["thrown"] for row in rows),
                "thirds": [{**asdict(third), "payload_kg": list(third.payload_kg)} for third in thirds(rows)],
                "influence": influence(rows),
            }
        }

    def csv_row(self, row: Row) -> Mapping[str, Any]:
        """Return the results and the drawn values."""
        results = {key: value for key, value in row.items() if key not in ("world", "events")}
        return {**results, "events": " ".join(row["events"]), **drivers(row["world"])}

    def page(self, rows: Sequence[Row], pictures: Sequence[Picture]) -> Page:
        """Return the page: the distribution, its plot and the worst flights."""
        law, preset = self.law
        unsafe = sum(row["outcome"] not in SAFE for row in rows)
        return Page(
            "Robustness",
            f"{self.mission} · {law}/{preset} · {len(rows)} draws of world {self.world} in the fast loop",
            [
                Section("Distribution of the error", self._dependence(rows), [thirds_table(rows)], pictures),
                Section("Flights", tables=[self._flights_table(rows)]),
            ],
            verdict=f"{self._result(rows)}. {f'{unsafe} flights crashed or were lost.' if unsafe else 'Every flight ended safely.'}",
            good=not unsafe,
        )

    def draw(self, rows: Sequence[Row], out: Path) -> list[Picture]:
        """Write the plot of the distribution."""
        from companion.campaigns.robustness.plots import write_distribution

        path, (law, preset) = out / "distribution.png", self.law
        title = f"{self.configs[0].mission.name}, {law}/{preset}: {len(rows)} worlds"
        caption = "RMS of ‖e_p‖ after the catch, over completed flights that caught the payload."
        return [Picture(path, title, caption)] if write_distribution(rows, title, path) else []

    def write_extra_files(self, rows: Sequence[Row], out: Path) -> None:
        """Write the worst flights to `worst.yaml`, and the flights to keep to the file of `--keep`, as cases."""
        self._write_cases(worst(rows), out / "worst.yaml")
        # Only the file of `--cases` can exist already: cases that were not flown must not leave it.
        if self.keep is not None and (len(rows) == len(self.flights) or not Path(self.keep).exists()):
            self._write_cases(rows if self.cases else worst(rows), Path(self.keep))

    def show(self, rows: Sequence[Row], console: Console) -> None:
        """Print the distribution, the worst flights and the command that flies the worst one with `companion fly --sitl`."""
        law, preset = self.law
        console.print(f"{law}/{preset}, {self._result(rows)}", highlight=False)
        console.print(for_terminal(thirds_table(rows)), highlight=False)
        console.print(f"{self._dependence(rows)}\n", highlight=False)
        console.print(for_terminal(self._flights_table(rows)), highlight=False)
        for row in rows:
            if row["outcome"] != Outcome.COMPLETED.value:
                text = f"{row['name']}: {row['outcome']}: {why_of(row)}"
                console.print(text, style="yellow" if row["outcome"] in SAFE else "red", highlight=False, markup=False)
        hardest = worst(rows)[0]["world"]
        keys = hardest if self.cases else {key: hardest[key] for key in DRAWN}
        world = self.configs[0].laboratory.name
        line = fly_command(self.mission, law, preset, world, keys, self.overrides, self.vehicle)
        print_lines(console, f"to fly the worst world with companion fly:\n{line}")

    def _result(self, rows: Sequence[Row]) -> str:
        caught = sum(bool(row["caught"]) for row in rows)
        false, undetected = catches(rows)
        detected = f"{false} false catches, {undetected} undetected"
        return f"{len(rows)} worlds: {counted(rows)}; {caught} caught, {_missed(rows)} missed the net; {detected}"

    def _dependence(self, rows: Sequence[Row]) -> str:
        strongest = list(influence(rows).items())[:5]
        text = ", ".join(f"{DRIVERS[key]} {value:+.2f}" for key, value in strongest)
        return f"Rank correlation with e_p: {text or 'too few flights'}."

    def _flights_table(self, rows: Sequence[Row]) -> Table:
        if self.cases:
            return flights_table(rows, self.cases)
        return flights_table([{**row, "name": case_name(row)} for row in worst(rows)])

    def _write_cases(self, rows: Sequence[Row], path: Path) -> None:
        law, preset = self.law
        remark = (
            "The worst worlds for this law in the fast loop, with the results.\n"
            f"To fly them again: companion robustness --cases {path.name} (--case NAME for one; --keep FILE to keep the new results)."
        )
        if not self.cases:
            first, last = self.flights[0]["number"], self.flights[-1]["number"]
            remark += f"\nThese are the worst of draws {first} to {last}, seed {self.seed}."
        cases = Cases(
            mission=self.mission,
            controller=law,
            preset=preset,
            vehicle=self.vehicle,
            overrides=tuple(override for override in self.overrides if not world_key(override)),
            cases=as_cases(rows),
        )
        write_cases(cases, path, remark)


def world_key(override: str) -> str:
    """Return the world's key that an override sets, such as `wind_m_s` for `world.wind_m_s[0]=1`; empty for any other section."""
    section, _, key = override.partition("=")[0].strip().partition(".")
    return key.partition("[")[0].partition(".")[0] if section == "world" else ""


def _missed(rows: Sequence[Row]) -> int:
    return sum(bool(row["thrown"]) and not row["caught"] for row in rows)


def thirds_table(rows: Sequence[Row]) -> Table:
    """Return the distribution of e_p by payload."""

    def percentile(key: str) -> Column:
        return Column(key, lambda third: number(third.e_p_m[key], ".4f", "–"))

    columns = (
        Column("payload", lambda third: "{:.2f} to {:.2f} kg".format(*third.payload_kg), left=True),
        Column("flights", lambda third: str(third.flights)),
        Column("caught", lambda third: str(third.caught)),
        Column("catches false,\nundetected", lambda third: "{}, {}".format(*third.catches)),
        *map(percentile, ("p50", "p95", "max")),
    )
    return table(columns, thirds(rows), title="RMS of e_p after the catch, m")


def flights_table(rows: Sequence[Row], cases: Sequence[Case] = ()) -> Table:
    """Return a table with one line per flight: its result and the drawn values.

    Args:
        cases: the cases that were flown, with the same names as their rows; empty for draws.
    """

    def drawn(key: str, form: str, scale: float = 1.0) -> Any:
        def show(row: Row) -> str:
            value = drivers(row["world"])[key]
            return number(None if value is None else value * scale, form, "–")

        return show

    speed, from_deg = drawn("throw_speed_m_s", ".1f"), drawn("throw_from_deg", ".0f")
    columns = [
        Column("draw", lambda row: "" if row["number"] is None else str(row["number"])),
        Column("name", lambda row: str(row["name"]), left=True),
        Column("e_p\nm", _error_text),
        Column("payload\nkg", drawn("payload_kg", ".2f")),
        Column("throw\nm/s", lambda row: f"{speed(row)} @ {from_deg(row)}°"),
        Column("catch x\nm", drawn("catch_x_m", ".2f")),
        Column("delay\nms", drawn("setpoint_delay_s", ".0f", 1e3)),
        Column("lag\nms", drawn("rotor_lag_s", ".0f", 1e3)),
        Column("wind\nm/s", drawn("wind_speed_m_s", ".1f")),
        Column("hover", drawn("hover_thrust_error", "+.0%")),
        Column("force sensor", _sensor_text, left=True),
        Column("seed", lambda row: str(row["world_seed"])),
    ]
    # A world leaves out what it does not draw.
    columns = [column for column in columns if any(column.show(row) != "–" for row in rows)]
    kept = {case.name: case.kept for case in cases}
    if kept:

        def against_kept(row: Row) -> Cell:
            worse = worse_than(row, kept[row["name"]])
            return Cell(worse, "bad") if worse else Cell(number(kept[row["name"]].e_p_m, ".4f", "–"))

        columns.append(Column("kept\nm", against_kept))
    return table(columns, rows, title="The cases" if kept else "The worst")


def _error_text(row: Row) -> str:
    known = row["outcome"] == Outcome.COMPLETED.value and row["e_p_m"] is not None
    error = f"{row['e_p_m']:.4f}" if known else row["outcome"]
    return error if row["caught"] else f"{error} (missed)"


def _sensor_text(row: Row) -> str:
    drawn = drivers(row["world"])
    lost_s, bias_n = drawn["force_lost_s"], drawn["force_bias_n"]
    if lost_s is not None:
        return f"lost {lost_s:g} s" if lost_s > 0 else "missing"
    return "–" if bias_n is None else f"{bias_n:.0f} N bias"
