"""How a broker is reached: its address, the login, the certificates."""

from __future__ import annotations

import ssl
from dataclasses import dataclass, field

from companion.config.document import ConfigError
from companion.config.ground import BrokerAddress, broker_address
from companion.ground.keys import load_login


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


def broker_access(url: str, login_file: str | None, ca_file: str | None) -> BrokerAccess:
    """Read what the options name.

    Args:
        url: mqtt://HOST:PORT or mqtts://HOST:PORT.
        login_file: YAML file with `username` and `password`, readable by its owner alone.
        ca_file: certificates (PEM) of the authority that signed the broker's; None: the system's authorities.

    Raises:
        ConfigError: one line that says which option or file, what was found and how to mend it.
    """
    try:
        address = broker_address(url)
    except ValueError as error:
        raise ConfigError([f"--broker: {error}"]) from None
    if ca_file is not None and not address.tls:
        raise ConfigError([f"--ca {ca_file}: means nothing without TLS; expected --broker mqtts://HOST:PORT"])
    login = None if login_file is None else load_login(login_file)
    if login is not None and not (address.tls or address.loopback):
        raise ConfigError([f"--login {login_file}: {address} is another computer and the way there is plain: everybody on it could "
                           "read the password; expected --broker mqtts://HOST:PORT"])  # fmt: skip
    tls = _tls(ca_file) if address.tls else None
    return BrokerAccess(address, login.username if login else None, login.password if login else None, tls)


def _tls(ca_file: str | None) -> ssl.SSLContext:
    try:
        context = ssl.create_default_context(cafile=ca_file)
    except FileNotFoundError:
        raise ConfigError([f"--ca {ca_file}: no such file"]) from None
    except ssl.SSLError:
        raise ConfigError([f"--ca {ca_file}: is no certificate in PEM form (-----BEGIN CERTIFICATE-----)"]) from None
    except OSError as error:
        raise ConfigError([f"--ca {ca_file}: cannot be read: {error.strerror}"]) from None
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    return context
