"""Mutation tests: breaks one place of a module at a time and reports which of these mutants no test of its package notices.

`python -m tools.mutants` judges a random sample; cosmic-ray finds the places and writes the mutants. Each package of `PACKAGES` is
judged by the tests in the folder of the same name, on a copy of the repository in build/. A mutant that exceeds the timeout counts as
killed. A survivor is a missing test, or equivalent: no input makes it behave differently. Those found so far are in
`tools/equivalent_mutants.txt`, each with the reason below it.

Not mutated are annotations, imports, asserts, decorators and the options of a class, which no flight reaches, and `<` for `<=`: a
measured value equals its limit only by chance.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

ROOT = Path(__file__).parent.parent
COPY = ROOT / "build" / f"mutated-{os.getpid()}"
TOOL = ROOT / "build" / "mutants"
"""Where `make mutants` installs cosmic-ray; behind the project's own packages, whose versions count."""
PACKAGES: Final = {
    "safety": ("companion/safety/*.py",),
    "core": ("companion/core/*.py",),
    "guardian": ("companion/guardian/*.py",),
    "control": tuple(f"companion/control/{name}.py" for name in ("arm_hold", "common", "thrust")),
}
"""The modules of each package; of the control laws those that limit force, tilt and torque."""
OPERATORS = (
    "AddNot",
    "NumberReplacer",
    "ReplaceAndWithOr",
    "ReplaceOrWithAnd",
    "ReplaceTrueWithFalse",
    "ReplaceFalseWithTrue",
    "ReplaceBreakWithContinue",
    "ReplaceContinueWithBreak",
    "ZeroIterationForLoop",
    "ReplaceUnaryOperator_USub_UAdd",
    "ReplaceUnaryOperator_Delete_Not",
    "ReplaceUnaryOperator_Delete_Invert",
    *(
        f"ReplaceBinaryOperator_{a}"
        for a in ("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "FloorDiv_Mul", "BitAnd_BitOr")
    ),
    *(f"ReplaceComparisonOperator_{a}" for a in ("Lt_GtE", "LtE_Gt", "Gt_LtE", "GtE_Lt", "Eq_NotEq", "NotEq_Eq")),
    "ReplaceComparisonOperator_Is_IsNot",
    "ReplaceComparisonOperator_IsNot_Is",
)
THIRD_PARTY = (
    "pytest",
    "hypothesis",
    "numpy",
    "scipy.linalg",
    "msgspec",
    "pydantic",
    "yaml",
    "mujoco",
    "ruckig",
    "serial",
)
"""Imported once; the tests of each mutant run in a fork."""
TIMEOUT_FACTOR, TIMEOUT_MORE_S = 2.0, 30.0
EQUIVALENT: Final = frozenset(
    line
    for line in (ROOT / "tools/equivalent_mutants.txt").read_text(encoding="utf-8").splitlines()
    if line.startswith("companion/")
)
"""Mutants that no test can kill: the file, and the line before and after."""
Span = tuple[tuple[int, int], tuple[int, int]]
"""First and last position of a piece of source text: line from 1, column from 0."""


class DropOperand:
    """Leaves out one operand of `and` or `or`."""

    @staticmethod
    def mutation_positions(node: Any) -> Iterator[Span]:
        """Yield the position of each operand."""
        if node.type in ("and_test", "or_test"):
            for operand in node.children[::2]:
                yield operand.start_pos, operand.end_pos

    @staticmethod
    def mutate(node: Any, index: int) -> Any:
        """Remove an operand and one operator beside it."""
        first = max(0, 2 * index - 1)
        if index == 0:
            node.children[2].get_first_leaf().prefix = node.children[0].get_first_leaf().prefix
        del node.children[first : first + 2]
        return node


class AllOrAny:
    """Replaces `all` by `any` and vice versa."""

    @staticmethod
    def mutation_positions(node: Any) -> Iterator[Span]:
        """Yield the position of each of these names."""
        if node.type == "name" and node.value in ("all", "any"):
            yield node.start_pos, node.end_pos

    @staticmethod
    def mutate(node: Any, index: int) -> Any:
        """Replace the name."""
        node.value = {"all": "any", "any": "all"}[node.value]
        return node


@dataclass(frozen=True)
class Mutant:
    """One change of one module."""

    path: str
    line: int
    operator: str
    occurrence: int
    """Number of the place among those of this operator in the module."""

    @property
    def place(self) -> str:
        """Return file and line."""
        return f"{self.path}:{self.line}:"


def operators() -> dict[str, Any]:
    """Return the operators by name: those of cosmic-ray, and two of this module."""
    sys.path.append(str(TOOL))
    from cosmic_ray.plugins import get_operator

    return {name: get_operator(f"core/{name}")() for name in OPERATORS} | {
        "DropOperand": DropOperand(),
        "AllOrAny": AllOrAny(),
    }


def unreached(source: str) -> list[Span]:
    """Return the pieces of a module that are not mutated."""
    found: list[ast.AST] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Assert | ast.Import | ast.ImportFrom):
            found.append(node)
        elif isinstance(node, ast.AnnAssign | ast.arg):
            found += [] if node.annotation is None else [node.annotation]
        elif isinstance(node, ast.FunctionDef):
            found += node.decorator_list + ([] if node.returns is None else [node.returns])
        elif isinstance(node, ast.ClassDef):
            found += [*node.decorator_list, *node.keywords]
    return [((n.lineno, n.col_offset), (n.end_lineno, n.end_col_offset)) for n in found]  # type: ignore[attr-defined]


def mutants(package: str, found: dict[str, Any]) -> Iterator[Mutant]:
    """Yield all mutants of a package."""
    from cosmic_ray.ast import ast_nodes, get_ast

    for path in sorted(path for pattern in PACKAGES[package] for path in ROOT.glob(pattern)):
        source = path.read_text(encoding="utf-8")
        nodes, skipped = list(ast_nodes(get_ast(source))), unreached(source)
        for name, operator in found.items():
            positions = [start for node in nodes for start, _ in operator.mutation_positions(node)]
            for occurrence, start in enumerate(positions):
                if not any(first <= start < last for first, last in skipped):
                    yield Mutant(str(path.relative_to(ROOT)), start[0], name, occurrence)


class Durations:
    """A plugin of pytest that adds up the time of each test file."""

    def __init__(self) -> None:
        self.by_file: dict[str, float] = {}

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Add the time of one phase of a test."""
        name = report.nodeid.partition("::")[0]
        self.by_file[name] = self.by_file.get(name, 0.0) + report.duration


def _run(files: list[str], durations: Path | None) -> int:
    os.setsid()
    log = os.open(COPY / "pytest.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(log, 1)
    os.dup2(log, 2)
    os.chdir(COPY)
    sys.path[0] = str(COPY)
    import pytest

    plugin, about_forks = Durations(), "ignore::pytest.PytestAssertRewriteWarning"
    code = pytest.main(["-x", "-q", "-n0", "-p", "no:cacheprovider", "-W", about_forks, *files], plugins=[plugin])
    if durations is not None:
        durations.write_text(json.dumps(plugin.by_file), encoding="utf-8")
    return int(code)


def run_tests(files: list[str], timeout_s: float, durations: Path | None = None) -> bool:
    """Return whether these test files pass in a fork of this process, in the copy of the repository."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            code = _run(files, durations)
        finally:
            os._exit(code)
    end_s = time.monotonic() + timeout_s
    status: int | None = None
    while status is None and time.monotonic() < end_s:
        done, code = os.waitpid(child, os.WNOHANG)
        status = code if done else None
        time.sleep(0.02)
    with contextlib.suppress(ProcessLookupError):  # also what the tests have started
        os.killpg(child, signal.SIGKILL)
    if status is None:
        os.waitpid(child, 0)
    return status == 0


def survivor(mutant: Mutant, operator: Any, files: list[str], timeout_s: float) -> str | None:
    """Return file, line and change of a mutant with which all tests pass; None if one fails."""
    from cosmic_ray.mutating import mutate_code

    path = COPY / mutant.path
    sound = path.read_text(encoding="utf-8")
    code = mutate_code(sound, operator, mutant.occurrence)
    try:
        _write(path, code)
        if not run_tests(files, timeout_s):
            return None
    finally:
        _write(path, sound)
    pairs = zip(sound.splitlines(), code.splitlines(), strict=False)
    before, after = next((pair for pair in pairs if pair[0] != pair[1]), ("", ""))
    return f"{mutant.place} {before.strip()}  ->  {after.strip()}"


def without_line(alive: str) -> str:
    """Return a survivor without the number of its line, which changes."""
    path, _, rest = alive.partition(":")
    return f"{path}:{rest.partition(':')[2]}"


def _write(path: Path, text: str) -> None:
    """Write a module. Its bytecode goes: a change within a second that keeps the length would not be noticed."""
    path.write_text(text, encoding="utf-8")
    for old in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
        old.unlink()


def in_order(mutant: Mutant, seconds: dict[str, float]) -> list[str]:
    """Return the test files: first those that name the module, then the quicker ones."""
    name = Path(mutant.path).stem
    return sorted(seconds, key=lambda file: (name not in (COPY / file).read_text(encoding="utf-8"), seconds[file]))


def copy_repository() -> None:
    """Copy all files that git knows or would add."""
    listed = subprocess.run(["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, check=True)
    for name in listed.stdout.decode().splitlines():
        if (ROOT / name).exists():
            (COPY / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, COPY / name, follow_symlinks=False)  # companion/config/files is a link


def main() -> int:
    """Judge a sample of each package and print the table. The exit status is 1 if a test fails without a mutant, else 0."""
    parser = argparse.ArgumentParser(prog="tools.mutants", description=__doc__)
    parser.add_argument("packages", nargs="*", default=list(PACKAGES), help=f"of {', '.join(PACKAGES)}; default: all")
    parser.add_argument("--seed", type=int, default=1, help="of the sample")
    parser.add_argument("--count", type=int, default=25, help="mutants of each package; 0 means all")
    parser.add_argument(
        "--at", nargs="*", default=[], help="of the sample, only mutants whose file:line begins like this"
    )
    args = parser.parse_args()
    found = operators()
    for name in THIRD_PARTY:
        __import__(name)
    try:
        copy_repository()
        return judge(args, found)
    finally:
        shutil.rmtree(COPY, ignore_errors=True)


def judge(args: argparse.Namespace, found: dict[str, Any]) -> int:
    """Judge the mutants of each package."""
    rows = []
    for package in args.packages:
        chosen = list(mutants(package, found))
        total = len(chosen)
        if 0 < args.count < total:
            chosen = random.Random(args.seed).sample(chosen, args.count)
        chosen = [mutant for mutant in chosen if not args.at or mutant.place.startswith(tuple(args.at))]
        durations = COPY / "durations.json"
        begin_s = time.monotonic()
        if not run_tests([f"tests/{package}"], 1800.0, durations):
            print((COPY / "pytest.log").read_text(encoding="utf-8"))
            return 1
        timeout_s = TIMEOUT_FACTOR * (time.monotonic() - begin_s) + TIMEOUT_MORE_S
        seconds = json.loads(durations.read_text(encoding="utf-8"))
        killed = equivalent = 0
        for mutant in chosen:
            alive = survivor(mutant, found[mutant.operator], in_order(mutant, seconds), timeout_s)
            killed += alive is None
            if alive is not None and without_line(alive) in EQUIVALENT:
                equivalent += 1
            elif alive is not None:
                print(f"survived: {alive}", flush=True)
        count = len(chosen) - equivalent
        rows.append((package, total, len(chosen), killed, equivalent, count - killed, 100.0 * killed / max(1, count)))
        print(f"{package}: {killed} of {count} killed, {time.monotonic() - begin_s:.0f} s", flush=True)
    print("\n| package | mutants | sample | killed | equivalent | survived | killed % |\n|---|---|---|---|---|---|---|")
    for row in rows:
        print("| {} | {} | {} | {} | {} | {} | {:.0f} |".format(*row))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
