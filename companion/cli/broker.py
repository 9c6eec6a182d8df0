"""`companion broker`: make a broker's users and certificates, and see what a broker lets a login do."""

from __future__ import annotations

import argparse
import datetime
import os
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion.config.document import ConfigError
from companion.ground.protocol.keys import user_name
from companion.ground.protocol.messages import Topic
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_OK, EXIT_REFUSED
from companion.runtime.console import tell

if TYPE_CHECKING:
    from companion.ground.broker.check import Found
    from companion.ground.broker.setup import Wanted

VEHICLE = "tarot650-2r"
"""Name of the supplied vehicle file's vehicle."""


def add_parser(commands: Any) -> None:
    """Add `broker` to the sub-parsers of `companion`."""
    broker = commands.add_parser("broker", help="a broker for several computers: users, certificates, what it allows")
    parts = broker.add_subparsers(dest="part", required=True, metavar="PART")
    init = parts.add_parser(
        "init",
        help="make users, keys and certificates for a mosquitto",
        description="Make a folder with everything that a mosquitto with logins and TLS needs, and a folder in it for each computer "
        "that connects. Exit 0: made; 2: a name is wrong, or something is there already; 3: a tool or package is missing.",
    )
    init.add_argument("folder", metavar="DIR", help="not there yet, or empty")
    several = {"action": "extend", "nargs": "+", "default": [], "metavar": "NAME"}
    init.add_argument(
        "--host", **several, help="names and addresses of the broker's computer (default: this one's name)"
    )
    init.add_argument("--operator", **several, help="who may command (default: you)")
    init.add_argument("--viewer", **several, help="who may look on (default: viewer)")
    init.add_argument("--vehicle", **several, help=f"names of vehicles in topics (default: {VEHICLE})")
    init.add_argument(
        "--days", type=_days, default=730, help="how long the broker's certificate is valid (default: 730)"
    )
    init.add_argument(
        "--renew-certificates", action="store_true", help="only a new certificate for the broker of DIR; all else stays"
    )
    init.set_defaults(run=_init)

    check = parts.add_parser(
        "check",
        help="what does a broker let a login do?",
        description="Connect, subscribe and publish an empty message on every topic. Exit 0: connected; 2: wrong input; 3: no "
        "connection.",
    )
    check.add_argument("url", metavar="URL", help="mqtt://HOST:PORT, or mqtts://HOST:PORT with TLS")
    check.add_argument("--login", metavar="FILE", help="YAML file with username and password")
    check.add_argument("--ca", metavar="FILE", help="certificate of the authority that signed the broker's")
    check.add_argument(
        "--vehicle", metavar="NAME", help="whose topics to write to, for a vehicle's own login (default: of no vehicle)"
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
        tell("companion broker init: certificates need cryptography: pip install 'companion[ground]'")
        return EXIT_REFUSED
    if not arguments.folder.strip():
        tell("companion broker init: DIR: expected the name of a folder, got an empty one")
        return EXIT_BAD_INPUT
    folder = Path(arguments.folder).absolute()
    now = datetime.datetime.now(datetime.UTC)
    if arguments.renew_certificates:
        if arguments.operator or arguments.viewer or arguments.vehicle:
            tell(
                "companion broker init: --renew-certificates makes no users: expected no --operator, --viewer, --vehicle"
            )
            return EXIT_BAD_INPUT
        hosts = broker_setup.renew(folder, arguments.host, arguments.days, now)
        print(f"{folder}/server.pem, server.key: for {', '.join(hosts)}, until {broker_setup.certificate_ends(folder)}")
        print("The broker reads them when it starts: restart it. Nobody else needs a new file.")
        return EXIT_OK
    wanted = broker_setup.Wanted(
        hosts=tuple(arguments.host) or broker_setup.this_host(),
        operators=tuple(arguments.operator) or (user_name(),),
        viewers=tuple(arguments.viewer) or ("viewer",),
        vehicles=tuple(arguments.vehicle) or (VEHICLE,),
        days=arguments.days,
    )
    try:
        broker_setup.make(folder, wanted, now)
    except broker_setup.SetupError as error:
        tell(f"companion broker init: {error}")
        return EXIT_REFUSED
    print("\n".join(_instructions(folder, wanted, str(broker_setup.certificate_ends(folder)))))
    return EXIT_OK


def _instructions(folder: Path, wanted: Wanted, ends: str) -> list[str]:
    """What to copy where."""
    host = (*wanted.hosts, "localhost")[0]
    url = f"mqtts://{f'[{host}]' if ':' in host else host}:8883"
    here = shlex.quote(str(folder))
    lines = [f"made {folder}: broker's certificate until {ends}", ""]
    if os.geteuid() != 0:
        lines += ["Broker, by hand:", f"  mosquitto -c {here}/mosquitto.conf", ""]
    lines += [
        "Broker, as the system service:",
        "  sudo install -d -o mosquitto -g mosquitto -m 700 /etc/mosquitto/companion",
        f"  cd {here} && sudo install -o mosquitto -g mosquitto -m 600 passwords acl server.pem server.key /etc/mosquitto/companion",
        f"  sudo install -m 644 {here}/service.conf /etc/mosquitto/conf.d/companion.conf && sudo systemctl restart mosquitto",
        "",
    ]
    for name in wanted.vehicles:
        lines += [
            f"Vehicle {name}: copy {folder}/vehicles/{name} to its computer, say to /etc/companion; its owner is the user that flies.",
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
    for name in wanted.operators:
        lines += [
            f"Operator {name}: copy {folder}/operators/{name} to the computer of {name}. In it:",
            f"  companion monitor --broker {url} --login login.yaml --ca ca.pem --operator {name} --operators operators.yaml",
            "",
        ]
    for name in wanted.viewers:
        lines += [
            f"Viewer {name}: copy {folder}/viewers/{name}. In it:",
            f"  companion monitor --broker {url} --login login.yaml --ca ca.pem --view-only",
            "",
        ]
    return [
        *lines,
        "Whoever has a folder is who it names: copy each to its computer only (scp -rp), and keep ca.key here.",
    ]


def _check(arguments: argparse.Namespace) -> int:
    from companion.config.ground import VEHICLE_NAME
    from companion.ground.broker.check import CheckError, check
    from companion.ground.protocol.access import broker_access

    if arguments.vehicle is not None and VEHICLE_NAME.fullmatch(arguments.vehicle) is None:
        raise ConfigError([f"--vehicle {arguments.vehicle!r:.60}: expected 1 to 40 letters, digits, '_', '-' or '.'"])
    access = broker_access(arguments.url, arguments.login, arguments.ca)
    try:
        found = check(access, arguments.vehicle)
    except CheckError as error:
        tell(error)
        return EXIT_REFUSED
    who = access.username or "anybody (no login)"
    print(f"{access.address}: connected as {who}{', ' + found.tls if found.tls else ', not encrypted'}")
    if found.certificate_ends is not None:
        print(f"certificate valid until {found.certificate_ends}")
    print("\n".join(table(found)))
    return EXIT_OK


def table(found: Found) -> list[str]:
    """What may be read and written, for people."""
    words = {True: "yes", False: "no", None: "?"}
    lines = [f"{'':10} read  write"]
    lines += [f"{right.topic.value:10} {words[right.read]:5} {words[right.write]}" for right in found.rights]
    if any(right.read is None for right in found.rights):
        lines.append("?: it may be subscribed to, but nothing was there that could have come")
    lines.append(f"vehicles heard: {', '.join(found.vehicles) or 'none'}")
    command = next(right for right in found.rights if right.topic is Topic.COMMAND)
    if command.write:
        lines.append("commands pass this broker; the vehicle takes those that an operator has signed")
    return lines
