"""The phase keeps the contract of every phase, and finds the payload's mass."""

from pathlib import Path

from companion.testing import check_phases
from sitl.testing import check_flight

MISSION = Path(__file__).with_name("weigh.yaml")


def test_it_keeps_the_contract() -> None:
    check_phases(MISSION)


def test_it_finds_the_mass() -> None:
    weighed = [event.text for event in check_flight(MISSION, "world.payload_kg=0.2") if event.id == "weighed"]
    assert weighed == ["the payload weighs 0.20 kg"]
