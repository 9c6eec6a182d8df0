"""The example of a ROS 2 bridge, without ROS 2: its conversion, and its commands through a real broker."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import sys
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from companion.ground.protocol.access import broker_access
from companion.ground.protocol.keys import Operator
from companion.ground.protocol.messages import VERSION, EventLine, Events
from companion.ground.protocol.proof import Signer
from companion.model.types import OperatorCommand
from tests.broker import loopback_broker
from tests.ground.monitor_rig import ANNA, OPERATORS
from tests.ground.vehicle import flight, played_vehicle
from tests.support import DEADLINE_S, ROOT


@pytest.fixture
def bridge(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(ROOT / "examples/ros2_bridge"))
    monkeypatch.delitem(sys.modules, "companion_ros2_bridge", raising=False)
    return importlib.import_module("companion_ros2_bridge")


class RosMessage:
    """A message with the fields of ROS 2's definition. Like rclpy's it accepts no other field and no other type."""

    def __init__(self, **fields: Any) -> None:
        self.__dict__.update(fields)

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self.__dict__:
            raise AttributeError(name)
        assert type(value) is type(self.__dict__[name]), f"{name}: {value!r}"
        self.__dict__[name] = value


def header() -> RosMessage:
    return RosMessage(stamp=RosMessage(sec=0, nanosec=0), frame_id="")


def vector() -> RosMessage:
    return RosMessage(x=0.0, y=0.0, z=0.0)


def ros_messages() -> dict[str, RosMessage]:
    """Source: the .msg files of common_interfaces (geometry_msgs, sensor_msgs)."""
    pose = RosMessage(position=vector(), orientation=RosMessage(x=0.0, y=0.0, z=0.0, w=1.0))
    return {
        "pose": RosMessage(header=header(), pose=pose),
        "joint_states": RosMessage(header=header(), name=[], position=[], velocity=[], effort=[]),
        "net_force": RosMessage(header=header(), wrench=RosMessage(force=vector(), torque=vector())),
    }


def test_a_telemetry_message_fills_the_fields_of_ros_messages(bridge: Any) -> None:
    _, streams, _ = flight()
    stream = replace(
        next(one for one in streams if one.control is not None),
        wall_s=1_700_000_000.25,
        attitude_wxyz=(0.5, 0.1, -0.2, 0.8),
        arm_rad=(0.1, 0.2, 0.3),
    )
    empty = ros_messages()
    filled: Any = {topic: bridge.fill(empty[topic], fields) for topic, fields in bridge.messages_of(stream)}
    assert filled.keys() == empty.keys()
    for message in filled.values():
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_000, 250_000_000)
        assert message.header.frame_id == "world"
    position, turn = filled["pose"].pose.position, filled["pose"].pose.orientation
    assert (position.x, position.y, position.z) == stream.position_world_m
    assert (turn.x, turn.y, turn.z, turn.w) == (0.1, -0.2, 0.8, 0.5)
    assert filled["joint_states"].name == ["joint1", "joint2", "joint3"]
    assert filled["joint_states"].position == [0.1, 0.2, 0.3]
    force = filled["net_force"].wrench.force
    assert stream.control is not None and (force.x, force.y, force.z) == stream.control.force_ext_world_n


def test_what_a_telemetry_message_lacks_is_not_published(bridge: Any) -> None:
    _, streams, _ = flight()
    stream = replace(streams[-1], position_world_m=None, arm_rad=None, control=None)
    assert list(bridge.messages_of(stream)) == []


def test_each_event_is_new_once_and_a_new_flight_begins_again(bridge: Any) -> None:
    line = flight()[2].lines[0]

    def events(session: str, *texts: str, earlier: int = 0) -> Events:
        lines: tuple[EventLine, ...] = tuple(replace(line, text=text) for text in texts)
        return Events(v=VERSION, session=session, count=earlier + len(lines), lines=lines)

    new = bridge.NewEvents()
    taken = [
        [one.text for one in new.take(message)]
        for message in (
            events("first", "a", "b"),
            events("first", "a", "b"),
            events("first", "b", "c", "d", earlier=1),
            events("first", "y", "z", earlier=98),  # more new ones than the message still holds
            events("second", "e"),
        )
    ]
    assert taken == [["a", "b"], [], ["c", "d"], ["y", "z"], ["e"]]


async def test_hold_and_land_reach_the_vehicle_and_other_words_do_not(bridge: Any, tmp_path: Path) -> None:
    published: list[tuple[str, Any]] = []
    posed = asyncio.Event()

    def publish(topic: str, fields: Any) -> None:
        published.append((topic, fields))
        if topic == "pose":
            posed.set()

    with loopback_broker(tmp_path) as broker:
        async with played_vehicle(broker.port, OPERATORS) as vehicle:
            made = bridge.Bridge(broker_access(broker.url, None, None), signer(ANNA), "rig", publish)
            running = asyncio.create_task(made.run())
            async with asyncio.timeout(DEADLINE_S):
                await posed.wait()
                for word in ("hold", " LAND ", "resume", "start", "abort", ""):
                    await made.command(word)
            running.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await running
            assert [heard.command for heard in vehicle.accepted] == [OperatorCommand.HOLD, OperatorCommand.LAND]
    texts = [fields["data"] for topic, fields in published if topic == "events"]
    assert {"hold: hold: done", "land: land: done"} <= set(texts)
    assert [text for text in texts if "refused" in text] == [
        f"command {word!r} refused: expected hold or land" for word in ("resume", "start", "abort", "")
    ]


def signer(operator: Operator) -> Signer:
    return Signer(operator.name, operator.key)
