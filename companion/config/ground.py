"""Section `ground:` of the vehicle file: who may watch and command it from the ground."""

from __future__ import annotations

import re
from typing import Annotated, Self

from pydantic import AfterValidator, Field, model_validator

from companion.config.base import Model, refuse

VEHICLE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,39}")
_URL = re.compile(r"(?P<scheme>mqtts?)://(?P<host>\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]+)(?::(?P<port>\d{1,5}))?/?")
_LOOPBACK = re.compile(r"localhost|127\.\d{1,3}\.\d{1,3}\.\d{1,3}|::1")


class BrokerAddress(Model):
    """A broker's URL taken apart."""

    host: str
    port: Annotated[int, Field(gt=0, le=65535)]
    tls: bool

    @property
    def loopback(self) -> bool:
        """It is on this computer."""
        return _LOOPBACK.fullmatch(self.host) is not None

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'mqtts' if self.tls else 'mqtt'}://{host}:{self.port}"


def broker_address(url: str) -> BrokerAddress:
    """Take a broker's URL apart.

    Raises:
        ValueError: it is none; says what was expected.
    """
    match = _URL.fullmatch(url)
    if match is None:
        raise ValueError(f"expected mqtt://HOST:PORT or mqtts://HOST:PORT, got {url!r:.60}")
    tls = match["scheme"] == "mqtts"
    port = int(match["port"]) if match["port"] else 8883 if tls else 1883
    if not 0 < port <= 65535:
        raise ValueError(f"expected a port from 1 to 65535, got {port}")
    return BrokerAddress(host=match["host"].strip("[]"), port=port, tls=tls)


def _a_broker(url: str) -> str:
    broker_address(url)
    return url


_STATION = re.compile(r"udpout://[^:/?\s]+:(?P<port>\d{1,5})")


def _a_station(address: str) -> str:
    match = _STATION.fullmatch(address)
    if match is None or not 0 < int(match["port"]) <= 65535:
        raise ValueError(f"expected udpout://HOST:PORT (QGroundControl listens on 14550), got {address!r:.60}")
    return address


class Mqtt(Model):
    """The broker that telemetry goes to and commands come from."""

    url: Annotated[str, AfterValidator(_a_broker)] = "mqtt://127.0.0.1:1883"
    """mqtt://HOST:PORT, or mqtts://HOST:PORT with TLS. A flight waits for no broker."""
    login_file: str | None = None
    """YAML file with `username` and `password`, readable by its owner alone; absent: none."""
    ca_file: str | None = None
    """Certificate (PEM) of the authority that signed the broker's; absent: the system's authorities."""
    commands: bool = True
    """Hear signed commands. Never over a plain connection to another computer."""
    operators_file: str | None = None
    """Who may command: YAML file of operators and their keys; absent: that of this user on this computer."""

    @property
    def address(self) -> BrokerAddress:
        """The URL taken apart."""
        return broker_address(self.url)


class Ground(Model):
    """Ground stations."""

    topic: str | None = None
    """Name of the vehicle in topics; absent: the vehicle's name."""
    mqtt: Mqtt | None = Mqtt()
    """null: no telemetry, no commands over MQTT."""
    qgroundcontrol: Annotated[str, AfterValidator(_a_station)] | None = None
    """MAVLink is forwarded to and from here: udpout://HOST:14550; absent: not forwarded."""
    qgroundcontrol_while_armed: bool = False
    """Forward while PX4 is armed too what may stop rotors or change the flight: forced disarm, parameters, missions, files."""
    qgroundcontrol_console: bool = False
    """Forward SERIAL_CONTROL, which is PX4's console, while PX4 is disarmed."""

    @model_validator(mode="after")
    def _speakable(self) -> Self:
        if self.topic is not None and VEHICLE_NAME.fullmatch(self.topic) is None:
            refuse("ground", [(("topic",), "expected letters, digits, '_', '-' or '.', at most 40 of them")])
        return self


def topic_name(topic: str | None, vehicle_name: str) -> str:
    """Name of a vehicle in topics: what MQTT does not allow becomes '-'."""
    return topic or (re.sub(r"[^A-Za-z0-9_.-]", "-", vehicle_name)[:40] or "vehicle")
