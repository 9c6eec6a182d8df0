"""Section `ground:` of the vehicle file: telemetry to ground stations and commands from them."""

from __future__ import annotations

import re
from typing import Annotated, Self

from pydantic import AfterValidator, Field, model_validator

from companion.config.base import Model, refuse

VEHICLE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,39}")
_NAME = r"[A-Za-z0-9_-]{1,63}(?:\.[A-Za-z0-9_-]{1,63})*\.?"
"""A host's name: the resolver raises UnicodeError for one with an empty or too long part, such as gcs..lab."""
_HOST = rf"(?P<host>\[[0-9A-Fa-f:.]+\]|{_NAME})"
_URL = re.compile(rf"(?P<scheme>mqtts?)://{_HOST}(?::(?P<port>\d{{1,5}}))?/?")
FOXGLOVE_DEFAULT = "127.0.0.1:8765"
"""Address of the Foxglove server if `--foxglove` gives none: Foxglove's usual port, for this computer only."""
_LOOPBACK = re.compile(r"localhost|127\.\d{1,3}\.\d{1,3}\.\d{1,3}|::1")


class BrokerAddress(Model):
    """Parts of a broker's URL."""

    host: str
    port: Annotated[int, Field(gt=0, le=65535)]
    tls: bool

    @property
    def loopback(self) -> bool:
        """Return whether the broker runs on this computer."""
        return _LOOPBACK.fullmatch(self.host) is not None

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'mqtts' if self.tls else 'mqtt'}://{host}:{self.port}"


def broker_address(url: str) -> BrokerAddress:
    """Parse a broker's URL.

    Raises:
        ValueError: the text is not a broker's URL.
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


_STATION = re.compile(rf"udpout://{_NAME}:(?P<port>\d{{1,5}})")


def _a_station(address: str) -> str:
    match = _STATION.fullmatch(address)
    if match is None or not 0 < int(match["port"]) <= 65535:
        raise ValueError(f"expected udpout://HOST:PORT (QGroundControl listens on 14550), got {address!r:.60}")
    return address


_LISTENER = re.compile(rf"{_HOST}:(?P<port>\d{{1,5}})")


def listen_address(text: str) -> tuple[str, int]:
    """Parse HOST:PORT, the address of a server on this computer.

    Raises:
        ValueError: the text is not HOST:PORT.
    """
    match = _LISTENER.fullmatch(text)
    if match is None or not 0 < int(match["port"]) <= 65535:
        raise ValueError(f"expected HOST:PORT of this computer, such as {FOXGLOVE_DEFAULT}, got {text!r:.60}")
    return match["host"].strip("[]"), int(match["port"])


def _a_listener(text: str) -> str:
    listen_address(text)
    return text


class Mqtt(Model):
    """The MQTT broker for telemetry and commands."""

    url: Annotated[str, AfterValidator(_a_broker)] = "mqtt://127.0.0.1:1883"
    """mqtt://HOST:PORT, or mqtts://HOST:PORT with TLS. A flight does not wait for its broker."""
    login_file: str | None = None
    """YAML file with `username` and `password` that only its owner can read. If it is absent, no login is used."""
    ca_file: str | None = None
    """CA certificates (PEM) to verify the broker's certificate. If it is absent, the system's CA certificates are used."""
    commands: bool = True
    """Whether signed commands are accepted. Over a connection to another computer without TLS, they are never accepted."""
    operators_file: str | None = None
    """YAML file with the operators and their keys. If it is absent, the current user's file on this computer is used."""

    @property
    def address(self) -> BrokerAddress:
        """Return the parts of `url`."""
        return broker_address(self.url)


class Ground(Model):
    """Connections to ground stations."""

    topic: str | None = None
    """Name of the vehicle in topics. If it is absent, the vehicle's name is used."""
    mqtt: Mqtt | None = Mqtt()
    """Connection to the MQTT broker; null disables telemetry and commands over MQTT."""
    qgroundcontrol: Annotated[str, AfterValidator(_a_station)] | None = None
    """Address of QGroundControl, with which MAVLink is exchanged: udpout://HOST:14550. If it is absent, nothing is forwarded."""
    qgroundcontrol_while_armed: bool = False
    """Whether messages that can stop the rotors or change the flight (forced disarm, parameters, missions, files) are forwarded even
    while PX4 is armed."""
    qgroundcontrol_console: bool = False
    """Whether SERIAL_CONTROL (PX4's console) is forwarded while PX4 is disarmed."""
    foxglove: Annotated[str, AfterValidator(_a_listener)] | None = None
    """HOST:PORT of this computer at which Foxglove shows the flight live; every program that reaches it may watch. If it is absent,
    there is no server."""

    @model_validator(mode="after")
    def _speakable(self) -> Self:
        if self.topic is not None and VEHICLE_NAME.fullmatch(self.topic) is None:
            refuse("ground", [(("topic",), "expected at most 40 characters: letters, digits, '_', '-' or '.'")])
        return self


def topic_name(topic: str | None, vehicle_name: str) -> str:
    """Return the vehicle's name for MQTT topics: `topic` if given, otherwise its name with '-' in place of other characters."""
    return topic or (re.sub(r"[^A-Za-z0-9_.-]", "-", vehicle_name)[:40] or "vehicle")
