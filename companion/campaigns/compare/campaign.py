"""`companion compare` as a campaign: its flights, settings and page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from companion.analysis.page import Page, Picture, Section
from companion.campaigns.compare.aggregate import aggregate
from companion.campaigns.compare.grid import Variant
from companion.campaigns.compare.paper_results import SOURCE
from companion.campaigns.compare.tables import by_payload, compliance_table, print_tables, tracking_table
from companion.campaigns.runner import Campaign, Row
from companion.plugins import CONTROL_LAWS, find

STATISTIC = "RMS, p50 (p95) over seeds; a failed flight counts as worse than all others and is shown as –"
EXPLAINED = (
    f"{STATISTIC}. e_p and e_q are measured by motion capture, e_q against the attitude setpoint of the "
    "control law. Difference: ‖e_p‖ after the catch minus that of adaptive/recommended (or of the first variant) in the same "
    "laboratory, median over the laboratories and its 95 % confidence interval. Impedance: RMS after the catch of M_d e'' + K_d e' + "
    "K_p e - e_tau, the deviation from one target (the paper's table) for every law. Torque activity: RMS change of the "
    "commanded joint torques from one tick to the next. Cost: that of companion tune, over all flights, failed ones included."
)


@dataclass(kw_only=True)
class Compare(Campaign):
    """A grid of controllers, presets, payloads, model errors and seeds."""

    name = "compare"
    csv_name = "compare.csv"

    variants: Sequence[Variant]
    payloads_kg: Sequence[float]
    seeds: Sequence[int]
    model_errors: Sequence[float] = (0.0,)

    def settings(self) -> dict[str, Any]:
        """Return the settings of the campaign for the results file."""
        return {
            **super().settings(),
            "payloads_kg": list(self.payloads_kg),
            "seeds": list(self.seeds),
            "model_errors": list(self.model_errors),
            "variants": [
                {
                    "controller": variant.controller,
                    "preset": variant.preset,
                    "plugin": str(find(CONTROL_LAWS, config.controller.law)),
                    "file": config.sources.controller,
                    "overrides": list(variant.overrides),
                }
                for variant, config in zip(self.variants, self.configs, strict=True)
            ],
            "jobs": self.jobs,
            "scheduler": self.scheduler,
        }

    def label(self, row: Row) -> str:
        """Return the label that distinguishes a flight from the others."""
        error = f" model error {row['model_error']:g}" if row["model_error"] else ""
        return f"{row['controller']}/{row['preset']} {row['payload_kg']:g} kg{error} seed {row['seed']}"

    def summary(self, rows: Sequence[Row]) -> dict[str, Any]:
        """Return the percentiles over seeds."""
        return {"aggregate": [group.jsonable() for group in aggregate(rows)]}

    def page(self, rows: Sequence[Row], pictures: Sequence[Picture]) -> Page:
        """Return the page with both tables and the pictures."""
        groups = by_payload(aggregate(rows))
        lead = f"{STATISTIC}. Grey: as printed in the paper ({SOURCE})."
        sections = [
            Section("Tracking before and after the catch", lead, [tracking_table(groups)]),
            Section("After the catch", tables=[compliance_table(groups)], text=EXPLAINED),
            *([Section("Pictures", pictures=pictures)] if pictures else []),
        ]
        seeds = f"seed {self.seeds[0]}" if len(self.seeds) == 1 else f"seeds {self.seeds[0]} to {self.seeds[-1]}"
        mission = self.configs[0].sources.mission
        return Page(
            "Comparison of controllers",
            f"{mission} · {len(rows)} flights in the fast loop · world {self.world} · {seeds}",
            sections,
        )

    def draw(self, rows: Sequence[Row], out: Path) -> list[Picture]:
        """Plot the distributions."""
        from companion.campaigns.compare.plots import write_pictures

        return write_pictures(aggregate(rows), out)

    def show(self, rows: Sequence[Row], console: Console) -> None:
        """Print both tables."""
        print_tables(aggregate(rows), console)
        console.print(f"{EXPLAINED} Paper: {SOURCE}.", style="dim", highlight=False, markup=False)
        for row in rows:
            if row["error"]:
                console.print(f"{self.label(row)}: {row['error']}", style="red", highlight=False, markup=False)
