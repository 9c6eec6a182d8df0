"""Pytest plugin: write what came of the tests to a file, for `tests.stages` (`-p tests.tally --tally FILE`)."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import pytest

_OPTION = "--tally"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(_OPTION, metavar="FILE", help="write the results to this file, as JSON")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Write the tally. Failures while collecting count as failed tests."""
    path = config.getoption(_OPTION)
    if not path:
        return
    reports = terminalreporter.stats
    failed = dict.fromkeys(report.nodeid for key in ("failed", "error") for report in reports.get(key, ()))
    skipped = Counter(_reason(report) for report in reports.get("skipped", ()))
    tally = {"passed": len(reports.get("passed", ())), "failed": list(failed), "skipped": skipped}
    Path(path).write_text(json.dumps(tally), encoding="utf-8")


def _reason(report: pytest.TestReport | pytest.CollectReport) -> str:
    """Return why a test was skipped."""
    text = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    return text.removeprefix("Skipped: ")
