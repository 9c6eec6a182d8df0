"""The tables of `companion compare`, on the terminal and as a page, and their columns."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.measure import Measurement

from companion.analysis.table import Cell, Column, Table, for_terminal, table
from companion.campaigns.compare.aggregate import MISSED, Group, Pairs, Spread, pairs_with_reference
from companion.campaigns.compare.grid import is_ablation, short_label
from companion.campaigns.runner import catches_text

_PARTS = {"pre": "before", "post": "after"}
_E_P, _E_Q, _E_ALPHA = ("e_p_m", "‖e_p‖", "m", 4), ("e_q_deg", "‖e_q‖", "deg", 2), ("e_alpha_deg", "‖e_α‖", "deg", 2)
_COMPLIANCE = (
    ("rms.post.e_alpha_deg", *_E_ALPHA[1:]),
    ("impedance_error.arm_nm", "arm\nimpedance", "N m", 3),
    ("impedance_error.position_n", "base\nimpedance", "N", 2),
    ("peak_e_p_m", "peak ‖e_p‖", "m", 3),
    ("final_abs_e_z_m", "final |e_z|", "m", 4),
    ("torque_activity_nm", "torque\nactivity", "N m", 4),
)
"""Metrics of compliance, shown in addition to the errors because a stiff or chattering arm can have small errors."""


def by_payload(groups: Sequence[Group]) -> list[Group]:
    """Sort the groups by payload and model error."""
    return sorted(groups, key=lambda group: (group.payload_kg, group.model_error))


def print_tables(groups: Sequence[Group], console: Console) -> None:
    """Print both tables, without the 95th percentiles if the terminal is too narrow. No number is ever cut off."""
    groups, width = by_payload(groups), console.width
    unlimited = console.options.update(max_width=10_000)
    for make in (tracking_table, compliance_table):
        shown = for_terminal(make(groups))
        if Measurement.get(console, unlimited, shown).maximum > width:
            shown = for_terminal(make(groups, p95=False))
        console.width = max(width, Measurement.get(console, unlimited, shown).maximum)
        console.print(shown, highlight=False)
        console.width = width


def tracking_table(groups: Sequence[Group], *, p95: bool = True) -> Table:
    """Return the paper's table, with each result beside the printed one."""
    columns = []
    for part, word in _PARTS.items():
        for key, title, unit, digits in (_E_P, _E_Q):
            name = f"rms.{part}.{key}"
            # A failure is shown instead of the metrics that it prevents.
            ours = _ours(name, f"{word}\n{title}", unit, digits, p95, failures=(part, key) == ("post", "e_p_m"))
            columns += [ours, _paper(part, key, digits)]
    pairs = pairs_with_reference(groups)
    if any(of.difference_95 for of in pairs.values()):
        columns.append(
            Column(
                "difference\nafter [mm]", lambda group: difference_text(pairs[id(group)]) if id(group) in pairs else ""
            )
        )
    return _table("Tracking before and after the catch", columns, groups)


def compliance_table(groups: Sequence[Group], *, p95: bool = True) -> Table:
    """Return the table of compliance after the catch, which the tracking errors do not show."""
    columns = [_ours(*of, p95, failures=position == 0) for position, of in enumerate(_COMPLIANCE)]
    columns.append(Column("catches false,\nundetected", lambda group: catches_text(group.rows)))
    columns.append(Column("cost\n[m]", lambda group: f"{group.cost:.3f}"))
    return _table("After the catch", columns, groups)


def _table(title: str, columns: Sequence[Column], groups: Sequence[Group]) -> Table:
    head = [
        Column("payload", lambda group: f"{group.payload_kg:g} kg", left=True),
        Column(
            "controller",
            lambda group: Cell(
                short_label(group.controller, group.preset), "soft" if is_ablation(group.preset) else ""
            ),
            left=True,
        ),
    ]
    if any(group.model_error for group in groups):
        head.insert(1, Column("model\nerror", lambda group: f"{group.model_error:.0%}"))
    return table([*head, *columns], groups, title=title, group=lambda group: (group.payload_kg, group.model_error))


def _ours(name: str, title: str, unit: str, digits: int, p95: bool, *, failures: bool) -> Column:
    def show(group: Group) -> Cell:
        text = spread_text(group.spread(name), digits, p95=p95) or ("" if group.failures else "–")
        note_kind = "warning" if set(group.failures) == {MISSED} else "bad"
        return Cell(text, note=group.failure_text if failures else "", note_kind=note_kind)

    return Column(f"{title}\n[{unit}]", show)


def spread_text(spread: Spread | None, digits: int, *, p95: bool = True) -> str:
    """Return `p50 (p95)`, with – for a failed flight; only p50 if there is a single flight; empty for None."""
    if spread is None:
        return ""
    shown = ["–" if value is None else f"{value:.{digits}f}" for value in (spread.p50, spread.p95)]
    return f"{shown[0]} ({shown[1]})" if p95 and spread.flights > 1 else shown[0]


def difference_text(pairs: Pairs) -> str:
    """Return the median difference and its 95 % interval in mm; empty without an interval."""
    found = pairs.difference_95
    return "" if found is None else "{:+.1f} ({:+.1f} to {:+.1f})".format(*(1000.0 * value for value in found))


def _paper(part: str, key: str, digits: int) -> Column:
    def show(group: Group) -> str:
        if group.printed is None:
            return ""
        figures = group.printed.pre if part == "pre" else group.printed.post
        return "crashed" if figures is None else f"{getattr(figures, key):.{digits}f}"

    return Column("paper", show, kind="paper")
