"""Verification of commands: every kind of message on the command topic, and the vehicle's verdict."""

from __future__ import annotations

import json
import sys
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from companion.ground.protocol.commands import (
    ACKS_PER_S,
    AHEAD_MAX_S,
    REFUSED_MAX,
    Accepted,
    Reason,
    Refused,
    Verdict,
    Verifier,
    canonical,
    make_command,
    sign,
)
from companion.ground.protocol.flight_clock import FlightClock
from companion.ground.protocol.keys import Operator, Operators, Permission, new_key
from companion.ground.protocol.messages import COMMAND_MAX_BYTES, Command
from companion.model.codec import to_json
from companion.model.commands import COMMANDS, TABLE
from companion.model.types import OperatorCommand

VEHICLE, SESSION, NOW_T_S = "tarot", "f3a9", 100.0
ANNA, BERT, VIEWER = new_key(), new_key(), new_key()
LIMITS = {row.command: row for row in TABLE}
OPERATORS = Operators([Operator("anna", ANNA), Operator("bert", BERT, Permission.SAFER_COMMANDS)], "operators.yaml")
SAFE = [OperatorCommand.HOLD, OperatorCommand.LAND, OperatorCommand.ABORT]
OTHERS = [OperatorCommand.RESUME, OperatorCommand.START]


def verifier() -> Verifier:
    return Verifier(OPERATORS, VEHICLE, SESSION)


def made(
    name: OperatorCommand = OperatorCommand.HOLD,
    t_s: float = NOW_T_S,
    operator: str = "anna",
    key: bytes = ANNA,
    vehicle: str = VEHICLE,
    session: str = SESSION,
) -> Command:
    return make_command(name, vehicle, session, operator, key, round(t_s * 1000))


def reason_of(verdict: Verdict) -> Reason | None:
    return None if isinstance(verdict, Accepted) else verdict.reason


def judged(
    payload: bytes, judge: Verifier | None = None, retained: bool = False, now_t_s: float = NOW_T_S
) -> Reason | None:
    """Return the reason for a refusal, or None; its text must be fit for a log and a terminal."""
    verdict = (judge or verifier()).check(payload, retained, now_t_s)
    if isinstance(verdict, Refused):
        assert verdict.text.isprintable()
        assert 0 < len(verdict.text) <= 200
    return reason_of(verdict)


def changed(of: Command, /, **values: Any) -> bytes:
    data = json.loads(to_json(of))
    data.update(values)
    return json.dumps(data).encode()


@pytest.mark.parametrize("name", COMMANDS.values())
def test_genuine_command_is_accepted_as_it_was_made(name: OperatorCommand) -> None:
    command = made(name)
    assert verifier().check(to_json(command), False, NOW_T_S) == Accepted(command)


def test_white_space_and_field_order_of_the_json_do_not_matter() -> None:
    """White space and field order are the sender's choice: the content is signed."""
    data = json.loads(to_json(made()))
    payload = json.dumps(dict(reversed(data.items())), indent=1).encode()
    assert judged(payload) is None


def test_signed_text_is_as_documented() -> None:
    command = Command(
        v=2,
        vehicle="tarot",
        session="f3a9",
        operator="anna",
        command=OperatorCommand.LAND,
        t_ms=12345,
        hold=0,
        nonce="0" * 32,
        mac="",
    )
    assert canonical(command) == b"companion command 2\n2\ntarot\nf3a9\nanna\nland\n12345\n0\n" + b"0" * 32 + b"\n"
    # Of the same text and key, made with: openssl dgst -sha256 -mac HMAC -macopt hexkey:00...
    assert sign(command, bytes(32)).mac == "e598626f77706359a361bb3d20eeb8c6234b9cf0c3e3bc221b90909535fc7354"


@pytest.mark.parametrize(
    "field", [name for name, hint in Command.__annotations__.items() if hint not in ("int", "OperatorCommand")]
)
def test_signed_fields_cannot_be_shifted_into_each_other(field: str) -> None:
    command = replace(made(), **{field: "a\nb"})
    if field == "mac":
        assert judged(to_json(command)) is Reason.MALFORMED
    else:
        with pytest.raises(ValueError, match=field):
            sign(command, ANNA)


UNSIGNED = {
    "unsigned": (changed(made(), mac=""), Reason.MALFORMED),
    "mac of another text": (changed(made(), mac="0" * 64), Reason.BAD_SIGNATURE),
    "mac missing": (
        json.dumps({k: v for k, v in json.loads(to_json(made())).items() if k != "mac"}).encode(),
        Reason.MALFORMED,
    ),
    "viewer signs as anna": (to_json(made(key=VIEWER)), Reason.BAD_SIGNATURE),
    "operator signs as another": (to_json(made(key=BERT)), Reason.BAD_SIGNATURE),
    "viewer signs as himself": (to_json(made(operator="viewer", key=VIEWER)), Reason.UNKNOWN_OPERATOR),
    "wrong vehicle": (to_json(made(vehicle="other")), Reason.WRONG_VEHICLE),
    "re-addressed": (changed(made(vehicle="other"), vehicle=VEHICLE), Reason.BAD_SIGNATURE),
    "hold made a start": (changed(made(), command="start"), Reason.BAD_SIGNATURE),
    "made fresh again": (changed(made(t_s=10.0), t_ms=100_000), Reason.BAD_SIGNATURE),
    "another nonce": (changed(made(), nonce="1" * 32), Reason.BAD_SIGNATURE),
    "brought into this session": (changed(made(session="old"), session=SESSION), Reason.BAD_SIGNATURE),
    "no command": (changed(made(), command="none"), Reason.MALFORMED),
    "no such command": (changed(made(), command="explode"), Reason.MALFORMED),
    "unknown field": (changed(made(), sudo=True), Reason.MALFORMED),
    "later version": (changed(made(), v=3), Reason.WRONG_VERSION),
    "very late version": (changed(made(), v=10**400), Reason.MALFORMED),
    "earlier version": (changed(made(), v=1), Reason.WRONG_VERSION),
    "version is true": (changed(made(), v=True), Reason.MALFORMED),
    "version is 1.0": (changed(made(), v=2.0), Reason.MALFORMED),
    "time is text": (changed(made(), t_ms="100000"), Reason.MALFORMED),
    "time is endless": (changed(made(), t_ms=10**400), Reason.MALFORMED),
    "time is NaN": (changed(made(), t_ms=float("nan")), Reason.MALFORMED),
    "hold is endless": (changed(made(), hold=10**400), Reason.MALFORMED),
    "hold is negative": (changed(made(), hold=-1), Reason.MALFORMED),
    "another hold": (changed(made(), hold=1), Reason.BAD_SIGNATURE),
    "a field twice": (to_json(made())[:-1] + b',"command":"start"}', Reason.MALFORMED),
    "a field twice, the same": (to_json(made())[:-1] + b',"v":2}', Reason.MALFORMED),
    "UTF-16": (to_json(made()).decode().encode("utf-16"), Reason.MALFORMED),
    "not UTF-8": (to_json(made()).replace(b"anna", b"an\xffa"), Reason.MALFORMED),
    "half a character": (changed(made(), operator="\ud800"), Reason.MALFORMED),
    "upper case mac": (changed(made(), mac="A" * 64), Reason.MALFORMED),
    "empty": (b"", Reason.MALFORMED),
    "null": (b"null", Reason.MALFORMED),
    "list": (b"[]", Reason.MALFORMED),
    "binary": (b"\x00\xff\xfe", Reason.MALFORMED),
    "terminal codes": (b'{"v":2,"\\u001b[2J\\n":1}', Reason.MALFORMED),
    "largest": (b" " * COMMAND_MAX_BYTES, Reason.MALFORMED),
    "oversized": (b" " * (COMMAND_MAX_BYTES + 1), Reason.OVERSIZED),
    "genuine but oversized": (to_json(made()) + b" " * COMMAND_MAX_BYTES, Reason.OVERSIZED),
}


@pytest.mark.parametrize(("payload", "reason"), UNSIGNED.values(), ids=UNSIGNED)
def test_refused_and_never_answered(payload: bytes, reason: Reason) -> None:
    verdict = verifier().check(payload, False, NOW_T_S)
    assert isinstance(verdict, Refused)
    assert (verdict.reason, verdict.command) == (reason, None)
    assert verdict.text.isprintable() and 0 < len(verdict.text) <= 200


def test_a_retained_command_is_refused_even_if_its_signature_is_valid() -> None:
    judge, payload = verifier(), to_json(made())
    assert judged(payload, judge, retained=True) is Reason.RETAINED
    assert judged(payload, judge) is Reason.REPLAYED
    assert judged(UNSIGNED["viewer signs as anna"][0], judge, retained=True) is Reason.BAD_SIGNATURE


def test_unsigned_floods_do_not_stop_a_genuine_command() -> None:
    """Whatever is sent without a key (garbage, copies, old or foreign commands), all commands of an operator pass."""
    judge = verifier()
    old = [to_json(made(t_s=NOW_T_S - 60.0)) for _ in range(50)]
    first = to_json(made(OperatorCommand.START))
    assert judged(first, judge) is None
    for number in range(2000):
        assert judged(first, judge) is Reason.REPLAYED
        assert judged(old[number % 50], judge) is Reason.STALE
        assert judged(first, judge, retained=True) is Reason.REPLAYED
        assert judged(UNSIGNED["viewer signs as anna"][0], judge) is Reason.BAD_SIGNATURE
    for name in COMMANDS.values():
        assert judged(to_json(made(name, NOW_T_S + 1.0)), judge, now_t_s=NOW_T_S + 1.0) is None


@pytest.mark.parametrize("name", COMMANDS.values())
def test_freshness_at_its_edges(name: OperatorCommand) -> None:
    age_max_s = LIMITS[name].age_max_s
    assert age_max_s == (5.0 if name in SAFE else 2.0)
    assert judged(to_json(made(name, NOW_T_S - age_max_s + 0.001))) is None
    assert judged(to_json(made(name, NOW_T_S - age_max_s - 0.001))) is Reason.STALE
    assert judged(to_json(made(name, NOW_T_S + AHEAD_MAX_S - 0.001))) is None
    assert judged(to_json(made(name, NOW_T_S + AHEAD_MAX_S + 0.001))) is Reason.FROM_THE_FUTURE


def first_refusal_is_the_end(reasons: list[Reason | None]) -> bool:
    """Check that a command is accepted at most once, and never after a refusal."""
    return None not in reasons[1:]


@given(
    st.lists(st.none() | st.floats(-200.0, 200.0), min_size=1, max_size=40),
    st.sampled_from(list(COMMANDS.values())),
    st.sampled_from([("anna", ANNA), ("bert", BERT)]),
    st.floats(-150.0, 150.0),
    st.data(),
)
def test_a_command_is_accepted_once_at_most_and_never_after_its_first_refusal(
    times_t_s: list[float | None], name: OperatorCommand, who: tuple[str, bytes], ahead_s: float, data: st.DataObject
) -> None:
    """Copies may arrive at any time: before the flight starts, retained, with clock steps in any order."""
    judge, payload = verifier(), to_json(made(name, NOW_T_S + ahead_s, *who))
    reasons = []
    for t_s in times_t_s:
        now_t_s = None if t_s is None else NOW_T_S + t_s
        reasons.append(reason_of(judge.check(payload, data.draw(st.booleans()), now_t_s)))
    assert first_refusal_is_the_end(reasons)


@settings(max_examples=12, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from(list(COMMANDS.values())), st.floats(-6.0, 90.0)), min_size=1, max_size=30),
    st.data(),
)
def test_none_of_many_commands_is_accepted_after_its_first_refusal(
    made_at: list[tuple[OperatorCommand, float]], data: st.DataObject
) -> None:
    """Many commands are sent repeatedly in any order, next to floods that leave no room for their nonces."""
    judge, now_t_s = verifier(), NOW_T_S
    payloads = [to_json(made(name, NOW_T_S + ahead_s)) for name, ahead_s in made_at]
    flood_s = data.draw(st.sampled_from([0.0, 40.0, 100.0]))
    floods = {name for name, _ in made_at}
    reasons: dict[bytes, list[Reason | None]] = {payload: [] for payload in payloads}
    for _ in range(data.draw(st.integers(1, 60))):
        now_t_s += data.draw(st.sampled_from([0.0, 0.01, 1.0, 10.0]))
        name = data.draw(st.sampled_from(list(COMMANDS.values())))
        for _ in range(REFUSED_MAX + 40 if name in floods else 0):
            judged(to_json(made(name, NOW_T_S + flood_s)), judge, now_t_s=now_t_s)
        floods.discard(name)
        payload = data.draw(st.sampled_from(payloads))
        reasons[payload].append(judged(payload, judge, now_t_s=now_t_s))
    for heard in reasons.values():
        assert first_refusal_is_the_end(heard)


def test_a_start_that_was_from_the_future_is_not_accepted_when_its_time_has_come() -> None:
    """A forged clock made an operator sign it; a copy is sent again 60 s later."""
    judge, payload = verifier(), to_json(made(OperatorCommand.START, NOW_T_S + 60.0))
    assert judged(payload, judge) is Reason.FROM_THE_FUTURE
    assert judged(payload, judge, now_t_s=NOW_T_S + 60.0) is Reason.REPLAYED


@pytest.mark.parametrize("stop", SAFE)
@pytest.mark.parametrize("name", OTHERS)
def test_a_resume_or_start_that_was_given_before_a_stop_is_refused_after_it(
    stop: OperatorCommand, name: OperatorCommand
) -> None:
    """The network may reorder them, and two operators may use different paths."""
    judge = verifier()
    assert judged(to_json(made(stop, NOW_T_S, "bert", BERT)), judge) is None
    assert judged(to_json(made(name, NOW_T_S - 0.5)), judge) is Reason.OVERTAKEN
    assert judged(to_json(made(name, NOW_T_S + 0.5)), judge, now_t_s=NOW_T_S + 0.5) is None


def test_clock_that_is_set_back_revives_nothing() -> None:
    judge, payload = verifier(), to_json(made())
    assert judged(payload, judge) is None
    assert judged(to_json(made(t_s=200.0)), judge, now_t_s=200.0) is None
    assert judged(payload, judge, now_t_s=NOW_T_S) is Reason.STALE


def test_command_of_an_earlier_flight_is_refused() -> None:
    assert judged(to_json(made(session="f3a8"))) is Reason.WRONG_SESSION


def test_operator_for_safety_only() -> None:
    for name in COMMANDS.values():
        expected = None if name in SAFE else Reason.NOT_ALLOWED
        assert judged(to_json(made(name, operator="bert", key=BERT))) is expected


@pytest.mark.parametrize("name", COMMANDS.values())
def test_rate_is_limited_per_command_and_operator(name: OperatorCommand) -> None:
    judge, per_s = verifier(), LIMITS[name].per_s
    assert per_s == (20 if name in SAFE else 1)
    for _ in range(per_s):
        assert judged(to_json(made(name)), judge) is None
    assert judged(to_json(made(name)), judge) is Reason.TOO_MANY
    for other in COMMANDS.values():
        if other is not name:
            assert judged(to_json(made(other)), judge) is None
    assert judged(to_json(made(OperatorCommand.HOLD, operator="bert", key=BERT)), judge) is None
    assert judged(to_json(made(name, NOW_T_S + 1.0)), judge, now_t_s=NOW_T_S + 1.0) is None


@pytest.mark.parametrize("flood", COMMANDS.values())
@pytest.mark.parametrize("ahead_s", [0.0, 60.0])
def test_a_flood_of_one_command_leaves_room_for_every_other(flood: OperatorCommand, ahead_s: float) -> None:
    """A defective client sends well-signed commands of one operator as fast as it can."""
    judge = verifier()
    for _ in range(2 * REFUSED_MAX):
        judged(to_json(made(flood, NOW_T_S + ahead_s)), judge)
    for name in COMMANDS.values():
        if name is not flood:
            assert judged(to_json(made(name, NOW_T_S + 0.1)), judge, now_t_s=NOW_T_S + 0.1) is None
    if not ahead_s:
        assert judged(to_json(made(flood, NOW_T_S + 1.1)), judge, now_t_s=NOW_T_S + 1.1) is None, "and for its own"


def test_a_flood_from_the_far_future_closes_its_own_dates_only() -> None:
    """Commands whose nonces were not kept are refused when their time comes; those for now or for later times are not."""
    judge, flood = verifier(), [to_json(made(t_s=NOW_T_S + 60.0)) for _ in range(REFUSED_MAX + 2)]
    for payload in flood:
        judged(payload, judge)
    for _ in range(30):
        judged(to_json(made()), judge)  # and too many now, without room for their nonces either
    for later_s in (1.1, 59.0, 61.0):
        t_s = NOW_T_S + later_s
        assert judged(to_json(made(t_s=t_s)), judge, now_t_s=t_s) is None
        for payload in (flood[0], flood[-1]):
            assert judged(payload, judge, now_t_s=t_s) is Reason.REPLAYED


def test_memory_is_bounded_and_forgets() -> None:
    judge = verifier()
    for number in range(3 * REFUSED_MAX):
        expected = None if number < 20 else Reason.TOO_MANY if number < 20 + REFUSED_MAX else Reason.REPLAYED
        if number == 20 + REFUSED_MAX:
            expected = Reason.TOO_MANY  # the first that finds no room: from now on their date is known
        assert judged(to_json(made()), judge) is expected
    assert max(heard.size for heard in judge._histories.values()) == 20 + REFUSED_MAX
    assert judged(to_json(made(operator="bert", key=BERT)), judge) is None, "another operator is not touched"
    assert judged(to_json(made(t_s=106.0)), judge, now_t_s=106.0) is None
    assert sum(heard.size for heard in judge._histories.values()) == 1


def test_answers_to_refused_signed_commands_are_rate_limited() -> None:
    judge = verifier()
    stale = made(t_s=0.0)
    answers = [judge.check(to_json(stale), False, NOW_T_S) for _ in range(1000)]
    assert {reason_of(answer) for answer in answers} == {Reason.STALE}
    assert [answer.command for answer in answers if isinstance(answer, Refused) and answer.command] == [
        stale
    ] * ACKS_PER_S
    again = judge.check(to_json(stale), False, NOW_T_S + 1.0)
    assert isinstance(again, Refused)
    assert again.command == stale


@given(st.data())
def test_any_changed_byte_is_refused(data: st.DataObject) -> None:
    payload = bytearray(to_json(made(data.draw(st.sampled_from(list(COMMANDS.values()))))))
    where = data.draw(st.integers(0, len(payload) - 1))
    payload[where] ^= data.draw(st.integers(1, 255))
    assert judged(bytes(payload)) is not None


@given(st.data())
def test_any_changed_byte_of_the_key_is_refused(data: st.DataObject) -> None:
    key = bytearray(ANNA)
    key[data.draw(st.integers(0, len(key) - 1))] ^= data.draw(st.integers(1, 255))
    assert judged(to_json(made(key=bytes(key)))) is Reason.BAD_SIGNATURE


SCALAR = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20)
JSON = SCALAR | st.lists(SCALAR, max_size=3) | st.dictionaries(st.text(max_size=10), SCALAR, max_size=3)


@given(st.binary(max_size=2000))
def test_random_bytes_are_refused(payload: bytes) -> None:
    assert judged(payload) is not None


@given(st.dictionaries(st.sampled_from(Command.__struct_fields__), JSON, max_size=8))
def test_random_json_in_our_fields_is_refused(values: dict[str, Any]) -> None:
    command = made()
    original = json.loads(to_json(command))
    unchanged = all(type(value) is type(original[name]) and value == original[name] for name, value in values.items())
    assert (judged(changed(command, **values)) is None) == unchanged


def test_deep_json_is_refused_at_every_depth() -> None:
    """At some depth, which depends on the interpreter, the parser succeeds but quoting the data does not."""
    limit = sys.getrecursionlimit()
    try:
        for allowed in (limit, 400):
            sys.setrecursionlimit(allowed)
            for depth in range(1, 490):
                nested = b"[" * depth + b"]" * depth
                assert judged(nested) is Reason.MALFORMED
                assert judged(b'{"v":2,"vehicle":' + nested + b"}") is Reason.MALFORMED
                assert judged(b'{"v":' + nested + b"}") is Reason.MALFORMED
                whole = changed(made(), vehicle=0).replace(b'"vehicle": 0', b'"vehicle": ' + nested)
                assert judged(whole) in (Reason.MALFORMED, Reason.OVERSIZED)
    finally:
        sys.setrecursionlimit(limit)


def test_flight_clock_follows_the_fastest_message() -> None:
    clock = FlightClock()
    assert clock.now_ms(50.0) is None
    clock.add(10.0, 50.0)
    assert clock.now_ms(50.0) == 10_000
    clock.add(10.0, 53.0)  # three seconds late: the clock is not set back
    assert clock.now_ms(53.0) == 13_000
    clock.add(13.5, 53.25)
    assert clock.now_ms(53.25) == 13_500
    assert clock.now_ms(60.25) == 20_500, "it goes on when nothing is heard"


@pytest.mark.parametrize("paces", [[0.1], [0.4], [1.0], [3.0], [1.0, 0.0, 0.1], [0.01, 5.0]], ids=str)
def test_all_listeners_agree_on_simulated_time_at_any_pace(paces: list[float]) -> None:
    """A command of a flight slower than real time was called stale, or older than one that another program had given before."""
    vehicle, ground, fresh = FlightClock(), FlightClock(), FlightClock()
    now_s = t_s = 0.0
    for pace in paces:
        for k in range(2000):
            now_s, t_s = now_s + 0.01, t_s + 0.01 * pace
            vehicle.add(t_s, now_s)
            if k % 5 == 0:
                ground.add(t_s, now_s + 0.02)
            if k % 5 == 0 and k > 1900:
                fresh.add(t_s, now_s + 0.02)
        for clock in (vehicle, ground, fresh):
            estimate_s = clock.now_s(now_s + 3.0, simulated=True)  # it stands still while a busy computer is silent
            assert estimate_s is not None and t_s - 0.051 * pace <= estimate_s <= t_s


def test_flight_clock_forgets_what_was_long_ago() -> None:
    """A vehicle's clock that runs slower than the local one is followed."""
    clock = FlightClock()
    for number in range(4000):
        clock.add(number * 0.999, float(number))
    now_ms = clock.now_ms(3999.0)
    assert now_ms is not None
    assert 3999 * 999 <= now_ms <= 3999 * 999 + 11
    assert len(clock._samples) <= FlightClock.WINDOW_S + 1


@given(st.lists(st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 3.0)), min_size=1, max_size=100))
def test_flight_clock_is_never_early_and_no_later_than_the_fastest(steps: list[tuple[float, float]]) -> None:
    clock, now_s, sent = FlightClock(), 0.0, []
    for step_s, delay_s in steps:
        now_s += step_s
        sent.append((now_s, delay_s))
        clock.add(now_s - delay_s, now_s)
    fastest_s = min(delay_s for at_s, delay_s in sent if at_s >= now_s - FlightClock.WINDOW_S)
    now_ms = clock.now_ms(now_s)
    assert now_ms is not None
    assert abs(now_ms / 1000.0 - (now_s - fastest_s)) < 0.002
