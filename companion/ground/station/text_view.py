"""Display of `companion monitor --text`: one vehicle as rich renderables, or as a single line. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from companion.ground.protocol.messages import EventLine, HealthLevel, Presence, Stream
from companion.ground.station.vehicles import Vehicle
from companion.model.commands import TABLE
from companion.model.types import LandedState, PhaseKind, SafetyAction

STALE_S = 0.3
"""Age at which data is shown as stale; a stream message arrives 20 times a second."""
EVENTS_SHOWN = 8
NOTICES_SHOWN = 3
_KIND_WORD = {
    PhaseKind.GROUND.value: "ON THE GROUND",
    PhaseKind.TAKEOFF.value: "TAKING OFF",
    PhaseKind.FLIGHT.value: "FLYING",
    PhaseKind.LANDING.value: "LANDING",
    PhaseKind.DONE.value: "DONE",
}
_ACTION_STYLE = {SafetyAction.NOMINAL.value: "green", SafetyAction.WARN.value: "yellow"}
_SEVERITY_STYLE = {"info": "cyan", "warning": "yellow", "critical": "bold red"}
_LIGHT_STYLE = {
    HealthLevel.OK: "green",
    HealthLevel.WARN: "yellow",
    HealthLevel.BAD: "bold red",
    HealthLevel.OFF: "dim",
}
_ALARM = "bold white on red"
_MODE_LANDED = {state.value: state.value.replace("_", " ") for state in LandedState}


@dataclass(frozen=True, slots=True)
class Notice:
    """A line about commands."""

    text: str
    style: str = ""


@dataclass(frozen=True, slots=True)
class StationStatus:
    """Status of the ground station, shown below the vehicle."""

    broker: str
    connected: bool
    operator: str | None
    view_only_reason: str | None
    others: tuple[str, ...] = ()
    """Names of all vehicles if there are several."""
    rejected: int = 0
    notices: tuple[Notice, ...] = ()


def printable(text: str) -> str:
    """Return the text without control characters, so that no text from the network can control the terminal."""
    return text if text.isprintable() else "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def status_word(vehicle: Vehicle, now_s: float) -> tuple[str, str]:
    """Return the vehicle's status in a few words, and its style; `ended` and `lost` take precedence over stale data."""
    state, stream, age_s = vehicle.state, vehicle.stream, vehicle.stream_age_s(now_s)
    if state is not None and state.session == vehicle.session:
        match state.presence:
            case Presence.ENDED if vehicle.ended(now_s):
                return f"ENDED: {printable(state.outcome or 'unknown outcome')}", "bold"
            case Presence.LOST:
                return "LOST", _ALARM
            case Presence.SILENT:
                return "SILENT", _ALARM
    if stream is None or age_s is None:
        return "NO DATA YET", "dim"
    if age_s > STALE_S:
        return f"NO DATA FOR {age_s:.1f} s", _ALARM
    if stream.waits_for_start:
        return "WAITING FOR START", "bold cyan"
    if stream.action not in _ACTION_STYLE:
        return printable(stream.action).upper().replace("_", " "), "bold red"
    return _KIND_WORD.get(stream.kind, printable(stream.kind)), "bold green"


def stale(vehicle: Vehicle, now_s: float) -> bool:
    """Whether the displayed values are stale."""
    age_s = vehicle.stream_age_s(now_s)
    return age_s is None or age_s > STALE_S


def status_line(vehicle: Vehicle, now_s: float) -> str:
    """Return the state of one vehicle as one line, for pipes and logs."""
    parts = [printable(vehicle.name), status_word(vehicle, now_s)[0]]
    stream = vehicle.stream
    if stream is not None and not vehicle.ended(now_s):
        parts += [f"{printable(stream.phase)} {100 * stream.progress:.0f} %", f"t {stream.mission_t_s:.1f} s"]
        parts += [printable(stream.action), *_figures(stream)]
    if vehicle.events is not None and vehicle.events.lines:
        last = vehicle.events.lines[-1]
        parts.append(f"last event t {last.t_s:.1f} s {printable(last.text)}")
    return " | ".join(parts)


def render(vehicle: Vehicle | None, now_s: float, station: StationStatus) -> RenderableType:
    """Return the whole display. A terminal that is too low cuts off its end: lamps and events."""
    parts: list[RenderableType] = []
    details: list[RenderableType] = []
    if vehicle is None:
        parts.append(Text("no vehicle yet", style="dim"))
    else:
        old = stale(vehicle, now_s) or vehicle.ended(now_s)
        parts += [_head(vehicle, now_s), *_body(vehicle, old)]
        details = [Text(), *_lights(vehicle, old), *_events(vehicle)]
    parts += [Text(), _keys(station)]
    parts += [Text(f"  {printable(notice.text)}", style=notice.style) for notice in station.notices[-NOTICES_SHOWN:]]
    parts.append(Text(printable(station.broker), style="dim" if station.connected else _ALARM))
    if station.rejected:
        parts.append(Text(f"{station.rejected} messages at the broker were rejected", style="yellow"))
    if station.others:
        parts.append(Text(f"n: next of {', '.join(map(printable, station.others))}", style="dim"))
    return Group(*parts, *details)


def _head(vehicle: Vehicle, now_s: float) -> RenderableType:
    text, style = status_word(vehicle, now_s)
    head = Table.grid(padding=(0, 2))
    cells = [Text(printable(vehicle.name), style="bold"), Text(f" {text} ", style=style)]
    state = vehicle.state
    if state is not None:
        if state.simulated:
            cells.append(Text("SIMULATION", style="magenta"))
        cells.append(Text(printable(f"{state.mission}, {state.law} ({state.preset})"), style="dim"))
    head.add_row(*cells)
    if state is None or not state.text:
        return head
    return Group(head, Text(printable(state.text), style="yellow"))


def _body(vehicle: Vehicle, old: bool) -> list[RenderableType]:
    stream = vehicle.stream
    if stream is None:
        return []
    style = "dim" if old else ""
    course = Table.grid(padding=(0, 2))
    course.add_row(
        Text(printable(stream.phase), style="bold" if not old else "dim"),
        ProgressBar(
            total=1.0, completed=min(1.0, max(0.0, stream.progress)), width=28, complete_style=style or "green"
        ),
        Text(f"{100 * stream.progress:3.0f} %", style=style),
        Text(f"t {stream.mission_t_s:5.1f} s", style=style),
        Text(printable(stream.action), style=style or _ACTION_STYLE.get(stream.action, "bold red")),
        Text(_autopilot(stream), style=style),
    )
    figures = Text("   ".join(_figures(stream)), style=style)
    if stream.tether is not None and (stream.tether.taut or stream.tether.snagged):
        figures.append("   TETHER " + ("SNAGGED" if stream.tether.snagged else "TAUT"), style=_ALARM)
    return [course, figures, Text(_timing(stream), style=style)]


def _lights(vehicle: Vehicle, old: bool) -> list[RenderableType]:
    if vehicle.stream is None:
        return []
    lights = Table.grid(padding=(0, 3))
    cells = [_light(light.name, light.light, light.text, old) for light in vehicle.stream.lights]
    for index in range(0, len(cells), 2):
        lights.add_row(*cells[index : index + 2])
    return [lights]


def _light(name: str, light: HealthLevel, text: str, old: bool) -> Text:
    cell = Text()
    cell.append("● " if light is not HealthLevel.BAD else "■ ", style="dim" if old else _LIGHT_STYLE[light])
    cell.append(f"{printable(name):<15}", style="dim" if old else "")
    return cell.append(printable(text), style="dim")


def _events(vehicle: Vehicle) -> list[RenderableType]:
    lines: Sequence[EventLine] = vehicle.events.lines[-EVENTS_SHOWN:] if vehicle.events is not None else ()
    if vehicle.events is not None and vehicle.events.session != vehicle.session:
        lines = ()
    shown: list[RenderableType] = [Text()]
    for event in reversed(lines):
        text = Text().append(f"  t {event.t_s:7.2f} s  ", style="dim")
        shown.append(text.append(printable(event.text), style=_SEVERITY_STYLE.get(event.severity, "")))
    return shown


def _keys(station: StationStatus) -> Text:
    if station.view_only_reason is not None:
        return Text(f"q quit    view only: {printable(station.view_only_reason)}", style="dim")
    text = Text()
    for row in reversed([row for row in TABLE if row.safer]):
        style = "bold red" if row is TABLE[0] else "bold yellow"
        text.append(f"{row.key} ", style="bold").append(f"{row.command.value.upper()}   ", style=style)
    confirmed = "".join(f"{row.key} {row.command.value}   " for row in TABLE if not row.safer)
    return text.append(f"{confirmed}q quit    you are {station.operator}", style="dim")


def _autopilot(stream: Stream) -> str:
    if stream.armed is None:
        return "no PX4"
    landed = _MODE_LANDED.get(stream.landed or "", "")
    return ", ".join(
        part
        for part in (f"PX4 {printable(stream.mode or '?')}", "armed" if stream.armed else "disarmed", landed)
        if part
    )


def _figures(stream: Stream) -> list[str]:
    parts = []
    if stream.position_world_m is not None:
        x, y, z = stream.position_world_m
        parts.append(f"({x:+.2f} {y:+.2f} {z:.2f}) m")
    if stream.e_p_m is not None:
        parts.append(f"|e_p| {100 * stream.e_p_m:.1f} cm")
    if stream.e_q_deg is not None:
        parts.append(f"|e_q| {stream.e_q_deg:.1f} deg")
    if stream.tether is not None:
        parts.append(f"slack {stream.tether.slack_m:.2f} m")
    if stream.contact is not None:
        parts.append(
            f"{printable(stream.contact.mode)} {stream.contact.force_n:.1f} of {stream.contact.wanted_n:.1f} N"
        )
    if stream.ball is not None:
        in_s = stream.ball.meets_in_s
        parts.append("ball seen" if in_s is None else f"ball met in {in_s:.2f} s")
    if stream.battery_v is not None:
        left = "" if stream.battery_remaining is None else f" {100 * stream.battery_remaining:.0f} %"
        parts.append(f"battery {stream.battery_v:.1f} V{left}")
    return parts


def _timing(stream: Stream) -> str:
    """Return delays on the first line, durations of the parts of a tick on the second."""
    timing = stream.timing
    behind = {
        "late": timing.lateness_ms,
        "mocap": timing.mocap_age_ms,
        "mocap to setpoint": timing.mocap_to_setpoint_ms,
        "joint read to write": timing.joint_read_to_write_ms,
    }
    took = {"tick": timing.whole_ms, "core": timing.core_ms, "bus read": timing.bus_read_ms}
    lines = [[f"{name} {value:.1f} ms" for name, value in part.items() if value is not None] for part in (behind, took)]
    lines[1] += [f"missed {timing.missed}", f"lost records {timing.dropped}"]
    return "\n".join("   ".join(words) for words in lines)
