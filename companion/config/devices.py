"""The devices of the vehicle file: addresses and settings."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, JsonValue, model_validator

from companion.config.base import Location, Model, Positive, refuse
from companion.config.device_plugins import DYNAMIXEL, EXTERNAL, NATNET, RFT60
from companion.config.link_address import Ipv4Address, MulticastGroup, Px4Address


class AutopilotDevice(Model):
    """PX4 over MAVLink."""

    address: Px4Address
    """Address of the link, such as udpin://0.0.0.0:14540 or serial:///dev/ttyAMA0:921600."""
    discovery_timeout_s: Positive = 10.0
    setpoint_path: Literal["offboard", "direct"] = "offboard"
    """How SET_ATTITUDE_TARGET is sent: offboard (through MAVSDK's Offboard plugin) or direct (by the flight loop itself, some 0.2 ms
    sooner)."""


ANY_INTERFACE = "0.0.0.0"


NatNetVersion = Literal["3.0", "3.1", "4.0", "4.1", "4.2", "4.3", "4.4"]
"""Versions of the NatNet bitstream that the NatNet SDK describes: those of Motive 2.0, 2.1, 3.0, 3.1, 3.2, 3.3 and 3.4."""


class NatNetOptions(Model):
    """OptiTrack Motive over NatNet; its settings are keys of devices.mocap."""


class TrackedBall(Model):
    """How motion capture sees the ball that is thrown to the vehicle."""

    kind: Literal["marker", "body"]
    """marker: the ball is covered with reflective tape, and one unlabelled marker of a frame; body: it has three markers or more, and a
    rigid body of its own."""
    id: Annotated[int, Field(ge=0)] | None = None
    """Streaming id of the ball's rigid body; required if and only if `kind` is body."""

    @model_validator(mode="after")
    def _id_of_a_body(self) -> Self:
        if self.kind == "body" and self.id is None:
            refuse("ball", [(("id",), "missing; the streaming id of the ball's rigid body")])
        if self.kind == "marker" and self.id is not None:
            refuse("ball", [(("id",), f"a single marker has no id, got {self.id}; remove it, or set kind: body")])
        return self


class MocapDevice(Model):
    """Motion capture: OptiTrack Motive over NatNet, or a system that a plug-in provides (docs/mocap.md)."""

    type: str = NATNET
    """natnet, or the name of an installed motion-capture system (`companion plugins` lists them); `--sitl` uses natnet for them.
    external: another program feeds PX4 with poses, the companion reads none, and the other keys have no effect."""
    server: str = ""
    """Address of the computer that runs Motive or the other system; required unless `type` is external."""
    interface: Ipv4Address = ANY_INTERFACE
    """This computer's address on the camera network. Without `--sitl`, `fly` and `check` refuse 0.0.0.0 (all networks)."""
    transport: Literal["multicast", "unicast"] = "multicast"
    multicast_group: MulticastGroup = "239.255.42.99"
    command_port: Annotated[int, Field(gt=0, le=65535)] = 1510
    data_port: Annotated[int, Field(gt=0, le=65535)] = 1511
    natnet_version: NatNetVersion | None = None
    """Version that the server must use. If it is absent, all these versions and later ones are accepted."""
    rigid_body_id: Annotated[int, Field(ge=0)] = 0
    """Number of the vehicle's rigid body; required unless `type` is external."""
    up_axis: Literal["y", "z"] = "z"
    """Up axis in Motive's streaming settings."""
    rate_hz: Positive = 200.0
    """Expected frame rate."""
    ball: TrackedBall | None = None
    """The thrown ball, for missions that follow it; null if none is followed, and no other marker is then read."""
    bar_id: Annotated[int, Field(ge=0)] | None = None
    """Streaming id of the rigid body of a bar that two vehicles carry; null if it has none. Its pivot is the middle between the
    handles, and its x axis points to the left end."""
    options: dict[str, JsonValue] = Field(default={})
    """Settings of the system that a plug-in provides; must be empty for natnet and external."""

    @property
    def external(self) -> bool:
        """Return whether another program feeds PX4 with poses."""
        return self.type == EXTERNAL

    @model_validator(mode="after")
    def _addresses(self) -> Self:
        missing = [key for key in ("server", "rigid_body_id") if key not in self.model_fields_set]
        if missing and not self.external:
            refuse("motion capture", [((key,), "missing") for key in missing])
        if self.ball is not None and self.external:
            text = "another program feeds PX4 (type: external), and the companion sees no ball; remove it"
            refuse("motion capture", [(("ball",), text)])
        if self.ball is not None and self.ball.id == self.rigid_body_id:
            text = f"{self.ball.id} is the vehicle's own body (rigid_body_id); give the ball's"
            refuse("motion capture", [(("ball", "id"), text)])
        if self.bar_id is not None and self.bar_id == self.rigid_body_id:
            text = f"{self.bar_id} is the vehicle's own body (rigid_body_id); give the bar's"
            refuse("motion capture", [(("bar_id",), text)])
        return self


ServoBaud = Literal[57600, 115200, 1000000, 2000000, 3000000, 4000000]
"""Baud rates of the arm's servos, in the order of the values of register 8. The tools and the simulated servos also support rates that
are too slow or too fast for a flight."""


class DynamixelOptions(Model):
    """Dynamixel servos on a U2D2 adapter; their settings are keys of devices.arm and arm.joints."""


class ArmDevice(Model):
    """The arm's motors: Dynamixel servos on a U2D2 adapter, or motors that a plug-in drives (docs/plug-ins.md)."""

    type: str = DYNAMIXEL
    """dynamixel, or the name of an installed arm (`companion plugins` lists them). With `--sitl`, dynamixel is used."""
    port: str | None = None
    """Serial port; required for dynamixel."""
    baud: ServoBaud = 3000000
    watchdog_ms: Annotated[int, Field(ge=20, le=2540)] = 100
    """Timeout of the bus watchdog (register 98), a multiple of 20 ms; after this time without an instruction, the servos release
    torque. A plug-in sets or states the watchdog of its motors.
    """
    options: dict[str, JsonValue] = Field(default={})
    """Settings of the arm that a plug-in provides; must be empty for dynamixel."""

    @property
    def servo_port(self) -> str:
        """Serial port of the servos; may be read only if `type` is dynamixel."""
        assert self.port is not None
        return self.port

    @model_validator(mode="after")
    def _suits_the_type(self) -> Self:
        problems: list[tuple[Location, str]] = []
        if self.type == DYNAMIXEL and self.port is None:
            problems.append((("port",), "missing; the serial port of the U2D2"))
        if self.type == DYNAMIXEL and self.watchdog_ms % 20:
            text = f"must be a multiple of 20 ms (the register's unit), got {self.watchdog_ms} ms"
            problems.append((("watchdog_ms",), text))
        refuse("arm device", problems)
        return self


class Rft60Options(Model):
    """Robotous RFT60-HA01 on a serial port; its settings are keys of devices.force."""


class ForceDevice(Model):
    """The force-torque sensor: the Robotous RFT60-HA01 on a serial port, or one that a plug-in provides (docs/plug-ins.md)."""

    type: str = RFT60
    """rft60, or the name of an installed force sensor (`companion plugins` lists them). With `--sitl`, rft60 is used."""
    port: str | None = None
    """Serial port; required for rft60."""
    baud: Literal[115200] = 115200
    rate_hz: Annotated[int, Field(gt=0, le=10000)] = 200
    """Expected rate of the samples; of rft60, 200 or 333 Hz."""
    force_max_n: Positive = 200.0
    options: dict[str, JsonValue] = Field(default={})
    """Settings of the sensor that a plug-in provides; must be empty for rft60."""

    @model_validator(mode="after")
    def _suits_the_type(self) -> Self:
        problems: list[tuple[Location, str]] = []
        if self.type == RFT60 and self.port is None:
            problems.append((("port",), "missing; the serial port of the sensor"))
        if self.type == RFT60 and self.rate_hz not in (200, 333):
            problems.append((("rate_hz",), f"expected one of 200, 333, got {self.rate_hz}"))
        refuse("force device", problems)
        return self


class TeamDevice(Model):
    """The link to the other vehicle of a team: a signed datagram 50 times a second in each direction (docs/team.md)."""

    port: Annotated[int, Field(ge=0, le=65535)] = 14700
    """UDP port at which this vehicle receives."""
    partner: Ipv4Address | None = None
    """Address of the other vehicle's computer; with `--sitl`, this one's."""
    partner_port: Annotated[int, Field(gt=0, le=65535)] = 14700
    """UDP port at which the other vehicle receives."""
    key_file: str | None = None
    """File with the key that both vehicles share, 32 bytes or more; with `--sitl`, one is made."""


class Devices(Model):
    """Addresses and settings of the devices."""

    autopilot: AutopilotDevice
    mocap: MocapDevice
    arm: ArmDevice | None = None
    """Bus of the arm's servos; absent if and only if the vehicle has no arm."""
    force: ForceDevice | None
    """Force-torque sensor; null states that there is none: the control law then runs without a measured force, and no catch is detected
    (docs/hardware.md)."""
    team: TeamDevice | None = None
    """Link to the other vehicle of a team; null for a vehicle that flies alone."""
