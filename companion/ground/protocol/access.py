"""Connection settings of a broker: address, login, certificates."""

from __future__ import annotations

import ssl
from dataclasses import dataclass, field
from pathlib import Path

from companion.config.document import ConfigError
from companion.config.ground import BrokerAddress, broker_address
from companion.ground.protocol.keys import load_login


@dataclass(frozen=True, slots=True)
class BrokerAccess:
    """Settings of a connection to a broker."""

    address: BrokerAddress
    username: str | None = None
    password: str | None = field(default=None, repr=False)
    tls: ssl.SSLContext | None = None

    @property
    def trusted(self) -> bool:
        """Whether messages to the broker are protected: the broker is on this computer, or TLS is used."""
        return self.address.loopback or self.address.tls


@dataclass(frozen=True, slots=True)
class SettingNames:
    """Names of the settings as the user wrote them, for messages."""

    url: str
    login_file: str
    ca_file: str
    ca_without_tls: bool
    """Whether a CA file without TLS is allowed: a vehicle file names the CA file once, and a flight may override only the URL."""


OPTIONS = SettingNames("--broker", "--login", "--ca", ca_without_tls=False)
KEYS = SettingNames("ground.mqtt.url", "ground.mqtt.login_file", "ground.mqtt.ca_file", ca_without_tls=True)


def broker_access(url: str, login_file: str | None, ca_file: str | None, named: SettingNames = OPTIONS) -> BrokerAccess:
    """Read the files that the settings name.

    Args:
        login_file: YAML file with `username` and `password`, readable by its owner alone.
        ca_file: CA certificates (PEM) to verify the broker's certificate; None for the system's authorities.
        named: names of the settings, for messages.

    Raises:
        ConfigError: one line with the option, key or file, the value found and the value expected.
    """
    try:
        address = broker_address(url)
    except ValueError as error:
        raise ConfigError(f"{named.url}: {error}") from None
    if ca_file is not None and not address.tls and not named.ca_without_tls:
        expected = f"expected {named.url} mqtts://HOST:PORT"
        raise ConfigError(f"{named.ca_file} {ca_file}: has no effect without TLS; {expected}")
    login = None if login_file is None else load_login(login_file)
    if login is not None and not (address.tls or address.loopback):
        text = f"the connection to {address} is not encrypted: others on the network could read the password"
        raise ConfigError(f"{named.login_file} {login_file}: {text}; expected {named.url} mqtts://HOST:PORT")
    tls = _tls(ca_file, f"{named.ca_file} {ca_file}") if address.tls else None
    return BrokerAccess(address, login.username if login else None, login.password if login else None, tls)


def _tls(ca_file: str | None, where: str) -> ssl.SSLContext:
    try:
        context = ssl.create_default_context(cafile=str(Path(ca_file).expanduser()) if ca_file is not None else None)
    except FileNotFoundError:
        raise ConfigError(f"{where}: no such file") from None
    except ssl.SSLError:
        raise ConfigError(f"{where}: not a certificate in PEM form (-----BEGIN CERTIFICATE-----)") from None
    except OSError as error:
        raise ConfigError(f"{where}: cannot be read: {error.strerror}") from None
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    return context
