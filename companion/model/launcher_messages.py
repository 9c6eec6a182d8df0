"""Messages between the launcher and the processes that it starts: one union per channel. The display shows all of them."""

from __future__ import annotations

from typing import Any

import msgspec

from companion.model.check_row import Row
from companion.model.codec import Record
from companion.model.types import Event, OperatorCommand, Outcome, PhaseKind, SafetyAction, Severity, Vec3


class Status(Record, frozen=True, kw_only=True, tag=True):
    """State of the flight, ten times a second."""

    mission_t_s: float
    phase: str
    kind: PhaseKind
    progress: float
    """Share of the mission, 0 to 1."""
    action: SafetyAction
    error_m: float | None
    """Length of the position error; None without control, as is the position."""
    position_world_m: Vec3 | None
    lateness_s: float


class FlightEvent(Record, frozen=True, kw_only=True, tag=True):
    """An event of the flight process or of the guardian."""

    tick: int
    t_s: float
    """Flight clock."""
    mission_t_s: float
    id: str
    severity: Severity
    action: SafetyAction
    text: str

    @staticmethod
    def of(event: Event, tick: int, mission_t_s: float) -> FlightEvent:
        """Return the message about an event."""
        return FlightEvent(tick=tick, mission_t_s=mission_t_s, **msgspec.structs.asdict(event))

    @property
    def ends_flight(self) -> bool:
        """Whether the event is critical or has led to a landing."""
        return self.severity is Severity.CRITICAL or self.action.rank >= SafetyAction.LAND.rank

    def for_summary(self) -> dict[str, Any]:
        """Return the event in the format of summary.json."""
        about = {"id": self.id, "severity": self.severity.value, "action": self.action.value, "text": self.text}
        return {"t_s": self.t_s, "mission_t_s": self.mission_t_s, **about}


class PreflightProgress(Record, frozen=True, tag=True):
    """What the preflight does now, and the share of it that is done, 0 to 1."""

    text: str
    share: float


class PreflightDone(Record, frozen=True, tag=True):
    """Result of the preflight."""

    rows: tuple[Row, ...]


class Started(Record, frozen=True, kw_only=True, tag=True):
    """The flight begins: devices are open and the recorder runs."""

    recorder_pid: int
    realtime: str
    """What the operating system grants for precise timing."""
    simulated: bool
    """Whether the flight lives in simulated time."""


class RefusedFlight(Record, frozen=True, tag=True):
    """The flight process refuses the flight; nothing was armed."""

    lines: tuple[str, ...]
    device_failed: bool = False


class Px4Text(Record, frozen=True, tag=True):
    """A warning or error of PX4."""

    text: str


class GroundText(Record, frozen=True, tag=True):
    """State of the link to ground stations."""

    text: str | None


class CommandDone(Record, frozen=True, kw_only=True, tag=True):
    """A command from the ground, and its effect or why it was refused."""

    mission_t_s: float
    operator: str
    command: OperatorCommand
    accepted: bool
    text: str


class HandedOver(Record, frozen=True, tag=True):
    """The flight process is alive while PX4 lands by itself."""


class Recorded(Record, frozen=True, tag=True):
    """What the recorder has written."""

    samples: int
    dropped: int
    error: str | None


class FlightEnded(Record, frozen=True, tag=True):
    """Last message of the flight process."""

    outcome: Outcome
    recorded: Recorded | None = None


class TookOver(Record, frozen=True, tag=True):
    """First message of a guardian that takes over: whether the flight process hangs, else it has died or ended its flight."""

    hangs: bool


class GuardianStatus(Record, frozen=True, tag=True):
    """The guardian is landing, twice a second."""


class GuardianEnded(Record, frozen=True, tag=True):
    """Last message of a guardian that has taken over."""

    landed: bool
    overturned: bool


class Unreadable(Record, frozen=True, tag=True):
    """Takes the place of a message that is too long or malformed, which is a bug."""

    text: str


class Land(Record, frozen=True, tag=True):
    """To the flight process: land."""


class WorldReady(Record, frozen=True, tag=True):
    """The simulated world answers on all wires."""

    devices: dict[str, dict[str, Any]]
    """Settings of each simulated device that replace those of the vehicle file."""
    flight_environment: dict[str, str]
    """Environment variables of the flight process."""


class WorldEvent(Record, frozen=True, tag=True):
    """What happened in the world at a simulated time: `missed`, `crashed`, ..."""

    kind: str
    t_s: float


class WorldProgress(Record, frozen=True, tag=True):
    """A line for the user while the world starts."""

    text: str


class WorldSlipped(Record, frozen=True, tag=True):
    """A world in real time has paused because the computer is busy: seconds in all."""

    slipped_s: float


class WorldAtRest(Record, frozen=True, tag=True):
    """Whether the rotors stand still."""

    at_rest: bool


class WorldEnded(Record, frozen=True, tag=True):
    """Last message of the world: what it knows about the flight, for summary.json."""

    world: dict[str, Any]


class WorldFailed(Record, frozen=True, tag=True):
    """The world cannot start, or PX4 failed."""

    text: str


class Pace(Record, frozen=True, tag=True):
    """Of the launcher: simulated seconds in a second, and how many are wanted."""

    factor: float
    speed: float


class Busy(Record, frozen=True, tag=True):
    """Of the launcher: a busy computer may have caused an event."""

    text: str


FlightMessage = (
    Status
    | FlightEvent
    | PreflightProgress
    | PreflightDone
    | Started
    | RefusedFlight
    | Px4Text
    | GroundText
    | CommandDone
    | HandedOver
    | FlightEnded
    | Unreadable
)
GuardianMessage = TookOver | FlightEvent | GuardianStatus | GuardianEnded | Unreadable
WorldMessage = WorldReady | WorldEvent | WorldProgress | WorldSlipped | WorldAtRest | WorldEnded | WorldFailed
Message = FlightMessage | GuardianMessage | Land
AnyMessage = Message | WorldMessage | Pace | Busy
