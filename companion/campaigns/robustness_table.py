"""Random draws as tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich import box
from rich.console import JustifyMethod
from rich.markup import escape
from rich.table import Table

from companion.campaigns import robustness
from companion.campaigns.robustness import Kept, Row


def thirds_table(rows: Sequence[Row]) -> Table:
    """The distribution of e_p by payload."""
    table = Table(
        box=box.SIMPLE, pad_edge=False, header_style="bold", title="RMS of e_p after the catch, m", title_justify="left"
    )
    for name in ("payload", "flights", "caught", "p50", "p90", "max"):
        table.add_column(name, justify="left" if name == "payload" else "right")
    for third in robustness.thirds(rows):
        figures = ["–" if value is None else f"{value:.4f}" for value in (third.p50_m, third.p90_m, third.max_m)]
        span = f"{third.low_kg:.2f} to {third.high_kg:.2f} kg"
        table.add_row(span, str(third.flights), str(third.caught), *figures)
    return table


def flights_table(flights: Sequence[tuple[str, Row]], kept: Mapping[str, Kept]) -> Table:
    """One line per flight: what came of it and what was drawn.

    Args:
        flights: each with its name.
        kept: what came of them when they were kept, by name; empty: nothing is known.
    """
    title = "The cases" if kept else "The worst"
    table = Table(box=box.SIMPLE, pad_edge=False, header_style="bold", title=title, title_justify="left")
    columns = ("draw", "name", "e_p", "payload", "throw", "catch x", "delay", "lag", "wind", "hover", "force", "seed")
    for name in columns:
        justify: JustifyMethod = "left" if name in ("name", "force") else "right"
        table.add_column(name, justify=justify, overflow="fold")
    if kept:
        table.add_column("kept")
    for name, row in flights:
        world, d = row["world"], robustness.drivers(row["world"])

        def text(key: str, form: str, scale: float = 1.0, of: dict[str, float | None] = d) -> str:
            value = of[key]
            return "–" if value is None else format(value * scale, form)

        error = f"{row['e_p_m']:.4f}" if row["outcome"] == "completed" and row["e_p_m"] is not None else row["outcome"]
        cells = [
            "" if row["number"] is None else str(row["number"]),
            escape(name),
            error if row["caught"] else f"{error} (missed)",
            text("payload_kg", ".2f"),
            f"{text('throw_speed_m_s', '.1f')} @ {text('throw_from_deg', '.0f')}°",
            text("catch_x_m", ".2f"),
            text("setpoint_delay_s", ".0f", 1e3),
            text("rotor_lag_s", ".0f", 1e3),
            text("wind_speed_m_s", ".1f"),
            text("hover_thrust_error", "+.0%"),
            _sensor_text(d),
            str(world.get("seed", "")),
        ]
        if kept:
            worse = robustness.held_against(row, kept[name])
            was = kept[name].e_p_m
            cells.append(f"[red]{escape(worse)}[/]" if worse else "–" if was is None else f"{was:.4f}")
        table.add_row(*cells)
    return table


def _sensor_text(d: Mapping[str, float | None]) -> str:
    """What was wrong with the force sensor."""
    lost_s, bias_n = d["force_lost_s"], d["force_bias_n"]
    if lost_s is not None:
        return f"lost {lost_s:g} s" if lost_s > 0 else "missing"
    return "–" if bias_n is None else f"{bias_n:.0f} N bias"
