"""`companion broker`: create a broker's users and certificates, and show what a login may do at a broker."""

from __future__ import annotations

import argparse
import datetime
import os
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion import DISTRIBUTION
from companion.config.document import ConfigError
from companion.ground.protocol.keys import user_name
from companion.ground.protocol.messages import Topic
from companion.model.exit_codes import EXIT_OK, EXIT_REFUSED
from companion.runtime.console import print_error

if TYPE_CHECKING:
    from companion.ground.broker.check import CheckResult
    from companion.ground.broker.setup import BrokerUsers

VEHICLE = "tarot650-2r"
"""Name of the vehicle in the supplied vehicle file."""


def add_parser(commands: Any) -> None:
    broker = commands.add_parser("broker", help="a broker for several computers: users, certificates, permissions")
    parts = broker.add_subparsers(dest="part", required=True, metavar="PART")
    init = parts.add_parser(
        "init",
        help="create users, keys and certificates for a mosquitto broker",
        description="Create a folder with all files that a mosquitto broker with logins and TLS needs, and in it a folder for each "
        "computer that connects. Exit 0: created; 2: a name is invalid or the folder is not empty; 3: a tool or package is missing.",
    )
    init.add_argument("folder", metavar="DIR", help="folder to create; must not exist or must be empty")
    several = {"action": "extend", "nargs": "+", "default": [], "metavar": "NAME"}
    init.add_argument(
        "--host", **several, help="names and addresses of the broker's computer (default: the name of this computer)"
    )
    init.add_argument("--operator", **several, help="names of operators, who may send commands (default: you)")
    init.add_argument("--viewer", **several, help="names of viewers, who may only watch (default: viewer)")
    init.add_argument("--vehicle", **several, help=f"names of vehicles in topics (default: {VEHICLE})")
    init.add_argument(
        "--days", type=_days, default=730, help="validity of the broker's certificate in days (default: 730)"
    )
    init.add_argument("--renew-certificates", action="store_true", help="only renew the broker's certificate in DIR")
    init.set_defaults(run=_init)

    check = parts.add_parser(
        "check",
        help="show what a login may read and write at a broker",
        description="Connect, subscribe and publish an empty message on every topic. Exit 0: connected; 2: wrong input; 3: no "
        "connection.",
    )
    check.add_argument("url", metavar="URL", help="mqtt://HOST:PORT, or mqtts://HOST:PORT with TLS")
    check.add_argument("--login", metavar="FILE", help="YAML file with username and password")
    check.add_argument("--ca", metavar="FILE", help="CA certificate (PEM) to verify the broker's certificate")
    check.add_argument(
        "--vehicle",
        metavar="NAME",
        help="vehicle whose topics are tested; it counts one rejected message (default: a name that no vehicle has)",
    )
    check.set_defaults(run=_check)


def _days(text: str) -> int:
    from companion.ground.broker.setup import DAYS_MAX

    if not text.isdecimal() or not 1 <= int(text) <= DAYS_MAX:
        raise argparse.ArgumentTypeError(f"expected a number of days from 1 to {DAYS_MAX}, got '{text}'")
    return int(text)


def _init(arguments: argparse.Namespace) -> int:
    try:
        from companion.ground.broker import setup as broker_setup
    except ImportError as error:
        if (error.name or "").partition(".")[0] != "cryptography":
            raise
        print_error(f"companion broker init: certificates need cryptography: pip install '{DISTRIBUTION}[ground]'")
        return EXIT_REFUSED
    if not arguments.folder.strip():
        raise ConfigError("companion broker init: DIR: expected the name of a folder, got an empty name")
    folder = Path(arguments.folder).absolute()
    now = datetime.datetime.now(datetime.UTC)
    if arguments.renew_certificates:
        if arguments.operator or arguments.viewer or arguments.vehicle:
            raise ConfigError(
                "companion broker init: --renew-certificates creates no users: remove --operator, --viewer and --vehicle"
            )
        hosts = broker_setup.renew_certificate(folder, arguments.host, arguments.days, now)
        print(
            f"{folder}/server.pem, server.key: for {', '.join(hosts)}, until {broker_setup.certificate_expiry(folder)}"
        )
        print("Restart the broker so that it reads them. No other computer needs a new file.")
        return EXIT_OK
    users = broker_setup.BrokerUsers(
        hosts=tuple(arguments.host) or broker_setup.this_host(),
        operators=tuple(arguments.operator) or (user_name(),),
        viewers=tuple(arguments.viewer) or ("viewer",),
        vehicles=tuple(arguments.vehicle) or (VEHICLE,),
        days=arguments.days,
    )
    try:
        broker_setup.create(folder, users, now)
    except broker_setup.SetupError as error:
        print_error(f"companion broker init: {error}")
        return EXIT_REFUSED
    print("\n".join(_instructions(folder, users, str(broker_setup.certificate_expiry(folder)))))
    return EXIT_OK


def _instructions(folder: Path, users: BrokerUsers, ends: str) -> list[str]:
    host = (*users.hosts, "localhost")[0]
    url = f"mqtts://{f'[{host}]' if ':' in host else host}:8883"
    here = shlex.quote(str(folder))
    lines = [f"created {folder}: the broker's certificate is valid until {ends}", ""]
    if os.geteuid() != 0:
        lines += ["Broker, by hand:", f"  mosquitto -c {here}/mosquitto.conf", ""]
    lines += [
        "Broker, as the system service:",
        "  sudo install -d -o mosquitto -g mosquitto -m 700 /etc/mosquitto/companion",
        f"  cd {here} && sudo install -o mosquitto -g mosquitto -m 600 passwords acl server.pem server.key /etc/mosquitto/companion",
        f"  sudo install -m 644 {here}/service.conf /etc/mosquitto/conf.d/companion.conf && sudo systemctl restart mosquitto",
        "",
    ]
    for name in users.vehicles:
        lines += [
            f"Vehicle {name}: copy {folder}/vehicles/{name} to its computer, for example to /etc/companion, "
            "owned by the user who runs companion.",
            "Vehicle file:",
            "  ground:",
            f"    topic: {name}",
            "    mqtt:",
            f"      url: {url}",
            "      login_file: /etc/companion/login.yaml",
            "      ca_file: /etc/companion/ca.pem",
            "      operators_file: /etc/companion/operators.yaml",
            "",
        ]
    for name in users.operators:
        lines += [
            f"Operator {name}: copy {folder}/operators/{name} to the computer of {name}. In that folder run:",
            f"  companion monitor --broker {url} --login login.yaml --ca ca.pem --operator {name} --operators operators.yaml",
            "",
        ]
    for name in users.viewers:
        lines += [
            f"Viewer {name}: copy {folder}/viewers/{name} to the viewer's computer. In that folder run:",
            f"  companion monitor --broker {url} --login login.yaml --ca ca.pem --view-only",
            "",
        ]
    return [
        *lines,
        "Each folder contains credentials: copy it only to the computer that it is named for (scp -rp), and keep ca.key here.",
    ]


def _check(arguments: argparse.Namespace) -> int:
    from companion.config.ground import VEHICLE_NAME
    from companion.ground.broker.check import CheckError, check
    from companion.ground.protocol.access import broker_access

    if arguments.vehicle is not None and VEHICLE_NAME.fullmatch(arguments.vehicle) is None:
        raise ConfigError(f"--vehicle {arguments.vehicle!r:.60}: expected 1 to 40 letters, digits, '_', '-' or '.'")
    access = broker_access(arguments.url, arguments.login, arguments.ca)
    try:
        found = check(access, arguments.vehicle)
    except CheckError as error:
        print_error(error)
        return EXIT_REFUSED
    who = access.username or "anonymous (no login)"
    print(f"{access.address}: connected as {who}{', ' + found.tls if found.tls else ', not encrypted'}")
    if found.certificate_ends is not None:
        print(f"certificate valid until {found.certificate_ends}")
    print("\n".join(table(found)))
    return EXIT_OK


def table(found: CheckResult) -> list[str]:
    """Return a table of the permissions."""
    words = {True: "yes", False: "no", None: "?"}
    lines = [f"{'':10} read  write"]
    lines += [f"{right.topic.value:10} {words[right.read]:5} {words[right.write]}" for right in found.rights]
    if any(right.read is None for right in found.rights):
        lines.append("?: subscribing is permitted, but there was no message to receive")
    lines.append(f"vehicles present: {', '.join(found.vehicles) or 'none'}")
    command = next(right for right in found.rights if right.topic is Topic.COMMAND)
    if command.write:
        lines.append("this broker forwards commands; the vehicle accepts those signed by an operator")
    return lines
