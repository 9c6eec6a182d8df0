"""Files of a broker with logins and TLS: one folder for the broker, with a folder for each computer that connects.

mosquitto.conf passwords acl ca.pem server.pem server.key   the broker
service.conf                                                the same profile for the system service
ca.key                                                      signs a new server.pem, nothing else
vehicles/NAME/{login.yaml,ca.pem,operators.yaml}            a vehicle: keys of all operators
operators/NAME/{login.yaml,ca.pem,operators.yaml}           an operator's computer: the operator's own key
viewers/NAME/{login.yaml,ca.pem}                            a viewer's computer
"""

from __future__ import annotations

import contextlib
import datetime
import ipaddress
import os
import re
import secrets
import shutil
import socket
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from companion.config.document import ConfigError
from companion.config.ground import VEHICLE_NAME
from companion.ground.broker.certificates import (
    CertificateError,
    Pair,
    certificate_hosts,
    expiry_date,
    make_authority,
    make_server,
)
from companion.ground.broker.mosquitto_config import INSTALLED, acl_text, profile_text
from companion.ground.protocol.keys import OPERATOR_NAME, Operator, new_key, operators_text, write_private
from companion.runtime.files import write_whole
from companion.runtime.subprocesses import captured

DAYS_MAX = 3000
LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")
_HOST = re.compile(r"[A-Za-z0-9]([A-Za-z0-9._-]{0,251}[A-Za-z0-9])?")
_HASH_DEADLINE_S = 60.0


class SetupError(Exception):
    """A tool is missing or fails. The exception's text is one line."""


@dataclass(frozen=True, slots=True)
class BrokerUsers:
    """Hosts and users of a broker."""

    hosts: tuple[str, ...]
    """Names and addresses of the broker, in addition to loopback."""
    operators: tuple[str, ...]
    viewers: tuple[str, ...]
    vehicles: tuple[str, ...]
    days: int
    """Validity of the broker's certificate."""


def create(folder: Path, users: BrokerUsers, now: datetime.datetime) -> None:
    """Create the folder completely or not at all.

    Args:
        folder: absolute path; must not exist or must be empty.

    Raises:
        ConfigError: a name is invalid, or the folder is not empty.
        SetupError: mosquitto_passwd is missing or fails.
    """
    _check_names(users)
    if not str(folder).isprintable():
        raise ConfigError(f"{folder}: the folder's name contains control characters; choose another")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(
            f"{folder}: already exists; nothing was changed. Choose another folder, or use --renew-certificates"
        )
    beside = folder.with_name(f".{folder.name}.{secrets.token_hex(8)}")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        beside.mkdir(mode=0o700)
        try:
            _fill(beside, folder, users, now)
            beside.rename(folder)
        finally:
            shutil.rmtree(beside, ignore_errors=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be created: {error.strerror or error}") from None


def renew_certificate(folder: Path, hosts: Sequence[str], days: int, now: datetime.datetime) -> tuple[str, ...]:
    """Create a new key and certificate of the broker, signed by the same authority: no other computer needs a new file.

    Args:
        hosts: names and addresses of the broker; empty for those of the old certificate.

    Returns:
        The hosts in the new certificate.

    Raises:
        ConfigError: files are missing or invalid; nothing was changed.
    """
    _check_hosts(hosts)
    named = folder / "ca.key"
    try:
        authority = Pair((folder / "ca.pem").read_bytes(), named.read_bytes())
        named = folder / "server.pem"
        known = tuple(_all_hosts(hosts) if hosts else certificate_hosts(named.read_bytes()))
        server = make_server(authority, known, days, now)
        for name, data in (("server.key", server.key), ("server.pem", server.certificate)):
            named = folder / name
            write_whole(named, data, mode=0o600, durable=True)
    except OSError as error:
        raise ConfigError(
            f"{error.filename or named}: {error.strerror or error}; expected a folder that broker init created"
        ) from None
    except CertificateError as error:
        raise ConfigError(f"{named}: {error}") from None
    return known


def certificate_expiry(folder: Path) -> datetime.date:
    """Return the last valid day of the broker's certificate."""
    return expiry_date((folder / "server.pem").read_bytes())


def _fill(folder: Path, later: Path, users: BrokerUsers, now: datetime.datetime) -> None:
    """Write all files into `folder`, which is renamed to `later` afterwards."""
    authority = make_authority(now)
    try:
        server = make_server(authority, _all_hosts(users.hosts), users.days, now)
    except CertificateError as error:
        raise ConfigError(f"--days {users.days}: {error}") from None
    logins = {name: secrets.token_urlsafe(24) for name in (*users.vehicles, *users.operators, *users.viewers)}
    operators = [Operator(name, new_key()) for name in users.operators]
    files = {
        "mosquitto.conf": profile_text(later).encode(),
        "service.conf": profile_text(INSTALLED).encode(),
        "acl": acl_text(users.vehicles, users.operators, users.viewers).encode(),
        "ca.pem": authority.certificate,
        "ca.key": authority.key,
        "server.pem": server.certificate,
        "server.key": server.key,
        "passwords": "".join(f"{name}:{password}\n" for name, password in logins.items()).encode(),
    }
    all_keys = operators_text(operators).encode() if operators else None
    own = {operator.name: operators_text([operator]).encode() for operator in operators}
    computers = [(f"vehicles/{name}", name, all_keys) for name in users.vehicles]
    computers += [(f"operators/{name}", name, own[name]) for name in users.operators]
    computers += [(f"viewers/{name}", name, None) for name in users.viewers]
    for subfolder, name, keys in computers:
        (folder / subfolder).mkdir(mode=0o700, parents=True)
        files[f"{subfolder}/login.yaml"] = f'username: "{name}"\npassword: "{logins[name]}"\n'.encode()
        files[f"{subfolder}/ca.pem"] = authority.certificate
        if keys is not None:
            files[f"{subfolder}/operators.yaml"] = keys
    for name, data in files.items():
        write_private(folder / name, data)
    _hash_passwords(folder / "passwords")


def _hash_passwords(path: Path) -> None:
    """Replace ``name:password`` lines by ``name:hash`` lines in place; no password appears on a command line."""
    tool = shutil.which("mosquitto_passwd")
    if tool is None:
        raise SetupError("mosquitto_passwd is not installed: apt install mosquitto")
    try:
        done = captured([tool, "-U", str(path)], _HASH_DEADLINE_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SetupError(f"{tool} -U: {error}") from None
    hashed = [line.split(":", 1)[-1].startswith("$") for line in path.read_text(encoding="utf-8").splitlines()]
    if done.returncode != 0 or not all(hashed):
        raise SetupError(
            f"{tool} -U: exit code {done.returncode}: {' '.join(done.stderr.split()) or 'passwords are not hashed'}"
        )
    os.chmod(path, 0o600)


def _check_names(users: BrokerUsers) -> None:
    lines = [
        f"{option} {name!r:.60}: expected 1 to 40 letters, digits, '_', '-' or '.'"
        for option, pattern, names in (
            ("--vehicle", VEHICLE_NAME, users.vehicles),
            ("--operator", OPERATOR_NAME, users.operators),
            ("--viewer", OPERATOR_NAME, users.viewers),
        )
        for name in names
        if pattern.fullmatch(name) is None or name in (".", "..")
    ]
    names = [*users.vehicles, *users.operators, *users.viewers]
    lines += [
        f"{name}: used twice; every vehicle and user needs a different name"
        for name in sorted(set(names))
        if names.count(name) > 1
    ]
    if not users.vehicles:
        lines.append("--vehicle: expected at least one vehicle name")
    if lines:
        raise ConfigError(lines)
    _check_hosts(users.hosts)


def _check_hosts(hosts: Sequence[str]) -> None:
    lines = [f"--host {host!r:.60}: expected a name or an address" for host in hosts if not _is_host(host)]
    if lines:
        raise ConfigError(lines)


def _is_host(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return _HOST.fullmatch(text) is not None
    return "%" not in text


def _all_hosts(hosts: Sequence[str]) -> list[str]:
    return list(dict.fromkeys([*hosts, *LOCAL_HOSTS]))


def this_host() -> tuple[str, ...]:
    """Return this computer's host name; empty if it is not valid in a certificate."""
    with contextlib.suppress(OSError):
        name = socket.gethostname()
        if _is_host(name):
            return (name,)
    return ()
