"""Which silence of the other vehicle matters: what each of the two has in its clamp decides. And with whom no vehicle takes off."""

from __future__ import annotations

from typing import Any

import pytest
from msgspec.structs import replace

from companion.model.team import Grip, PartnerState
from companion.safety.flight_context import FlightContext
from companion.safety.team import TeamTracker, partner_late, partner_quiet, partner_silent, strangers
from tests.safety.healthy import healthy, with_partner

TIMEOUT_S = 0.3


def fired(own: tuple[Grip, ...], other: Grip | None) -> tuple[bool, bool, bool]:
    """Whether the rules quiet, silent and late fire after the other vehicle, with `other` in its clamp, was last heard 1 s ago."""
    tracker, heard = TeamTracker(), with_partner(healthy())
    assert heard.partner is not None
    old = replace(heard.partner.said, grip=other or Grip.FREE, server_s=8.0)
    partner = None if other is None else PartnerState(stamp_s=heard.partner.stamp_s, said=old)
    for n, grip in enumerate(own):
        last = n == len(own) - 1
        tracker.update(replace(heard, partner=partner), FlightContext(True, True, 0.0, grip=grip), 2.0 if last else 1.0)
    rules = partner_quiet, partner_silent, partner_late
    quiet, silent, late = (rule(tracker, TIMEOUT_S) is not None for rule in rules)
    return quiet, silent, late


@pytest.mark.parametrize("own", [Grip.READY, Grip.CARRYING, Grip.STANDING])
@pytest.mark.parametrize("other", [Grip.READY, Grip.CARRYING, Grip.STANDING])
def test_silence_and_late_words_matter_while_both_hold_the_bar(own: Grip, other: Grip) -> None:
    assert fired((own, own), other) == (False, True, True)


def test_a_partner_that_has_let_the_standing_bar_go_may_end_its_flight() -> None:
    assert fired((Grip.STANDING, Grip.STANDING), Grip.FREE) == (False, False, False)
    assert fired((Grip.STANDING, Grip.FREE), Grip.FREE) == (False, False, False)


@pytest.mark.parametrize("own", [Grip.FREE, Grip.READY])
def test_before_both_hold_the_bar_silence_is_a_warning(own: Grip) -> None:
    assert fired((own, own), Grip.FREE) == (True, False, False)


def test_a_partner_that_was_never_heard_is_silent() -> None:
    assert fired((Grip.FREE, Grip.FREE), None) == (True, False, False)
    assert fired((Grip.CARRYING, Grip.CARRYING), None) == (False, True, False)


@pytest.mark.parametrize(
    ("said", "found"),
    [
        ({}, []),
        ({"agreed": "of other files"}, ["copy the team's files to both computers"]),
        ({"agreed": None}, ["copy the team's files to both computers"]),
        ({"system_id": 1}, ["PX4 of the other vehicle has MAV_SYS_ID 1, too"]),
        ({"system_id": None}, []),
        ({"server_s": 9.1}, []),
        ({"server_s": 8.0}, ["motion capture's clock shows 10.0 s here and 8.0 s at the other vehicle"]),
        ({"server_s": 12.0}, ["motion capture's clock shows 10.0 s here and 12.0 s at the other vehicle"]),
        ({"server_s": None}, []),
        ({"agreed": "x", "system_id": 1}, ["copy the team's files", "MAV_SYS_ID 1"]),
    ],
)
def test_a_member_with_other_files_the_same_system_id_or_another_clock_does_not_take_off(
    said: dict[str, Any], found: list[str]
) -> None:
    i = with_partner(healthy())
    assert i.partner is not None and i.mocap is not None and i.status is not None
    heard = {"agreed": "files", "system_id": 2, "server_s": 10.0, **said}
    i = replace(
        i,
        status=replace(i.status, system_id=1),
        mocap=replace(i.mocap, exposure_server_s=10.0),
        partner=replace(i.partner, said=replace(i.partner.said, **heard)),
    )
    lines = strangers(i, "files")
    assert len(lines) == len(found)
    assert all(text in line and "\n" not in line for text, line in zip(found, lines, strict=True))
    assert strangers(replace(i, partner=None), "files") == []
