"""The animation of a flight: what it shows when, and how it is written."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from PIL import Image, ImageSequence

from companion.analysis.animation import FRAMES_PER_S, Movie, movie_of, player_html, write_gif
from companion.analysis.log import FlightLog
from companion.analysis.scene import BALL, FRONT, NET, ROTOR, TETHER, Camera, Pose, Scene
from companion.config.loader import load_vehicle
from companion.control.arm_model import manipulator_of
from companion.model.frames import quat_from_euler_zyx, quat_rotate
from companion.model.markers import BallState
from companion.model.types import Joints
from tests.analysis.synthetic_flight import CATCH_S, CONFIG, log_of_rows, synthetic_flight
from tests.ground.page_browser import chromium
from tests.support import ROOT

VEHICLE = load_vehicle(ROOT / "configs/vehicles/tarot650_2r.yaml")
SIMULATED = {"payload_kg": 0.2, "world": {"throw_velocity_m_s": [-2.0, 0.15, -1.5]}}


def flown(phase: str | None = None) -> FlightLog:
    rows = ((i, replace(o, phase=phase or o.phase), s) for i, o, s in synthetic_flight(rate_hz=50.0))
    return log_of_rows(rows, {**CONFIG, "vehicle": json.loads(VEHICLE.model_dump_json())})


@pytest.fixture(scope="module")
def movie() -> Movie:
    made = movie_of(flown(), SIMULATED)
    assert made is not None
    return made


def texts(movie: Movie) -> list[list[str]]:
    return [[shape.text for shape in frame.shapes if shape.text] for frame in movie.frames]


def test_every_rotor_of_a_hexacopter_is_drawn() -> None:
    vehicle = json.loads(VEHICLE.model_dump_json())
    vehicle["airframe"]["layout"] = "hexa_x"
    camera = Camera(np.zeros(3), 0.3, 0.3, 4.0, (400.0, 300.0))
    pose = Pose((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0), (1.5, 1.5), (), False)
    disks = [shape.colour for shape in Scene(vehicle).shapes(camera, pose) if shape.alpha == 0.45]
    assert sorted(disks) == sorted([FRONT] * 2 + [ROTOR] * 4)


def test_the_payload_is_thrown_and_then_caught(movie: Movie) -> None:
    shown = [next((t.rpartition(", ")[2] for t in frame if "0.2 kg payload" in t), "") for frame in texts(movie)]
    assert [text for k, text in enumerate(shown) if k == 0 or text != shown[k - 1]] == ["", "thrown", "caught", ""]
    times = [float(text[4:-2]) for frame in texts(movie) for text in frame if text.startswith("t = ")]
    assert times[shown.index("caught")] == pytest.approx(CATCH_S, abs=0.05)
    assert shown[movie.still] == "thrown"
    assert times == sorted(times)
    assert 8.0 < len(times) / FRAMES_PER_S < 13.0


def test_a_ball_that_was_seen_is_drawn_where_it_was_and_the_net_where_they_meet() -> None:
    """Slowly, although it was missed."""
    ball = BallState(position_world_m=(1.0, 0.0, 1.0), meeting_world_m=(0.3, 0.0, 0.8), meeting_s=7.0)
    rows = (
        (i, replace(o, ball=ball if 6.0 < o.mission_t_s < 6.4 else None, events=()), s)
        for i, o, s in synthetic_flight(rate_hz=50.0)
    )
    made = movie_of(log_of_rows(rows, {**CONFIG, "vehicle": json.loads(VEHICLE.model_dump_json())}), SIMULATED)
    assert made is not None
    drawn = [[shape for shape in frame.shapes if shape.colour == BALL and not shape.text] for frame in made.frames]
    shown = [k for k, shapes in enumerate(drawn) if shapes]
    assert shown == list(range(shown[0], shown[-1] + 1)) and made.still in shown
    assert sum(shape.alpha == 0.12 for shape in drawn[shown[1]]) == 3, "the net, by three circles"
    assert all("¼ speed" in texts(made)[k] for k in shown)


def test_without_a_simulated_throw_the_payload_appears_in_the_net() -> None:
    made = movie_of(flown(), {"payload_kg": None, "world": None})
    assert made is not None
    assert {t for frame in texts(made) for t in frame if "payload" in t} == {"payload, caught"}


def test_a_log_without_geometry_has_no_animation() -> None:
    assert movie_of(dataclasses.replace(flown(), metadata={"config": {"json": json.dumps(CONFIG)}}), SIMULATED) is None


@pytest.mark.parametrize("arm_rad", [(math.radians(165), math.radians(140)), (1.2, -0.1)])
def test_the_net_is_where_the_control_law_has_it(arm_rad: Joints) -> None:
    attitude = quat_from_euler_zyx(0.1, -0.2, 2.0)
    pose = Pose(
        position_world_m=(1.0, -0.5, 1.2), attitude_wxyz=attitude, arm_rad=arm_rad, ball_world_m=(), caught=False
    )
    expected = np.add(pose.position_world_m, quat_rotate(attitude, manipulator_of(VEHICLE).net_body_m(arm_rad)))
    assert Scene(json.loads(VEHICLE.model_dump_json())).net_world_m(pose) == pytest.approx(expected)


def test_absent_parts_are_not_drawn() -> None:
    camera = Camera(np.zeros(3), yaw_rad=0.5, pitch_rad=0.3, distance_m=4.0, size_px=(600, 400))
    pose = Pose(
        position_world_m=(0.0, 0.0, 1.0),
        attitude_wxyz=(1.0, 0.0, 0.0, 0.0),
        arm_rad=(1.2, 0.3),
        ball_world_m=(),
        caught=False,
    )
    vehicle = json.loads(VEHICLE.model_dump_json())
    colours = {shape.colour for shape in Scene(vehicle).shapes(camera, pose)}
    left = {shape.colour for shape in Scene({**vehicle, "tool": None, "tether": None}).shapes(camera, pose)}
    assert colours - left == {NET, TETHER}


def test_what_is_behind_the_camera_is_cut_off() -> None:
    camera = Camera(np.zeros(3), yaw_rad=0.0, pitch_rad=0.0, distance_m=4.0, size_px=(600, 400))
    line = camera.pixels(np.array([[-10.0, 1.0, 0.0], [10.0, 1.0, 0.0]]))
    assert len(line) == 2
    assert line[1] == pytest.approx(camera.pixels(np.array([[10.0, 1.0, 0.0]]))[0])
    assert line[0][0] < line[1][0] < 300.0  # left of the middle, farther out where it is near


def test_the_gif_has_every_frame(movie: Movie, tmp_path: Path) -> None:
    movie = dataclasses.replace(movie, frames=movie.frames[:12], still=5)
    write_gif(movie, tmp_path / "catch.gif", width_px=480)
    with Image.open(tmp_path / "catch.gif") as gif:
        assert (gif.size, gif.info["loop"]) == ((480, 220), 0)
        shown_ms = [frame.info["duration"] for frame in ImageSequence.Iterator(gif)]
    assert shown_ms == [80] * (len(movie.frames) - 1) + [1600]


def test_a_browser_plays_it_whatever_a_phase_is_called(tmp_path: Path) -> None:
    made = movie_of(flown(phase="</script><b>phase"), SIMULATED)
    assert made is not None
    page = tmp_path / "page.html"
    page.write_text(f"<!doctype html><meta charset='utf-8'>{player_html(made)}", encoding="utf-8")
    assert re.search(r"""(?:src|href)=""", page.read_text(encoding="utf-8")) is None
    with chromium() as browser:
        tab = browser.new_page(reduced_motion="reduce")
        wrong: list[str] = []
        tab.on("pageerror", lambda error: wrong.append(str(error)))
        tab.goto(page.as_uri())
        assert tab.locator("b").count() == 0
        slider = tab.locator("input")
        assert slider.input_value() == str(made.still)
        slider.fill(str(len(made.frames) - 1))
        pixels = "document.querySelector('canvas').getContext('2d').getImageData(0, 0, 960, 440).data.buffer"
        assert tab.evaluate(f"new Set(new Uint32Array({pixels})).size") > 50
        tab.get_by_role("button", name="Play").click()
        tab.get_by_role("button", name="Pause").wait_for()
        tab.wait_for_function(f"document.querySelector('input').value < {len(made.frames) - 1}")
        assert wrong == []
