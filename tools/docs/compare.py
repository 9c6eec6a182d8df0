"""Writes the tables and plots of the comparison: `python -m tools.docs.compare docs/internals/compare.md compare.json [...]`."""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from companion.analysis.plot_style import write_svg
from companion.campaigns.compare.aggregate import (
    REFERENCE,
    Group,
    Pairs,
    adaptation_pairs,
    aggregate,
    pairs_with_reference,
)
from companion.campaigns.compare.grid import ABLATED, ADAPTATION_OFF, LESS, is_ablation
from companion.campaigns.compare.paper_results import Printed
from companion.campaigns.compare.plots import distributions
from companion.campaigns.compare.tables import by_payload, difference_text, spread_text
from companion.campaigns.runner import Row
from companion.config.controller import PRESETS, AdaptiveConfig, CscConfig, LawConfig, PscConfig
from companion.config.loader import load_flight
from tools.docs.tables import flown_by, markdown, write_page

MISSION = Path(__file__).parents[2] / "configs/missions/catch.yaml"
"""Mission with which a configuration is loaded; only the configuration's controller is used."""
Results = dict[str, Any]
"""Content of a compare.json."""
LAWS = ("adaptive", "csc", "psc")
"""The companion's own laws of the comparison; others are baselines."""
AS_PUBLISHED = ("paper", "paper_slow_leakage", "tuned")
"""Presets that contain only what the law's paper describes; all others have additional compensation."""
IN_PAPER = {"adaptive/paper": "proposed", "psc/tuned": "PSC", "csc/tuned": "CSC"}
"""Variants with figures in the paper, by the paper's name of the law."""
ABLATION_KG = 0.2
PICTURES = {
    "errors": ("extras", "Position error of every flight before and after the catch, by payload and law"),
    "model_error": ("model error", "Position error after the catch against model error, one panel per law"),
    "adaptation": ("adaptation", "Position error with the adaptation on against the same flight with it off"),
}
"""For each plot on the page, the table below which it is placed and its alternative text."""
_E_P = "rms.{}.e_p_m"
_FIGURES = (
    ("e_p before, m", _E_P.format("pre"), 3),
    ("e_p after, m", _E_P.format("post"), 3),
    ("peak e_p, m", "peak_e_p_m", 3),
    ("arm impedance, N m", "impedance_error.arm_nm", 2),
)
_ABLATION_FIGURES = (*_FIGURES[:3], ("e_alpha after, deg", "rms.post.e_alpha_deg", 1), _FIGURES[-1])


def merged(files: Sequence[Results]) -> list[Row]:
    """Return the rows of all files, each with the line `flown_by` that names its command and commit. A flight that is in several files
    is taken from the last one.

    Raises:
        ValueError: the flights of the files were flown in different worlds, or the files contain no flight.
    """
    worlds = sorted({results["settings"]["world"] for results in files})
    if len(worlds) > 1:
        raise ValueError(f"flown in different worlds: {', '.join(worlds)}; expected one world")
    keys = ("controller", "preset", "payload_kg", "model_error", "seed")
    rows = {
        tuple(row[key] for key in keys): {**row, "flown_by": flown_by(results)}
        for results in files
        for row in results["rows"]
    }
    if not rows:
        raise ValueError("found no rows; expected the rows of at least one flight")
    return list(rows.values())


def laws_markdown(groups: Sequence[Group], differences: Mapping[int, Pairs] | None = None) -> str:
    """Return one line per payload and preset, with the figures of the paper and `differences` where available."""
    head = ["payload", "law/preset", "with the payload", *(title for title, _, _ in _FIGURES), "e_q, deg"]
    rows = [
        [f"{group.payload_kg:g} kg", _label(group), _completed(group), *_spreads(group, _FIGURES), _attitude(group)]
        for group in groups
    ]
    if differences:
        head.insert(5, f"after, against {REFERENCE}, mm")
        for row, group in zip(rows, groups, strict=True):
            row.insert(5, difference_text(differences[id(group)]) if id(group) in differences else "")
    if any(map(_paper, groups)):
        head.append("printed e_p, m")
        rows = [[*row, _paper(group)] for row, group in zip(rows, groups, strict=True)]
    return markdown(head, rows)


def model_error_markdown(groups: Sequence[Group]) -> str:
    """Return one line per payload and preset, one column per model error."""
    errors = sorted({group.model_error for group in groups})
    lines: dict[tuple[float, str], dict[float, Group]] = {}
    for group in groups:
        lines.setdefault((group.payload_kg, group.label), {})[group.model_error] = group
    head = ("payload", "law/preset", *(f"{100 * error:g} %" for error in errors))
    rows = [
        (f"{payload_kg:g} kg", label, *(_error_cell(found.get(error)) for error in errors))
        for (payload_kg, label), found in lines.items()
    ]
    return markdown(head, rows)


def adaptation_markdown(groups: Sequence[Group]) -> str:
    """Return one line per preset, payload and model error that was flown with the adaptation on and off."""
    head = ("law/preset", "payload", "model error", "off, m", "on, m", "change", "better with it", "p (sign test)")
    rows = []
    for pairs in adaptation_pairs(groups):
        off, on = pairs.p50(0), pairs.p50(1)
        change = "–" if off is None or on is None else f"{100 * (on / off - 1):+.0f} %"
        shown = ("–" if value is None else f"{value:.3f}" for value in (off, on))
        rows.append((
            pairs.group.label, f"{pairs.group.payload_kg:g} kg", f"{100 * pairs.group.model_error:g} %", *shown, change,
            f"{pairs.better} of {len(pairs.base_m_this_m)}", f"{pairs.p_value:.1g}",
        ))  # fmt: skip
    return markdown(head, rows)


def ablation_markdown(groups: Sequence[Group], differences: Mapping[int, Pairs]) -> str:
    """Return one line per ablation with `ABLATION_KG`."""
    head = ["taken away", "with the payload", *(title for title, _, _ in _ABLATION_FIGURES)]
    head.insert(4, f"after, against {REFERENCE}, mm")
    rows = [
        [group.preset.partition(LESS)[2], _completed(group), *_spreads(group, _ABLATION_FIGURES)] for group in groups
    ]
    for row, group in zip(rows, groups, strict=True):
        row.insert(4, difference_text(differences[id(group)]) if id(group) in differences else "")
    return markdown(head, rows)


def differences_markdown(groups: Sequence[Group]) -> str:
    """Return the differences from the figures printed in the paper, as a list."""
    lines = []
    for part, word in (("pre", "before"), ("post", "after")):
        for label, name in IN_PAPER.items():
            these = [group for group in groups if group.label == label and group.printed is not None]
            if these:
                text = ", ".join(_against_print(group, part) for group in these)
                lines.append(f"* {name} ({label}) {word} the catch: {text}.")
    for part, word in (("pre", "before"), ("post", "after")):
        found = [g for g in groups if g.label in IN_PAPER and g.printed is not None]
        ours = [spread.p50 for g in found if (spread := g.spread(f"rms.{part}.e_q_deg")) and spread.p50 is not None]
        printed = [
            of.e_q_deg for g in found if g.printed and (of := g.printed.pre if part == "pre" else g.printed.post)
        ]
        if ours and printed:
            lines.append(f"* Attitude {word} the catch: {_range(ours)} deg (printed: {_range(printed)}).")
    orders: dict[str, list[str]] = {}
    for payload_kg in dict.fromkeys(group.payload_kg for group in groups):
        these = [group for group in groups if group.payload_kg == payload_kg and group.label in IN_PAPER]
        order = [IN_PAPER[g.label] for g in sorted(these, key=lambda g: _rank(g.spread(_E_P.format("post"))))]
        if len(order) == len(IN_PAPER):
            orders.setdefault(", ".join(order), []).append(f"{payload_kg:g}")
    for names, payloads in orders.items():
        lines.append(
            f"* Order after the catch at {', '.join(payloads)} kg: {names} (printed: {', '.join(IN_PAPER.values())})."
        )
    return "\n".join(lines)


def knowledge_markdown() -> str:
    """Return the vehicle parameters that each built-in preset uses, and those that it estimates in flight."""
    named = [(law, preset) for law in LAWS for preset in PRESETS[law]]
    loaded = [load_flight(MISSION, controller_law=law, preset=preset).controller for law, preset in named]
    configs = [controller for controller in loaded if isinstance(controller, LawConfig)]
    head = ("law/preset", *(title for title, _ in _TOLD), "adapted or estimated in flight")
    rows = [(f"{c.law}/{c.preset}", *("yes" if uses(c) else "–" for _, uses in _TOLD), _estimated(c)) for c in configs]
    return markdown(head, rows)


def _observer(c: LawConfig) -> bool:
    return any(c.disturbance_time_xyz_s)


_TOLD: tuple[tuple[str, Callable[[LawConfig], bool]], ...] = (
    ("gravity of the arm", lambda c: not isinstance(c, AdaptiveConfig) or c.arm_gravity_nominal),
    ("inertia of the arm", lambda c: not isinstance(c, AdaptiveConfig) or c.arm_inertia_nominal),
    ("inertia of the base, coupling", lambda c: isinstance(c, CscConfig)),
    ("joint friction", lambda c: c.arm_friction_share > 0),
    ("lag of thrust or attitude", lambda c: _observer(c) or c.feedforward_lead_s > 0 or isinstance(c, PscConfig)),
)  # fmt: skip


def _estimated(c: LawConfig) -> str:
    found = ["disturbance force"] if _observer(c) else []
    if isinstance(c, AdaptiveConfig):
        found += ["H, zeta"]
        loads = (("load", c.load_rate_xyz), ("moments", c.moment_rate), ("friction", c.friction_rate))
        found += [name for name, rates in loads if any(rates)]
    if isinstance(c, PscConfig):
        found += ["payload mass"] if c.payload_max_kg > 0 else []
        found += ["integral of the position error"] if any(c.position_ki_xyz) else []
    return ", ".join(found) or "–"


def _label(group: Group) -> str:
    """Return `law/preset`, where a controller file takes its name."""
    return f"{Path(group.controller).stem}/{group.preset}"


def _with_source(table: str, groups: Sequence[Group]) -> str:
    """Return the table followed by the seeds, commands and commits of its flights."""
    rows = [row for group in groups for row in group.rows]
    seeds = sorted({row["seed"] for row in rows})
    errors = ", ".join(f"{100 * error:g} %" for error in sorted({group.model_error for group in groups}))
    what = f"{len(seeds)} laboratories (seeds {seeds[0]} to {seeds[-1]}), {len(rows)} flights, model error {errors}."
    return "\n".join([table, "", what, *dict.fromkeys(row["flown_by"].lstrip() for row in rows)])


def _spreads(group: Group, figures: Sequence[tuple[str, str, int]]) -> list[str]:
    return [spread_text(group.spread(name), digits) or "–" for _, name, digits in figures]


def _completed(group: Group) -> str:
    done = f"{len(group.rows) - sum(group.failures.values())} of {len(group.rows)}"
    return (
        f"{done} ({', '.join(f'{count} {what}' for what, count in group.failures.items())})" if group.failures else done
    )


def _error_cell(group: Group | None) -> str:
    if group is None:
        return ""
    text = spread_text(group.spread(_E_P.format("post")), 3) or "–"
    return f"{text}; {_completed(group)}" if group.failures else text


def _attitude(group: Group) -> str:
    return " / ".join(spread_text(group.spread(f"rms.{part}.e_q_deg"), 1, p95=False) or "–" for part in ("pre", "post"))


def _paper(group: Group) -> str:
    if group.label not in IN_PAPER or group.printed is None:
        return ""
    return f"{group.printed.pre.e_p_m:.3f} / {_printed(group.printed.post)}"


def _printed(figures: Printed | None) -> str:
    return "crashed" if figures is None else f"{figures.e_p_m:.3f}"


def _rank(spread: Any) -> float:
    return float("inf") if spread is None or spread.p50 is None else float(spread.p50)


def _range(values: Sequence[float]) -> str:
    return f"{min(values):.1f} to {max(values):.1f}"


def _against_print(group: Group, part: str) -> str:
    assert group.printed is not None
    printed = group.printed.pre if part == "pre" else group.printed.post
    spread = group.spread(_E_P.format(part))
    ours = None if spread is None else spread.p50
    text = "failed" if ours is None else f"{ours:.3f} m"
    times = f", ratio {ours / printed.e_p_m:.2g}" if ours is not None and printed is not None else ""
    return f"{text} at {group.payload_kg:g} kg (printed: {_printed(printed)}{times})"


def tables(files: Sequence[Results]) -> dict[str, str]:
    """Return the tables by name, each with the commands and commits from which its figures come; none without a flight."""
    groups = by_payload(aggregate(merged(files)))
    whole = [group for group in groups if not is_ablation(group.preset)]
    first = [group for group in whole if group.model_error == min(one.model_error for one in groups)]
    built_in = [group for group in first if group.controller in LAWS]
    published = [group for group in built_in if group.preset in AS_PUBLISHED]
    extras = [group for group in built_in if group.preset not in AS_PUBLISHED]
    others = [group for group in first if group.controller not in LAWS]
    soft = [group for group in others if group.preset == "soft"]
    baselines = [group for group in others if group.preset != "soft"]
    errors_of = Counter((group.label, group.payload_kg) for group in whole)
    by_error = [group for group in whole if errors_of[group.label, group.payload_kg] > 1]
    off = {
        (group.label, group.payload_kg, group.model_error) for group in groups if group.preset.endswith(ADAPTATION_OFF)
    }
    off |= {(label.removesuffix(ADAPTATION_OFF), payload_kg, error) for label, payload_kg, error in off}
    paired = [group for group in groups if (group.label, group.payload_kg, group.model_error) in off]
    ablated = [
        group
        for group in groups
        if group.label.startswith("/".join(ABLATED) + LESS)
        and (group.payload_kg, group.model_error) == (ABLATION_KG, first[0].model_error)
    ]
    against = partial(laws_markdown, differences=pairs_with_reference(first))
    made: dict[str, tuple[Callable[[Sequence[Group]], str], Sequence[Group]]] = {
        "published": (against, published),
        "extras": (against, extras),
        "baselines": (against, baselines),
        "soft": (laws_markdown, soft),
        "model error": (model_error_markdown, by_error),
        "adaptation": (adaptation_markdown, paired),
        "ablation": (partial(ablation_markdown, differences=pairs_with_reference([*first, *ablated])), ablated),
    }
    flown = {name: _with_source(table(of), of) for name, (table, of) in made.items() if of}
    return {**flown, "differences": differences_markdown(first), "told": knowledge_markdown()}


def main(argv: list[str] | None = None) -> int:
    """Write the tables into a page and its plots into `pictures/` next to the page; return the exit code."""
    parser = argparse.ArgumentParser(prog="tools.docs.compare")
    parser.add_argument("page", type=Path)
    parser.add_argument("results", type=Path, nargs="+", help="compare.json of companion compare")
    arguments = parser.parse_args(argv)
    try:
        files = [json.loads(file.read_text(encoding="utf-8")) for file in arguments.results]
        found, rows = tables(files), merged(files)
    except (OSError, ValueError, KeyError) as error:
        reason = f"key {error} is missing" if isinstance(error, KeyError) else str(error)
        print(f"{', '.join(map(str, arguments.results))}: {reason}", file=sys.stderr)
        return 2
    # The companion's own laws: with the others the plots are crowded.
    for name, _, _, figure in distributions(aggregate([row for row in rows if row["controller"] in LAWS])):
        table, alt = PICTURES.get(name, ("", ""))
        if table in found:
            picture = Path("pictures") / f"compare_{name}.svg"
            found[table] += f"\n\n![{alt}]({picture})"
            (arguments.page.parent / picture).parent.mkdir(exist_ok=True)
            write_svg(figure, arguments.page.parent / picture)
    return write_page(arguments.page, found)


if __name__ == "__main__":
    sys.exit(main())
