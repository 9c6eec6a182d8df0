"""One flight's telemetry session: packets of the flight become messages, payloads from the ground become commands. No I/O.

Times are CLOCK_MONOTONIC, which all processes share; the ticks relate it to the flight clock.
"""

from __future__ import annotations

import json
import math
from collections import deque
from dataclasses import dataclass, field

from msgspec.structs import replace

from companion.config.ground import topic_name
from companion.config.loader import FlightConfig
from companion.ground.protocol.commands import Accepted, Verifier
from companion.ground.protocol.flight_clock import FlightClock
from companion.ground.protocol.messages import (
    VERSION,
    Ack,
    Command,
    Preflight,
    PreflightRow,
    Presence,
    State,
    Topic,
)
from companion.ground.protocol.proof import with_proof, with_proofs
from companion.ground.telemetry.scene import scene_of
from companion.ground.telemetry.stream import StreamBuilder, truncated
from companion.model.codec import to_json
from companion.model.packets import Close, CommandAnswer, LogLine, Metadata, Tick, read_packet
from companion.model.types import Outcome, SafetyAction

SILENT_S = 0.5
"""Time without a tick after which the vehicle is reported as silent."""
STATE_PERIOD_S = 2.0
"""Period at which the retained state is published again, to replace a state from another client or an old last will."""
REFUSAL_PERIOD_S = 1.0
"""Period in which refused commands with the same reason are reported only once."""
WARNING, INFO = "warning", "info"
_SILENT = "the flight process sends nothing; if the vehicle is in the air, the guardian lands it"
_LOST = "the flight process or its recorder ended without notice; if the vehicle is in the air, the guardian lands it"


@dataclass(slots=True)
class _Refusals:
    """Refused commands with the same reason."""

    count: int = 0
    text: str = ""
    reported_s: float = -math.inf


@dataclass(slots=True)
class Outgoing:
    """Messages to send now."""

    retained: dict[Topic, bytes] = field(default_factory=dict)
    acks: list[bytes] = field(default_factory=list)
    stream: bytes | None = None
    log: list[tuple[float, str, str]] = field(default_factory=list)
    """Lines for the log's `/log` channel: flight clock, severity, text."""


class TelemetrySession:
    """Builds the messages of one flight and verifies commands.

    Args:
        session: random id of this flight.
        verifier: verifies commands; None if commands are not accepted.
        no_commands: why commands are not accepted.
    """

    def __init__(
        self,
        config: FlightConfig,
        session: str,
        *,
        simulated: bool,
        verifier: Verifier | None,
        no_commands: str | None = None,
    ) -> None:
        self.vehicle = topic_name(config.vehicle.ground.topic, config.vehicle.name)
        self._config = config
        self._verifier = verifier
        self._stream = StreamBuilder(config, session)
        self._clock = FlightClock()
        self._tick_s: float | None = None
        """CLOCK_MONOTONIC of the newest tick."""
        self._new_ticks = False
        self._outcome: Outcome | None = None
        self.over = False
        """Whether the flight has ended."""
        self._packet_error: str | None = None
        """Error of the first malformed packet (a bug); empty once it has been reported."""
        self._refusals: dict[str, _Refusals] = {}
        self._acks: deque[Ack] = deque(maxlen=200)
        self._log: deque[tuple[float, str, str]] = deque(maxlen=200)
        self._state = State(
            v=VERSION,
            vehicle=self.vehicle,
            session=session,
            presence=Presence.FLYING,
            simulated=simulated,
            mission=config.mission.name,
            law=config.controller.law,
            preset=config.controller.preset,
            wall_s=0.0,
            commands=False,
            text=no_commands,
        )
        self._no_commands = no_commands
        self._state_sent_s = -math.inf
        self._scene = scene_of(config, session)
        self._preflight = Preflight(VERSION, session, ())
        self._events_sent = -1
        self._changed = {Topic.SCENE, Topic.PREFLIGHT}
        self.refused = 0

    @property
    def session(self) -> str:
        """Session id of this flight."""
        return self._state.session

    @property
    def accepts_commands(self) -> bool:
        """Whether commands are verified and forwarded."""
        return self._verifier is not None

    def flight_s(self, now_s: float) -> float | None:
        """Return the flight clock at a CLOCK_MONOTONIC time, or None before the first tick."""
        return self._clock.now_s(now_s, self._state.simulated)

    def last_will(self) -> bytes:
        """Return the state that the broker publishes if this process disappears."""
        text = "the connection to the vehicle was lost"
        return to_json(replace(self._state, presence=Presence.LOST, wall_s=0.0, commands=False, text=text))

    def take_packet(self, received_s: float, data: bytes) -> None:
        """Process one packet of the flight's or the guardian's channel. Never raises: the log has the packet in any case."""
        try:
            match packet := read_packet(data):
                case Tick():
                    self._tick(received_s, packet)
                case LogLine():
                    self._stream.add_line(packet.t_s, packet.severity.value, packet.source, packet.text)
                case CommandAnswer():
                    self._answered(packet)
                case Metadata():
                    self._metadata(packet.name, packet.values)
                case Close():
                    self.end(normally=True)
        except (ValueError, TypeError, LookupError, AttributeError, OverflowError) as error:
            self._packet_error = self._packet_error or f"telemetry: malformed packet: {type(error).__name__}: {error}"

    def notify(self, now_s: float, severity: str, text: str, *, event: bool = True) -> None:
        """Add a line about the telemetry itself to the log and, if `event`, to the list of events."""
        t_s = self.flight_s(now_s) or 0.0
        self._log.append((t_s, severity, text))
        if event:
            self._stream.add_line(t_s, severity, "ground", text)

    def set_commands_available(self, available: bool, why_not: str | None = None) -> None:
        """Set whether the broker delivers commands, and if not, why."""
        if self._verifier is not None:
            self._no_commands = None if available else why_not
            self._set_state(commands=available)

    def receive_command(self, payload: bytes, retained: bool, now_s: float) -> Command | None:
        """Verify a payload of the command topic; return the command if it is accepted."""
        if self._verifier is None or self.over:
            return None
        verdict = self._verifier.check(payload, retained, self.flight_s(now_s))
        if isinstance(verdict, Accepted):
            return verdict.command
        self._count_refusal(verdict.reason.value, verdict.text)
        if verdict.command is not None:
            self.reject(verdict.command, f"refused: {verdict.text}", now_s)
        return None

    def reject(self, command: Command, text: str, now_s: float) -> None:
        """Queue a negative acknowledgement for a command with a valid signature that is not executed."""
        newest, t_s = self._stream.newest_outputs, self.flight_s(now_s) or 0.0
        phase, action = ("", SafetyAction.NOMINAL) if newest is None else (newest.phase, newest.action)
        self._answered(
            CommandAnswer(
                number=0, nonce=command.nonce, operator=command.operator, command=command.command, accepted=False, text=text,
                t_s=t_s, phase=phase, action=action,
            )
        )  # fmt: skip

    def end(self, *, normally: bool) -> None:
        """End the session after the last tick.

        Args:
            normally: True if the flight ended normally, False if its process died.
        """
        if self.over:
            return
        self.over = True
        outcome = self._outcome.value if self._outcome is not None else None
        if normally:
            self._set_state(presence=Presence.ENDED, commands=False, outcome=outcome, text=None)
        else:
            self._set_state(presence=Presence.LOST, commands=False, outcome=outcome, text=_LOST)

    def collect(self, now_s: float, wall_s: float, *, dropped: int = 0, recorder_error: str | None = None) -> Outgoing:
        """Return the messages that are new since the last call.

        Args:
            now_s: CLOCK_MONOTONIC.
            wall_s: seconds since 1970.
            dropped: number of records that the recorder has lost.
            recorder_error: why recording stopped, or None.
        """
        self._presence(now_s)
        self._report_refusals(now_s)
        if self._packet_error:
            self.notify(now_s, WARNING, self._packet_error)
            self._packet_error = ""  # not None: reported
        out = Outgoing()
        if now_s - self._state_sent_s >= STATE_PERIOD_S:
            self._state_sent_s = now_s
            self._state = replace(self._state, wall_s=round(wall_s, 3))
            out.retained[Topic.STATE] = to_json(self._state)
        for topic, record in ((Topic.SCENE, self._scene), (Topic.PREFLIGHT, self._preflight)):
            if topic in self._changed:
                out.retained[topic] = to_json(record)
        self._changed.clear()
        if self._events_sent != self._stream.count:
            self._events_sent = self._stream.count
            out.retained[Topic.EVENTS] = to_json(self._stream.events_message())
        if self._new_ticks:
            self._new_ticks = False
            stream = self._stream.build(wall_s, dropped=dropped, recorder_error=recorder_error)
            keys = self._verifier.operators.keys if self._verifier is not None else ()
            out.stream = to_json(with_proofs(stream, self.vehicle, keys))
        out.acks = [to_json(self._proven(ack)) for ack in self._acks]
        self._acks.clear()
        out.log = list(self._log)
        self._log.clear()
        return out

    def _tick(self, received_s: float, tick: Tick) -> None:
        inputs, outputs = tick.inputs, tick.outputs
        self._stream.add_tick(inputs, outputs, tick.sent)
        self._new_ticks = True
        self._tick_s = received_s
        if math.isfinite(inputs.t_s):
            self._clock.add(inputs.t_s, received_s)
        if outputs.outcome is not None:
            self._outcome = outputs.outcome

    def _answered(self, of: CommandAnswer) -> None:
        self._acks.append(
            Ack(
                v=VERSION, session=self.session, nonce=of.nonce, operator=of.operator, command=of.command, accepted=of.accepted,
                text=of.text, t_s=of.t_s, phase=of.phase, action=of.action.value, proof="",
            )
        )  # fmt: skip

    def _proven(self, ack: Ack) -> Ack:
        key = self._verifier.operators.find_key(ack.operator) if self._verifier is not None else None
        return ack if key is None else with_proof(ack, self.vehicle, key)

    def _metadata(self, name: str, values: dict[str, str]) -> None:
        if name == "plan":
            path = [(float(x), float(y), float(z)) for x, y, z in json.loads(values["json"])]
            self._scene = scene_of(self._config, self.session, path, mission_s=float(values["mission_s"]))
            self._changed.add(Topic.SCENE)
        elif name == "preflight":
            rows = [
                PreflightRow(str(row["id"]), str(row["level"]), truncated(str(row["text"])))
                for row in json.loads(values["json"])
            ]
            self._preflight = Preflight(VERSION, self.session, tuple(rows))
            self._changed.add(Topic.PREFLIGHT)

    def _presence(self, now_s: float) -> None:
        if self.over:
            return
        if self._tick_s is None:
            self._tick_s = now_s  # first call: ticks are expected from now on
        silent = now_s - self._tick_s > SILENT_S
        text = _SILENT if silent else self._no_commands
        self._set_state(presence=Presence.SILENT if silent else Presence.FLYING, text=text)

    def _set_state(self, **values: object) -> None:
        state = replace(self._state, **values)
        if state != self._state:
            self._state = state
            self._state_sent_s = -math.inf

    def _count_refusal(self, reason: str, text: str) -> None:
        refusals = self._refusals.setdefault(reason, _Refusals())
        self.refused += 1
        refusals.count += 1
        refusals.text = text

    def _report_refusals(self, now_s: float) -> None:
        """Report the first refusal for each reason at once and count the following ones, so that an attack does not flood the log."""
        for reason, refusals in self._refusals.items():
            if not refusals.count or now_s - refusals.reported_s < REFUSAL_PERIOD_S:
                continue
            commands = "a command" if refusals.count == 1 else f"{refusals.count} commands in the last second"
            text = f"refused {commands}: {reason}: {refusals.text}"
            refusals.count, refusals.reported_s = 0, now_s
            t_s = self.flight_s(now_s) or 0.0
            self._log.append((t_s, WARNING, text))
            self._stream.add_line(t_s, WARNING, f"command_refused_{reason}", text, replace_last=True)
