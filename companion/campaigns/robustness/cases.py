"""Named cases: difficult worlds with their recorded results, in a YAML file."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from companion.campaigns.robustness.draws import SAFE, why_of
from companion.campaigns.runner import Row
from companion.config.base import Model, NonNegative
from companion.config.document import ConfigError, problem_lines
from companion.config.explain import validate
from companion.config.yaml_strict import read_document
from companion.config.yaml_text import flow_text
from companion.model.types import Outcome
from companion.runtime.files import write_whole
from companion.sitl_config.world import World

WORSE_THAN_KEPT = 1.25
"""Largest allowed ratio of a case's error to its recorded error."""


class Kept(Model):
    """Recorded results of a case."""

    outcome: Outcome
    caught: bool
    e_p_m: NonNegative | None = None
    """RMS error after the catch, or of the whole flight if there was no catch; absent if the mission was not completed."""


class Case(Model):
    """A world in which it was difficult to fly, with its recorded result."""

    name: str
    world: World
    kept: Kept

    def knobs(self) -> dict[str, Any]:
        """Return the keys of the world that the case sets."""
        knobs: dict[str, Any] = self.world.model_dump(mode="json", exclude_unset=True)
        return knobs


class Cases(Model):
    """A file of cases."""

    mission: str
    controller: str
    preset: str
    vehicle: str | None = None
    """Vehicle file; None for the mission's."""
    overrides: tuple[str, ...] = ()
    """Settings of `--set` outside the world, which each case contains whole."""
    cases: tuple[Case, ...]

    def named(self, names: Sequence[str]) -> tuple[Case, ...]:
        """Return the named cases in the order of the file, or all cases if no names are given.

        Raises:
            ConfigError: there is no such case.
        """
        known = [case.name for case in self.cases]
        if missing := [name for name in names if name not in known]:
            raise ConfigError([f"--case {name}: no such case; available: {', '.join(known)}" for name in missing])
        return tuple(case for case in self.cases if not names or case.name in names)


def read_cases(path: Path) -> Cases:
    """Read a file of cases.

    Raises:
        ConfigError: one line per problem, with file, line and column.
    """
    document = read_document(path)
    cases = validate(Cases, document)
    if cases is None:
        raise ConfigError(problem_lines(document.problems))
    names = [case.name for case in cases.cases]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(f"{path}: cases: expected distinct names, but these occur more than once: {', '.join(twice)}")
    return cases


def write_cases(cases: Cases, path: Path, remark: str) -> None:
    """Write a file that `read_cases` reads.

    Args:
        remark: comment lines at the head of the file.
    """
    lines = [f"# {line}".rstrip() for line in remark.splitlines()]
    keys = cases.model_dump(mode="json", exclude={"cases"}, exclude_defaults=True)
    lines += [*(f"{key}: {flow_text(value)}" for key, value in keys.items()), "cases:"]
    for case in cases.cases:
        lines += ["", f"  - name: {flow_text(case.name)}", "    world:"]
        lines += [f"      {key}: {flow_text(value)}" for key, value in case.knobs().items()]
        lines.append(f"    kept: {flow_text(case.kept.model_dump(mode='json', exclude_none=True))}")
    write_whole(path, ("\n".join(lines) + "\n").encode())


def fly_command(
    mission: str,
    controller: str,
    preset: str,
    name: str,
    world: Mapping[str, Any],
    sets: Sequence[str],
    vehicle: str | None,
) -> str:
    """Return the `companion fly --sitl` command that flies the same world."""
    words = ["companion", "fly", mission, "--sitl"]
    words += [] if vehicle is None else ["--vehicle", vehicle]
    words += ["--controller", controller, "--preset", preset, "--world", name]
    words += ["--set", *sets]
    for key, value in world.items():
        text = flow_text(value)
        words.append(f"world.{key}={text if '{' in text else text.replace(' ', '')}")
    return shlex.join(words)


def case_name(row: Row) -> str:
    """Return the name under which a row is kept: that of its case, or the number of its draw."""
    return str(row["name"]) if row["number"] is None else f"draw_{row['number']}"


def as_cases(rows: Sequence[Row]) -> tuple[Case, ...]:
    """Return rows as cases to keep."""
    cases = []
    for row in rows:
        error_m = row["e_p_m"] if row["outcome"] == Outcome.COMPLETED.value else None
        kept = Kept(
            outcome=Outcome(row["outcome"]), caught=row["caught"], e_p_m=None if error_m is None else round(error_m, 4)
        )
        cases.append(Case(name=case_name(row), world=World.model_validate(row["world"]), kept=kept))
    return tuple(cases)


def worse_than(row: Row, kept: Kept) -> str | None:
    """Return what is worse than the recorded results, or None."""
    outcome, why = row["outcome"], why_of(row)
    if outcome != kept.outcome.value and outcome != Outcome.COMPLETED.value:
        return f"{outcome} ({why}), recorded as {kept.outcome.value}"
    if outcome not in SAFE:
        return f"{outcome} ({why})"
    if kept.caught and not row["caught"]:
        return "the payload was no longer caught"
    if kept.e_p_m is not None and row["e_p_m"] is not None and row["e_p_m"] > WORSE_THAN_KEPT * kept.e_p_m:
        return f"e_p {row['e_p_m']:.4f} m, more than {WORSE_THAN_KEPT:g} times the kept value of {kept.e_p_m:.4f} m"
    return None
