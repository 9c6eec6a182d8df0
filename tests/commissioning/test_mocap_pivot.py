"""`companion mocap pivot`: the error of the tip from probes of known surfaces."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from companion.commissioning.mocap.pivot import Probed, TooAlike, tip_off_m
from companion.config.loader import load_flight
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_REFUSED
from tests.commands import companion, refused

LEAN = math.radians(15.0)
WALL, LEANED = (-1.0, 0.0, 0.0), (-math.cos(LEAN), 0.0, math.sin(LEAN))
OFF_M = (0.012, -0.007, 0.02)


def probed(normal: tuple[float, float, float], yaw_deg: float) -> Probed:
    """The tip is believed to be OFF_M, body frame, beside its place."""
    yaw = math.radians(yaw_deg)
    x, y, z = OFF_M
    world = (math.cos(yaw) * x - math.sin(yaw) * y, math.sin(yaw) * x + math.cos(yaw) * y, z)
    return Probed(normal, yaw, sum(a * b for a, b in zip(normal, world, strict=True)))


def test_three_probes_give_the_error_of_the_tip() -> None:
    assert tip_off_m([probed(WALL, 15.0), probed(WALL, -15.0), probed(LEANED, 0.0)]) == pytest.approx(OFF_M)


def test_more_probes_than_three_are_averaged() -> None:
    probes = [probed(WALL, 15.0), probed(WALL, -15.0), probed(LEANED, 0.0)]
    beside = Probed(LEANED, 0.0, probes[2].off_m + 0.002)
    assert tip_off_m([*probes, beside])[2] == pytest.approx(OFF_M[2] + 0.001 / math.sin(LEAN))


def test_normals_in_two_directions_do_not_give_it() -> None:
    with pytest.raises(TooAlike):
        tip_off_m([probed(WALL, 15.0), probed(WALL, -15.0), probed(WALL, 0.0)])


def flown(folder: Path, yaw_deg: float, normal: tuple[float, float, float]) -> str:
    """Write the folder of a flight that probed a surface through (1.5, 0, 1) with this normal."""
    folder.mkdir()
    config = load_flight("probe", overrides=[f"mission.start.yaw_deg={yaw_deg}"])
    (folder / "config.json").write_text(config.model_dump_json())
    off_m = probed(normal, yaw_deg).off_m
    point = [1.5 + off_m * normal[0], 0.0, 1.0 + off_m * normal[2]]
    (folder / "summary.json").write_text(json.dumps({"contact": {"surface": {"point_m": point, "normal": normal}}}))
    return str(folder)


@pytest.fixture
def flights(tmp_path: Path) -> list[str]:
    return [
        flown(tmp_path / "left", 15.0, WALL),
        flown(tmp_path / "right", -15.0, WALL),
        flown(tmp_path / "leaned", 0.0, LEANED),
    ]


VERTICAL = "--plane=1.5,0,1,-1,0,0"
PLANES = [VERTICAL, VERTICAL, f"--plane=1.5,0,1,{LEANED[0]},0,{LEANED[2]}"]


def test_the_command_prints_how_to_move_the_pivot(flights: list[str]) -> None:
    out = companion("mocap", "pivot", *flights, *PLANES, code=EXIT_REFUSED).out
    assert "24.4 mm off" in out
    assert "move the pivot by -12.0 mm forward, +7.0 mm to the left and -20.0 mm up" in out
    found = json.loads(companion("mocap", "pivot", *flights, *PLANES, "--json", code=EXIT_REFUSED).out)
    assert found["pivot_move_mm"] == pytest.approx([-12.0, 7.0, -20.0])


def test_a_pivot_that_is_right_is_ok(flights: list[str]) -> None:
    planes = []
    for flight, normal in zip(flights, (WALL, WALL, LEANED), strict=True):
        surface = json.loads((Path(flight) / "summary.json").read_text())["contact"]["surface"]
        planes.append("--plane=" + ",".join(map(str, (*surface["point_m"], *normal))))
    assert "0.0 mm off" in companion("mocap", "pivot", *flights, *planes).out


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["left", "right", VERTICAL], "expected 3 or more flights, got 2"),
        (["left", "right", "leaned", VERTICAL, VERTICAL], "--plane: expected once for all flights, or once for each of the 3, got 2"),
        (["left", "right", "none", VERTICAL], "none: expected the folder of a flight, with its summary.json and config.json"),
        (["left", "right", "left", VERTICAL], "normals, seen from the vehicle, do not point in three directions: turn the nose"),
        (["left", "right", "hover", VERTICAL], "hover: expected a flight with a phase `probe` that found a surface"),
        (["left", "right", "leaned", "--plane=1,2,3"], "expected six numbers X,Y,Z,NX,NY,NZ"),
        (["left", "right", "leaned", "--plane=1,2,3,0,0,0"], "a normal that is not zero, got '1,2,3,0,0,0'"),
    ],
)  # fmt: skip
def test_flights_that_cannot_be_used_are_refused_in_one_line(
    flights: list[str], tmp_path: Path, words: list[str], expected: str
) -> None:
    hover = tmp_path / "hover"
    hover.mkdir()
    (hover / "config.json").write_text(load_flight("hover").model_dump_json())
    (hover / "summary.json").write_text('{"contact": null}')
    given = [word if word.startswith("--") else str(tmp_path / word) for word in words]
    assert expected in refused(EXIT_BAD_INPUT, "mocap", "pivot", *given)
