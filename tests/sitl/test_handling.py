"""Handling in the simulated world, and wrongly configured motion-capture servers."""

from __future__ import annotations

import itertools

import pytest

from companion.config.document import ConfigError
from companion.io.mocap.natnet import z_up_from_y_up
from companion.model.frames import quat_conjugate, quat_from_euler_zyx, quat_multiply, quat_rotate
from companion.model.types import Quat, Vec3
from companion.sitl_config.loader import load_world
from companion.sitl_config.world import World
from sitl.world.mocap_misalignment import MocapMisalignment
from tests.preflight.hand_rig import Standing, world

P: Vec3 = (1.0, 2.0, 0.5)
Q = quat_from_euler_zyx(0.1, -0.2, 0.6)


def streamed(**knobs: object) -> tuple[Vec3, Quat]:
    frame = MocapMisalignment.of(World.model_validate(knobs))
    assert frame is not None
    return frame.pose(P, Q)


def same(a: Quat, b: Quat) -> bool:
    return abs(sum(x * y for x, y in zip(a, b, strict=True))) == pytest.approx(1.0, abs=1e-12)


def test_a_y_up_stream_is_what_the_companion_turns_back() -> None:
    position, attitude = streamed(mocap_axes=["x", "z", "-y"])
    position, attitude = z_up_from_y_up(position, attitude)
    assert position == pytest.approx(P)
    assert same(attitude, Q)


def test_every_set_of_axes_streams_rotations_that_turn_as_they_are_seen() -> None:
    """Points of the stream rotate by the quaternions of the stream."""
    later = quat_multiply(quat_from_euler_zyx(0.3, 0.1, -0.4), Q)
    axes_of = ("x", "y", "z")
    for order in itertools.permutations(axes_of):
        for signs in itertools.product(("", "-"), repeat=3):
            frame = MocapMisalignment(
                World.model_validate({"mocap_axes": [s + a for s, a in zip(signs, order, strict=True)]})
            )
            turn = quat_multiply(frame.pose(P, later)[1], quat_conjugate(frame.pose(P, Q)[1]))
            point = (0.3, -0.2, 0.7)
            turned = quat_rotate(quat_multiply(later, quat_conjugate(Q)), point)
            assert quat_rotate(turn, frame.pose(point, Q)[0]) == pytest.approx(frame.pose(turned, Q)[0])


def test_the_hand_is_away_while_the_rotors_are_armed() -> None:
    rig = Standing(world("handling=true"))
    for _ in rig.samples(4.0 + 3.0):
        pass
    plant = rig.plant
    assert plant.truth.position_world_m[2] > 0.5
    while plant.t_s < 4.0 + 4.0:
        plant.step(True)
    assert plant.truth.position_world_m[2] < 0.35


def test_axes_that_name_one_twice_are_refused() -> None:
    with pytest.raises(ConfigError, match="each of x, y and z once"):
        load_world(['world.mocap_axes=["x","-x","z"]'])
