"""Publishes a vehicle's telemetry as ROS 2 topics, and passes HOLD and LAND from a ROS 2 topic to the vehicle as signed commands.

The bridge is a ground station: it reads MQTT through `companion.ground.station` and needs nothing of the flight. Only `main` uses
rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

from companion.ground.protocol.access import BrokerAccess, broker_access
from companion.ground.protocol.messages import EventLine, Events, Stream
from companion.ground.protocol.proof import Signer
from companion.ground.station.command_sender import Failed, Sent, ack_text, signer_of
from companion.ground.station.station import Station
from companion.ground.station.vehicles import ReceivedRecord
from companion.model.codec import to_json
from companion.model.types import OperatorCommand

Fields = dict[str, Any]
"""Fields of a ROS 2 message by name; those of a message in it are another dict. Fields that are not named keep their default."""
COMMANDS = {command.value: command for command in (OperatorCommand.HOLD, OperatorCommand.LAND)}
"""Commands that the bridge passes on. Whoever can publish in the ROS 2 network can give them; these two only make a flight safer."""


def messages_of(stream: Stream) -> Iterator[tuple[str, Fields]]:
    """Yield the topic and the message of each quantity that a telemetry message has. ROS 2 has our axes: world ENU, body FLU, SI units.

    ``pose`` is a geometry_msgs/PoseStamped, ``joint_states`` a sensor_msgs/JointState, ``net_force`` a geometry_msgs/WrenchStamped
    without torque.
    """
    seconds, microseconds = divmod(round(stream.wall_s * 1e6), 1_000_000)
    header = {"stamp": {"sec": seconds, "nanosec": 1000 * microseconds}, "frame_id": "world"}
    if stream.position_world_m is not None and stream.attitude_wxyz is not None:
        w, x, y, z = stream.attitude_wxyz
        pose = {"position": _vector(stream.position_world_m), "orientation": {"x": x, "y": y, "z": z, "w": w}}
        yield "pose", {"header": header, "pose": pose}
    if stream.arm_rad is not None:
        names = [f"joint{number}" for number in range(1, len(stream.arm_rad) + 1)]
        yield "joint_states", {"header": header, "name": names, "position": list(stream.arm_rad)}
    if stream.control is not None and stream.control.force_ext_world_n is not None:
        yield "net_force", {"header": header, "wrench": {"force": _vector(stream.control.force_ext_world_n)}}


def fill(message: Any, fields: Fields) -> Any:
    """Set the fields of a ROS 2 message, and return it.

    Raises:
        AttributeError: the message has no such field.
        AssertionError: the value is not of the field's type; raised by the message itself.
    """
    for name, value in fields.items():
        if isinstance(value, dict):
            fill(getattr(message, name), value)
        else:
            setattr(message, name, value)
    return message


class NewEvents:
    """Finds the events that are new in a message on the topic ``events``, which always holds the newest hundred."""

    def __init__(self) -> None:
        self._session = ""
        self._count = 0

    def take(self, events: Events) -> tuple[EventLine, ...]:
        """Return the events since the last call, oldest first; all after the start of another flight."""
        seen = self._count if events.session == self._session else 0
        self._session, self._count = events.session, events.count
        return events.lines[-(events.count - seen) :] if events.count > seen else ()


class Bridge:
    """Connects one vehicle with functions of ROS 2.

    Args:
        access: settings of the broker.
        signer: the operator who signs commands, or why commands are not possible.
        vehicle: name of the vehicle in the broker's topics.
        publish: publishes a message, given its topic and fields. The topic `events` has std_msgs/String with JSON or one line of text.
    """

    def __init__(
        self, access: BrokerAccess, signer: Signer | str, vehicle: str, publish: Callable[[str, Fields], None]
    ) -> None:
        self._vehicle = vehicle
        self._publish = publish
        self._events = NewEvents()
        self._station = Station(access, signer, vehicle, self._on_record, lambda connected, text: self._say(text))

    async def run(self) -> None:
        """Stay connected to the broker until cancelled.

        Raises:
            BrokerRefused: the broker refuses the login.
        """
        await self._station.run()

    async def command(self, text: str) -> None:
        """Send `hold` or `land` to the vehicle and publish its answer; any other text is refused."""
        command = COMMANDS.get(text.strip().lower())
        if command is None:
            self._say(f"command {text!r:.40} refused: expected {' or '.join(COMMANDS)}")
            return
        ack = await self._station.commands.send(self._vehicle, command, self._on_attempt)
        if ack is not None:
            self._say(ack_text(ack))

    def _on_attempt(self, notice: Sent | Failed) -> None:
        if isinstance(notice, Failed):
            self._say(f"{notice.command.value}: {notice.text}")

    def _on_record(self, received: ReceivedRecord) -> None:
        if isinstance(received.record, Stream):
            for topic, fields in messages_of(received.record):
                self._publish(topic, fields)
        elif isinstance(received.record, Events):
            for line in self._events.take(received.record):
                self._say(to_json(line).decode())

    def _say(self, text: str) -> None:
        self._publish("events", {"data": text})


def _vector(values: tuple[float, float, float]) -> Fields:
    return dict(zip("xyz", values, strict=True))


def main() -> None:
    """Run the node `companion` until Ctrl-C."""
    import rclpy
    from geometry_msgs.msg import PoseStamped, WrenchStamped
    from sensor_msgs.msg import JointState
    from std_msgs.msg import String

    rclpy.init()
    node = rclpy.create_node("companion")

    def setting(name: str, default: str = "") -> Any:
        """Return a parameter of the node; None if it is empty."""
        return node.declare_parameter(name, default).value or None

    access = broker_access(setting("broker", "mqtt://127.0.0.1:1883"), setting("login"), setting("ca"))
    signer = signer_of(access, setting("operators"), setting("operator"))
    kinds = {"pose": PoseStamped, "joint_states": JointState, "net_force": WrenchStamped, "events": String}
    publishers = {topic: node.create_publisher(kind, f"~/{topic}", 10) for topic, kind in kinds.items()}
    bridge = Bridge(
        access,
        signer,
        setting("vehicle", "tarot650_2r"),
        lambda topic, fields: publishers[topic].publish(fill(kinds[topic](), fields)),
    )
    loop = asyncio.new_event_loop()

    def on_command(message: Any) -> None:
        asyncio.run_coroutine_threadsafe(bridge.command(message.data), loop)

    node.create_subscription(String, "~/command", on_command, 10)
    threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()
    try:
        with contextlib.suppress(KeyboardInterrupt):
            loop.run_until_complete(bridge.run())
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
