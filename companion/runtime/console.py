"""Terminal output of a flight: live progress and the result."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, ClassVar, Final, TextIO, cast

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.table import Table
from rich.text import Text

from companion.model.check_row import Row, refusals
from companion.model.flight_stage import Stage
from companion.model.launcher_messages import (
    AnyMessage,
    Busy,
    CommandDone,
    FlightEvent,
    GroundText,
    Pace,
    PreflightDone,
    PreflightProgress,
    Px4Text,
    Started,
    Status,
    WorldEvent,
    WorldProgress,
)
from companion.model.negative_zero import without_negative_zero
from companion.model.types import SafetyAction, Severity

FULL: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of a disk, quota or file that takes no more text."""


class SteadyStream:
    """A text stream that never fails: it discards all text once its reader has gone (a closed pipe, a terminal that hung up)."""

    _full: ClassVar[OSError | None] = None
    """Error of a full disk on standard output."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    @staticmethod
    def raise_full() -> None:
        """Raise the error of a disk that was too full for text on standard output, once; do nothing if there was none."""
        error, SteadyStream._full = SteadyStream._full, None
        if error is not None:
            raise error

    def write(self, text: str) -> int:
        """Write the text, or discard it if the reader has gone."""
        try:
            return self._stream.write(text)
        except OSError as error:
            self._fail(error)
            return len(text)

    def flush(self) -> None:
        """Flush the stream, if its reader is still there."""
        try:
            self._stream.flush()
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        if error.errno in FULL and self._stream is sys.stdout:
            SteadyStream._full = error
        self.discard()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def discard(self) -> None:
        """Discard all text from now on."""
        # The interpreter flushes once more at its end, and would change the exit code if that failed.
        with contextlib.suppress(OSError), open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), self._stream.fileno())


class _PlainNumbers(SteadyStream):
    """Stream that prints negative zeros as zero and never fails when its reader has gone."""

    def write(self, text: str) -> int:
        """Write the text without negative zeros."""
        return super().write(without_negative_zero(text))


class _Prefixed(_PlainNumbers):
    """Stream that begins each line with a word, without a terminal's codes."""

    def __init__(self, stream: TextIO, prefix: str) -> None:
        super().__init__(stream)
        self._prefix = prefix

    def write(self, text: str) -> int:
        """Write whole lines."""
        return super().write("".join(f"{self._prefix}{line}" for line in text.splitlines(keepends=True)))


def prefixed_console(prefix: str) -> Console:
    """Return a console on standard output whose lines begin with a word, for one of several flights."""
    return Console(file=cast("IO[str]", _Prefixed(sys.stdout, prefix)), force_terminal=False)


def console_on(stream: TextIO) -> Console:
    """Return a console on a stream whose reader may disappear. A progress bar is for terminals: `FORCE_COLOR`,
    which notebooks and CI set, makes none of a file.
    """
    return Console(file=cast("IO[str]", _PlainNumbers(stream)), force_terminal=stream.isatty())


def terminal_console() -> Console:
    """Return a console on standard output."""
    return console_on(sys.stdout)


def print_error(text: object) -> None:
    """Print one line to standard error."""
    stream = SteadyStream(sys.stderr)
    stream.write(f"{text}\n")
    stream.flush()


SLOW_PACE = 0.8
"""Share of the wanted pace below which simulated time counts as slow."""
_SEVERITY_STYLE = {Severity.INFO: "cyan", Severity.WARNING: "yellow", Severity.CRITICAL: "bold red"}
_OUTCOME_STYLE = {"completed": "bold green", "aborted": "bold yellow", "refused": "bold yellow"}


class _Numbers(ProgressColumn):
    """Progress column with the most important figures of the flight."""

    def render(self, task: Task) -> Text:
        status: Status | None = task.fields.get("status")
        if status is None:
            return Text(task.fields.get("note") or "", no_wrap=True, overflow="ellipsis")
        parts = [f"t {status.mission_t_s:5.1f} s"]
        if status.error_m is not None:
            parts.append(f"|e_p| {status.error_m * 100:4.1f} cm")
        if status.position_world_m is not None:
            x, y, z = status.position_world_m
            parts.append(f"({x:+.2f} {y:+.2f} {z:.2f}) m")
        parts.append(f"late {status.lateness_s * 1e3:.1f} ms")
        return Text("  ".join(parts), style="red" if status.action.rank > SafetyAction.WARN.rank else "")


class FlightDisplay:
    """Live progress of one flight; without a terminal it prints a line per phase."""

    def __init__(self, console: Console, title: str) -> None:
        self._console = console
        self._title = title
        self._phase = ""
        self._slow = False
        self._event = ""
        """Text of the newest event; no line is printed for a phase that begins with an event of the same name."""
        self._progress = Progress(
            TextColumn("[bold]{task.description:<22}"),
            BarColumn(bar_width=28),
            TextColumn("{task.percentage:>3.0f} %"),
            _Numbers(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("starting", total=1.0, status=None)

    def __enter__(self) -> FlightDisplay:
        self._console.print(f"[bold]{escape(self._title)}[/]  (Ctrl-C lands)")
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def on_message(self, message: AnyMessage) -> None:
        """Show one message of a process of the flight."""
        match message:
            case Status():
                self._show_status(message)
            case WorldEvent(kind="rotor_touched"):
                self._line("", "a rotor touched a surface", "red")
            case WorldEvent(kind="rotor_hit"):
                self._line("", "the ball hit a rotor", "red")
            case WorldEvent(kind="missed"):
                self._line("", "the payload was missed", "red")
            case WorldEvent(kind="crashed"):
                self._line("", "crashed", "red")
            case WorldProgress():
                self.say(message.text)
            case FlightEvent():
                self._event = message.text
                self._line(f"t {message.mission_t_s:6.2f} s", message.text, _SEVERITY_STYLE[message.severity])
            case PreflightProgress():
                if not self._console.is_terminal and self._phase != "preflight":
                    self._line("preflight", message.text, "cyan")
                self._phase = "preflight"
                self._progress.update(self._task, description="preflight", completed=message.share, note=message.text)
            case PreflightDone():
                self._preflight(message.rows)
            case Started():
                self._line("clock" if message.simulated else "real time", message.realtime, "dim")
            case Px4Text():
                self._line("PX4", message.text, "yellow")
            case CommandDone():
                words = f"{message.operator} commanded {message.command.value}: {message.text}"
                self._line(f"t {message.mission_t_s:6.2f} s", words, "cyan" if message.accepted else "yellow")
            case Pace():
                self._pace(message.factor, message.speed)
            case Busy():
                self._line("computer", message.text, "yellow")
            case GroundText(text=str(text)):
                self._line("ground", text, "cyan")

    def _show_status(self, status: Status) -> None:
        self._progress.update(self._task, description=status.phase, completed=status.progress, status=status)
        if status.phase == self._phase:
            return
        self._phase = status.phase
        if not self._console.is_terminal and self._phase != self._event:
            self._console.print(f"  t {status.mission_t_s:6.2f} s  {escape(self._phase)}")
        self._event = ""
        if self._phase == Stage.READY.value:
            self.say("everything is ready; take off with: companion command start (Ctrl-C cancels the start)")

    def _pace(self, factor: float, speed: float) -> None:
        """Show how fast simulated time runs, once when it becomes slower than asked for."""
        slow = factor < SLOW_PACE * min(speed, 1.0)
        if slow and not self._slow:
            text = f"{factor:.1f} x real time: this computer is busy; the flight takes longer and is the same"
            self._line("computer", text, "yellow")
        self._slow = slow

    def _preflight(self, rows: Sequence[Row]) -> None:
        """Show the preflight's result. The checks that refuse the flight are printed at the end, as the reason for the refusal."""
        self._progress.update(self._task, description="starting", completed=0.0, note="")
        warned = [row for row in rows if not row.ok and not row.refuses]
        refused = len(refusals(rows))
        text = f"{len(rows)} checks: " + (f"{refused} refused" if refused else "ok")
        if warned:
            text += f", {len(warned)} warning" + ("" if len(warned) == 1 else "s")
        self._line("preflight", text, "red" if refused else "green")
        for row in warned:
            self._line("", row.line(), "yellow")

    def say(self, text: str) -> None:
        """Print one line from the launcher."""
        self._line("", text, "yellow")

    def _line(self, head: str, text: str, style: str) -> None:
        self._progress.console.print(
            f"  [dim]{escape(head):<11}[/] [{style}]{escape(text)}[/]", highlight=False, soft_wrap=True
        )


def print_result(
    console: Console,
    summary: dict[str, Any],
    out: Path,
    report: Path | None,
    contact: Sequence[tuple[str, str]] = (),
    *,
    catches: bool = True,
) -> None:
    """Print the result table and the paths of the flight's files.

    Args:
        report: the flight's report, if it was written.
        contact: names and texts of facts about a contact.
        catches: whether the mission catches a payload.
    """
    catch = summary.get("catch_t_s")
    outcome = summary["outcome"]
    table = Table(title=None, show_header=True, header_style="bold", box=None, pad_edge=False)
    table.add_column("")
    parts = ("pre",) if catch is None else ("pre", "post")
    for head in ("in flight",) if catch is None else ("before the catch", "after the catch"):
        table.add_column(head, justify="right")
    rms = summary["rms"]

    def cell(part: str, key: str, unit: str, scale: float = 1.0, digits: int = 3) -> str:
        values = rms.get(part)
        value = values.get(key) if values else None
        return "-" if value is None else f"{value * scale:.{digits}f} {unit}"

    for label, key, unit, digits in (
        ("position error, RMS", "e_p_m", "m", 4),
        ("attitude error, RMS", "e_q_deg", "deg", 2),
        ("arm error, RMS", "e_alpha_deg", "deg", 2),
    ):
        table.add_row(label, *(cell(part, key, unit, digits=digits) for part in parts))
    facts: list[tuple[str, str]] = []
    style = _OUTCOME_STYLE.get(outcome, "bold red")
    facts.append(("outcome", f"[{style}]{outcome}[/]"))
    event = _decisive_event(summary)
    if event is not None:
        facts.append(("event", f"{event['id']}: {escape(event['text'])}"))
    facts.append(("controller", f"{summary['controller']} ({summary['preset']})"))
    world = summary.get("world")
    if world is not None:
        facts.append(("world", f"{world['name']}, seed {world['seed']}"))
    catches = catches or catch is not None
    if catches and summary.get("payload_kg") is not None:
        facts.append(("payload", f"{summary['payload_kg']:g} kg (known to the simulated world only)"))
    doubt = (
        ""
        if summary.get("catch_confirmed") is not False
        else ", not confirmed: the flight ended too soon after the impact"
    )
    if catches:
        facts.append(("catch", "none" if catch is None else f"t = {catch:.2f} s{doubt}"))
    for name, text in contact:
        facts.append((name, escape(text)))
    loop, clock = summary.get("loop") or {}, summary.get("clock") or {}
    if loop.get("ticks"):
        rate_hz, late_ms = loop["rate_hz"], loop["lateness_ms"]["p99"]  # None after a tick or two
        rate = "" if rate_hz is None else f"{rate_hz:.0f} Hz, "
        simulated = clock.get("kind") == "simulated"
        late = "" if late_ms is None or simulated else f", late p99 {late_ms:.1f} ms"
        facts.append(("control loop", f"{rate}{loop['ticks']} ticks, {loop['missed']} missed{late}"))
    pace, speed = clock.get("pace"), clock.get("speed")
    if pace is not None:
        wanted = speed if isinstance(speed, float) else 1.0
        slow = ": this computer is busy" if pace < SLOW_PACE * min(1.0, wanted) else ""
        facts.append(("pace", f"{pace:.1f} x real time{slow}"))
    recorder = summary.get("recorder") or {}
    if recorder.get("samples") is not None:
        facts.append(("recorder", f"{recorder['samples']} ticks, {recorder['dropped']} dropped"))
    slack = (summary.get("tether") or {}).get("min_slack_m")
    if slack is not None:
        facts.append(("tether", f"minimum slack {slack:.2f} m"))
    every = summary.get("graded_every", 1)
    if every > 1:
        facts.append(("graded", f"one tick in {every} of a long flight; loop and latencies: every tick"))
    facts.append(("report", escape(str(report) if report else f"none; see the folder {out}")))
    _print_facts(console, facts)
    if outcome != "refused":
        console.print()
        console.print(table, highlight=False)


def _decisive_event(summary: dict[str, Any]) -> dict[str, Any] | None:
    """Return the first of the events with the most severe action of a flight that took off and was not completed, or None."""
    if summary["outcome"] in ("completed", "refused"):
        return None
    event: dict[str, Any] | None = max(
        summary.get("events", ()), key=lambda event: SafetyAction(event["action"]).rank, default=None
    )
    return None if event is None or SafetyAction(event["action"]) is SafetyAction.NOMINAL else event


def _print_facts(console: Console, facts: Sequence[tuple[str, str]]) -> None:
    """Print names and texts, both with markup, in two columns. No line is wrapped or padded, so that paths can be copied."""
    width = max(len(name) for name, _ in facts)
    console.print()
    for name, text in facts:
        console.print(f"{name:<{width}}  {text}", highlight=False, soft_wrap=True)


def print_team_result(
    console: Console, summary: dict[str, Any], figures: Sequence[tuple[str, str]], path: Path
) -> None:
    """Print the result of two vehicles that carry a bar.

    Args:
        summary: `outcome`, the worse one of both; `members`, with the summary of each.
        figures: names and texts of the figures of the bar.
        path: report of the flight, or the folder of a flight without one.
    """
    outcome = summary["outcome"]
    facts: list[tuple[str, str]] = []
    facts.append(("outcome", f"[{_OUTCOME_STYLE.get(outcome, 'bold red')}]{outcome}[/]"))
    for end, member in summary["members"].items():
        error_m = (member["rms"].get("pre") or {}).get("e_p_m")
        event = _decisive_event(member)
        why = "" if event is None else f" by {event['id']}"
        facts.append(
            (end, member["outcome"] + why + ("" if error_m is None else f", position error {error_m:.4f} m RMS"))
        )
    facts += figures
    facts.append(("report" if path.suffix == ".html" else "files", escape(str(path))))
    _print_facts(console, facts)
