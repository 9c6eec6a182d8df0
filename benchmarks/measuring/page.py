"""The page of results, and the same tables in a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.measuring.figures import Row, Section, Target, figure, problems

HEAD = """# Benchmarks

`make bench` measures everything on this page, and `python -m benchmarks --page` writes the page from the results. A cell reads
*figure / figure of the reference beside it = ratio*. All scripts: [benchmarks](../../benchmarks/README.md).
"""


def markdown(results: Mapping[str, Any], sections: Sequence[Section]) -> str:
    """Return the page as Markdown.

    Args:
        results: results written by `benchmarks/__main__.py`.
        sections: tables of the page.
    """
    blocks = [HEAD, *_about(results)]
    for section in sections:
        blocks += [f"## {section.title}\n", *(f"{text}\n" for text in section.how)]
        header = ["", "beside", *section.statistics, "target", ""]
        rows = [
            f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *map(_cells(section), section.rows))
        ]
        blocks.append("\n".join(rows) + "\n")
    return "\n".join(blocks)


def show(results: Mapping[str, Any], sections: Sequence[Section], console: Console) -> None:
    """Print the tables, then the targets that were not met."""
    for section in sections:
        table = Table("", "beside", *section.statistics, "target", "", title=section.title, title_justify="left")
        for row in section.rows:
            table.add_row(*(cell.replace("**", "") for cell in _cells(section)(row)))
        console.print(table)
    for line in (*_failed(results), *problems(sections)):
        console.print(line, style="red", highlight=False, soft_wrap=True)


def _cells(section: Section) -> Any:
    def cells(row: Row) -> list[str]:
        figures = [_cell(row, name) for name in section.statistics]
        return [row.what, row.beside, *figures, _target(row.target), row.verdict or row.why_not]

    return cells


def _cell(row: Row, name: str) -> str:
    value, beside, ratio = row.figures.get(name), row.beside_figures.get(name), row.ratios.get(name)
    if value is None and beside is None:
        return ""
    text = "-" if value is None else figure(value)
    if row.beside_figures and beside is not None:
        text += f" / {figure(beside)}"
    return text if ratio is None else f"{text} = {f'{ratio:.2f}' if ratio < 100.0 else figure(ratio)}"


def _target(target: Target | None) -> str:
    if target is None:
        return ""
    limit = f"{target.at_most:g} x" if target.ratio else f"{target.at_most:g}"
    names = " and ".join(name for name in target.of if name not in ("value", "max"))
    return f"{names} <= {limit}".strip()


def _about(results: Mapping[str, Any]) -> Iterator[str]:
    made: Mapping[str, Any] = results.get("made", {})
    yield "".join(f"* {line}\n" for line in _facts(made, results["parts"].get("hover", {}).get("figures", {})))
    quick = [name for name, part in results["parts"].items() if part.get("quick")]
    if quick:
        yield (
            "**A quick run: the hover lasted one minute instead of ten.**\n"
            if "hover" in quick
            else "**A quick run.**\n"
        )
    failed = list(_failed(results))
    if failed:
        yield "".join(f"* **{line}**\n" for line in failed)


def _facts(made: Mapping[str, Any], hover: Mapping[str, Any]) -> Iterator[str]:
    if made:
        yield f"{made['date']}: {made['computer']}"
        yield ", ".join(f"{name} {version}" for name, version in made["versions"].items())
    if not hover:
        return
    machine = hover.get("machine") or {}
    busy = (
        f"; all cores together {machine['busy_percent']:.0f} % busy, {machine['stolen_percent']:.1f} % taken by the host"
        if machine
        else ""
    )
    ended = f"{hover['flight']['ticks']} ticks, {hover['outcome']}, recorder dropped {hover['recorder_dropped']}"
    yield f"hover of {hover['hover_s']:.0f} s: {ended}{busy}"
    yield f"real time: {hover['realtime']}"
    yield f"viewer: {hover['viewer']}"
    limits = ", ".join(f"{key.removeprefix('vehicle.')} {value}" for key, value in hover["limits"].items())
    yield f"wider limits than the vehicle file's, for a computer that is held up as a whole now and then: {limits}"
    for text in hover["warnings"]:
        yield f"the flight said: {text}"


def _failed(results: Mapping[str, Any]) -> Iterator[str]:
    for name, part in results["parts"].items():
        if part.get("failed"):
            yield f"{name} was not measured: {part['failed']}"
        figures = part.get("figures") or {}
        if figures.get("outcome", "completed") != "completed":
            yield f"the flight did not complete: {figures['outcome']}, exit code {figures['exit_code']}"
