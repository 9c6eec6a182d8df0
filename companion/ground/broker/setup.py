"""Everything that a broker with logins and TLS needs, made in one folder: for the broker itself, and a folder for each computer.

mosquitto.conf passwords acl ca.pem server.pem server.key   the broker
service.conf                                                the same profile for the system service
ca.key                                                      renews server.pem, nothing else
vehicles/NAME/{login.yaml,ca.pem,operators.yaml}            the vehicle: all operators' keys
operators/NAME/{login.yaml,ca.pem,operators.yaml}           an operator's computer: his own key
viewers/NAME/{login.yaml,ca.pem}                            who looks on
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
from companion.ground.broker.certificates import CertificateError, Pair, ends, hosts_of, make_authority, make_server
from companion.ground.broker.mosquitto_config import INSTALLED, acl_text, profile_text
from companion.ground.protocol.keys import OPERATOR_NAME, Operator, new_key, operators_text, write_private
from companion.runtime.files import write_whole

DAYS_MAX = 3000
LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")
_HOST = re.compile(r"[A-Za-z0-9]([A-Za-z0-9._-]{0,251}[A-Za-z0-9])?")
_HASH_DEADLINE_S = 60.0


class SetupError(Exception):
    """A tool that is missing, or does not do what it should; one line."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """Who and what a broker is made for."""

    hosts: tuple[str, ...]
    """Names and addresses beside those of loopback."""
    operators: tuple[str, ...]
    viewers: tuple[str, ...]
    vehicles: tuple[str, ...]
    days: int
    """Of the broker's certificate."""


def make(folder: Path, wanted: Wanted, now: datetime.datetime) -> None:
    """Make the folder, whole or not at all.

    Args:
        folder: absolute; not there yet, or empty.
        wanted: for whom.
        now: with time zone.

    Raises:
        ConfigError: a name cannot be used, or something is in the folder already.
        SetupError: mosquitto_passwd is missing or fails.
    """
    _refuse_names(wanted)
    if not str(folder).isprintable():
        raise ConfigError([f"{folder}: a folder's name with control characters; choose another"])
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError([f"{folder}: is there already, nothing was changed; choose another, or --renew-certificates"])
    beside = folder.with_name(f".{folder.name}.{secrets.token_hex(8)}")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        beside.mkdir(mode=0o700)
        try:
            _fill(beside, folder, wanted, now)
            beside.rename(folder)
        finally:
            shutil.rmtree(beside, ignore_errors=True)
    except OSError as error:
        raise ConfigError([f"{folder}: cannot be made: {error.strerror or error}"]) from None


def renew(folder: Path, hosts: Sequence[str], days: int, now: datetime.datetime) -> tuple[str, ...]:
    """A new key and certificate for the broker of a folder, by the same authority: nobody else needs a new file.

    Args:
        folder: as `make` left it.
        hosts: instead of those of the old certificate; empty: the same.
        days: of the new certificate.
        now: with time zone.

    Returns:
        The hosts.

    Raises:
        ConfigError: files are missing or unusable; nothing was changed.
    """
    _refuse_hosts(hosts)
    named = folder / "ca.key"
    try:
        authority = Pair((folder / "ca.pem").read_bytes(), named.read_bytes())
        named = folder / "server.pem"
        known = tuple(_all_hosts(hosts) if hosts else hosts_of(named.read_bytes()))
        server = make_server(authority, known, days, now)
        for name, data in (("server.key", server.key), ("server.pem", server.certificate)):
            named = folder / name
            write_whole(named, data, mode=0o600, durable=True)
    except OSError as error:
        raise ConfigError(
            [f"{error.filename or named}: {error.strerror or error}; expected a folder of broker init"]
        ) from None
    except CertificateError as error:
        raise ConfigError([f"{named}: {error}"]) from None
    return known


def certificate_ends(folder: Path) -> datetime.date:
    """Last day of the broker's certificate."""
    return ends((folder / "server.pem").read_bytes())


def _fill(folder: Path, later: Path, wanted: Wanted, now: datetime.datetime) -> None:
    """Write everything into `folder`, which will be `later`."""
    authority = make_authority(now)
    try:
        server = make_server(authority, _all_hosts(wanted.hosts), wanted.days, now)
    except CertificateError as error:
        raise ConfigError([f"--days {wanted.days}: {error}"]) from None
    logins = {name: secrets.token_urlsafe(24) for name in (*wanted.vehicles, *wanted.operators, *wanted.viewers)}
    operators = [Operator(name, new_key()) for name in wanted.operators]
    files = {
        "mosquitto.conf": profile_text(later).encode(),
        "service.conf": profile_text(INSTALLED).encode(),
        "acl": acl_text(wanted.vehicles, wanted.operators, wanted.viewers).encode(),
        "ca.pem": authority.certificate,
        "ca.key": authority.key,
        "server.pem": server.certificate,
        "server.key": server.key,
        "passwords": "".join(f"{name}:{password}\n" for name, password in logins.items()).encode(),
    }
    everybody = operators_text(operators).encode() if operators else None
    own = {operator.name: operators_text([operator]).encode() for operator in operators}
    rooms = [(f"vehicles/{name}", name, everybody) for name in wanted.vehicles]
    rooms += [(f"operators/{name}", name, own[name]) for name in wanted.operators]
    rooms += [(f"viewers/{name}", name, None) for name in wanted.viewers]
    for room, name, keys in rooms:
        (folder / room).mkdir(mode=0o700, parents=True)
        files[f"{room}/login.yaml"] = f'username: "{name}"\npassword: "{logins[name]}"\n'.encode()
        files[f"{room}/ca.pem"] = authority.certificate
        if keys is not None:
            files[f"{room}/operators.yaml"] = keys
    for name, data in files.items():
        write_private(folder / name, data)
    _hash_passwords(folder / "passwords")


def _hash_passwords(path: Path) -> None:
    """``name:password`` lines become ``name:hash`` lines in place; no password is on any command line."""
    tool = shutil.which("mosquitto_passwd")
    if tool is None:
        raise SetupError("mosquitto_passwd is not there: apt install mosquitto")
    try:
        done = subprocess.run(
            [tool, "-U", str(path)],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=_HASH_DEADLINE_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SetupError(f"{tool} -U: {error}") from None
    hashed = [line.split(":", 1)[-1].startswith("$") for line in path.read_text(encoding="utf-8").splitlines()]
    if done.returncode != 0 or not all(hashed):
        raise SetupError(
            f"{tool} -U: exit code {done.returncode}: {' '.join(done.stderr.split()) or 'passwords are not hashed'}"
        )
    os.chmod(path, 0o600)


def _refuse_names(wanted: Wanted) -> None:
    lines = [
        f"{option} {name!r:.60}: expected 1 to 40 letters, digits, '_', '-' or '.'"
        for option, pattern, names in (
            ("--vehicle", VEHICLE_NAME, wanted.vehicles),
            ("--operator", OPERATOR_NAME, wanted.operators),
            ("--viewer", OPERATOR_NAME, wanted.viewers),
        )
        for name in names
        if pattern.fullmatch(name) is None or name in (".", "..")
    ]
    everybody = [*wanted.vehicles, *wanted.operators, *wanted.viewers]
    lines += [
        f"{name}: named twice; every vehicle and person needs a name of its own"
        for name in sorted(set(everybody))
        if everybody.count(name) > 1
    ]
    if not wanted.vehicles:
        lines.append("--vehicle: expected the name of at least one")
    if lines:
        raise ConfigError(lines)
    _refuse_hosts(wanted.hosts)


def _refuse_hosts(hosts: Sequence[str]) -> None:
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
    """This computer's name, if it can stand in a certificate."""
    with contextlib.suppress(OSError):
        name = socket.gethostname()
        if _is_host(name):
            return (name,)
    return ()
