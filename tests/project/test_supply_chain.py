"""What is installed and run: every package pinned with the hash of its files, every action of CI by its commit."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from companion import DISTRIBUTION

ROOT = Path(__file__).parents[2]
PIN = re.compile(r"^([a-z0-9.-]+)==(\S+)", re.MULTILINE)


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def locked(what: str) -> dict[str, tuple[str, str]]:
    """Version and the lines of hashes of every package of a lock."""
    text = (ROOT / f"requirements/{what}.txt").read_text(encoding="utf-8")
    heads = list(PIN.finditer(text))
    ends = [head.start() for head in heads[1:]] + [len(text)]
    return {normal(head[1]): (head[2], text[head.end() : end]) for head, end in zip(heads, ends, strict=True)}


def wanted(extras: bool) -> set[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = list(project["dependencies"])
    if extras:
        lines += [line for lines_of in project["optional-dependencies"].values() for line in lines_of]
    names = {normal(re.split(r"[\[<>=;! ]", line)[0]) for line in lines}
    return names - {DISTRIBUTION}


@pytest.mark.parametrize(("what", "extras"), [("flight", False), ("all", True), ("uv", None)])
def test_every_package_is_pinned_with_hashes(what: str, extras: bool | None) -> None:
    lock = locked(what)
    assert ({"uv"} if extras is None else wanted(extras)) <= set(lock)
    for name, (version, hashes) in lock.items():
        assert re.search(r"--hash=sha256:[0-9a-f]{64}", hashes), f"{name}=={version} has no hash: make lock"


@pytest.mark.parametrize("what", ["flight", "all"])
def test_the_lock_has_the_versions_of_the_constraints(what: str) -> None:
    constraints = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    pinned = {normal(name): version for name, version in PIN.findall(constraints)}
    differ = {
        name: (version, pinned[name])
        for name, (version, _) in locked(what).items()
        if version != pinned.get(name, version)
    }
    assert not differ, "make lock"


def test_ci_runs_actions_by_commit_and_may_only_read() -> None:
    for workflow in (ROOT / ".github/workflows").glob("*.yml"):
        text = workflow.read_text(encoding="utf-8")
        assert "permissions:\n  contents: read\n" in text
        used = re.findall(r"uses: \S+@(\S+)", text)
        assert used
        assert all(re.fullmatch(r"[0-9a-f]{40}", commit) for commit in used), used
