"""How a broker is reached: its address, the login, the certificates."""

from __future__ import annotations

import ssl
from dataclasses import dataclass, field
from pathlib import Path

from companion.config.document import ConfigError
from companion.config.ground import BrokerAddress, broker_address
from companion.ground.protocol.keys import load_login


@dataclass(frozen=True, slots=True)
class BrokerAccess:
    """Everything that a connection to a broker needs."""

    address: BrokerAddress
    username: str | None = None
    password: str | None = field(default=None, repr=False)
    tls: ssl.SSLContext | None = None

    @property
    def trusted(self) -> bool:
        """Nobody between here and the broker can read or change anything: it is on this computer, or TLS leads to it."""
        return self.address.loopback or self.address.tls


@dataclass(frozen=True, slots=True)
class Named:
    """What the user calls the settings, for messages."""

    url: str
    login_file: str
    ca_file: str
    spare_ca: bool
    """A CA file without TLS is no mistake: a vehicle file names it once for all, and the URL is changed for one flight."""


OPTIONS = Named("--broker", "--login", "--ca", spare_ca=False)
KEYS = Named("ground.mqtt.url", "ground.mqtt.login_file", "ground.mqtt.ca_file", spare_ca=True)


def broker_access(url: str, login_file: str | None, ca_file: str | None, named: Named = OPTIONS) -> BrokerAccess:
    """Read what the settings name.

    Args:
        url: mqtt://HOST:PORT or mqtts://HOST:PORT.
        login_file: YAML file with `username` and `password`, readable by its owner alone.
        ca_file: certificates (PEM) of the authority that signed the broker's; None: the system's authorities.
        named: what the user calls them.

    Raises:
        ConfigError: one line that says which option, key or file, what was found and how to mend it.
    """
    try:
        address = broker_address(url)
    except ValueError as error:
        raise ConfigError([f"{named.url}: {error}"]) from None
    if ca_file is not None and not address.tls and not named.spare_ca:
        expected = f"expected {named.url} mqtts://HOST:PORT"
        raise ConfigError([f"{named.ca_file} {ca_file}: means nothing without TLS; {expected}"])
    login = None if login_file is None else load_login(login_file)
    if login is not None and not (address.tls or address.loopback):
        text = f"{address} is another computer and the way there is plain: everybody on it could read the password"
        raise ConfigError([f"{named.login_file} {login_file}: {text}; expected {named.url} mqtts://HOST:PORT"])
    tls = _tls(ca_file, f"{named.ca_file} {ca_file}") if address.tls else None
    return BrokerAccess(address, login.username if login else None, login.password if login else None, tls)


def _tls(ca_file: str | None, where: str) -> ssl.SSLContext:
    try:
        context = ssl.create_default_context(cafile=str(Path(ca_file).expanduser()) if ca_file is not None else None)
    except FileNotFoundError:
        raise ConfigError([f"{where}: no such file"]) from None
    except ssl.SSLError:
        raise ConfigError([f"{where}: is no certificate in PEM form (-----BEGIN CERTIFICATE-----)"]) from None
    except OSError as error:
        raise ConfigError([f"{where}: cannot be read: {error.strerror}"]) from None
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    return context
