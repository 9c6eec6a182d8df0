"""`companion install`: prepare the vehicle's computer for flights, preview the changes, and revert them."""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import stat
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from companion.config.document import ConfigError
from companion.config.loader import load_flight
from companion.install import apply
from companion.install.adapters import adapters, choose_adapters
from companion.install.apply import Changes
from companion.install.plan import Plan, Settings, isolation, plan
from companion.install.record import RECORD_PATH, load, under_root
from companion.install.state import InstallError
from companion.model.exit_codes import EXIT_ABORTED, EXIT_OK, EXIT_REFUSED
from companion.runtime.console import print_error
from companion.runtime.subprocesses import signals_call

USER = "companion"
MISSION = "/etc/companion/mission.yaml"
PROGRAM = "/opt/companion/.venv/bin/companion"
"""Default of --program with --root (an image prepared on another computer); on the running system the default is this program."""
_NAME = re.compile(r"[a-z_][a-z0-9_-]{0,30}")
_SERIAL = re.compile(r"[A-Za-z0-9._:+-]{1,64}")
_HIDDEN = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")
"""Folders that are hidden from the service (ProtectHome, PrivateTmp)."""


def add_parser(commands: Any) -> None:
    install = commands.add_parser(
        "install",
        help="set up the vehicle's computer: service, adapter names and latency, limits, full CPU clock; or undo this",
        description="Install companion as a systemd service that waits on the ground for an operator's START, with the settings that "
        "its timing needs; or revert the installation exactly. Exit 0: done, or nothing to do; 2: wrong input; 3: failed, "
        "nothing was changed; 4: cancelled.",
    )
    what = install.add_mutually_exclusive_group(required=True)
    what.add_argument("--systemd", action="store_true", help="install the service")
    what.add_argument("--undo", action="store_true", help="restore the state from before the first --systemd")
    install.add_argument(
        "--dry-run", action="store_true", help="only show the changes, with the contents of every file"
    )
    install.add_argument("--yes", action="store_true", help="do not ask for confirmation")
    install.add_argument("--json", action="store_true", help="print only JSON; needs --yes or --dry-run")
    install.add_argument(
        "--user",
        default=USER,
        metavar="NAME",
        help=f"user of the service (default: {USER}); created if it does not exist",
    )
    install.add_argument(
        "--mission", default=MISSION, metavar="FILE", help=f"mission of the service (default: {MISSION})"
    )
    install.add_argument("--vehicle", metavar="FILE", help="vehicle file instead of the mission's")
    install.add_argument(
        "--arm-serial",
        metavar="SERIAL",
        help="serial number of the arm's U2D2 (default: that of the U2D2 that is plugged in)",
    )
    install.add_argument(
        "--force-serial",
        metavar="SERIAL",
        help="serial number of the force sensor's USB adapter (default: that of the adapter that is plugged in)",
    )
    install.add_argument("--at-boot", action="store_true", help="start the service at boot; it waits on the ground")
    install.add_argument("--program", metavar="FILE", help="companion executable of the service (default: this one)")
    install.add_argument(
        "--root",
        type=Path,
        default=Path("/"),
        metavar="DIR",
        help="only change the files of a system below DIR, and run no commands",
    )
    install.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    root = Path(os.path.abspath(arguments.root))
    if not root.is_dir():
        raise ConfigError(f"companion install: --root {arguments.root}: expected the root folder of a system")
    if arguments.json and not (arguments.yes or arguments.dry_run):
        raise ConfigError("companion install: --json cannot ask for confirmation: add --yes or --dry-run")
    if root == Path("/") and os.geteuid() != 0 and not arguments.dry_run:
        print_error(
            f"companion install: needs root: sudo {os.path.abspath(sys.argv[0])} install ...; only --dry-run works without root"
        )
        return EXIT_REFUSED
    try:
        # As at Ctrl-C, unfinished changes are rolled back.
        with signals_call((signal.SIGTERM, signal.SIGHUP), _cancel):
            return _undo(arguments, root) if arguments.undo else _install(arguments, root)
    except InstallError as error:
        print_error(f"companion install: {error}")
        return EXIT_REFUSED
    except (KeyboardInterrupt, EOFError):
        print_error("companion install: cancelled")
        return EXIT_ABORTED


def _install(arguments: argparse.Namespace, root: Path) -> int:
    settings, explanations = _settings(arguments, root)
    wanted = plan(settings)
    found = apply.pending_changes(root, wanted, load(root))
    live = root == Path("/")
    if arguments.dry_run:
        if arguments.json:
            print(json.dumps(_as_json(wanted, found, live, done=False), indent=1))
        else:
            print("\n".join([*explanations, *_shown(wanted, found, live)]))
        return EXIT_OK
    if not arguments.json:
        print("\n".join([*explanations, *(line for _, line in _summary(wanted, found, live))]), flush=True)
    if not arguments.yes and not _agreed("Apply these changes?"):
        print_error("companion install: cancelled; nothing was changed")
        return EXIT_ABORTED
    say = (lambda _: None) if arguments.json else print
    changed = apply.install(root, wanted, settings.user, say)
    if arguments.json:
        print(json.dumps(_as_json(wanted, found, live, done=changed), indent=1))
    elif not changed:
        print("nothing to do: everything is installed")
    else:
        print("\n".join(["", *_afterwards(settings, live), *isolation(os.cpu_count() or 1)]))
    return EXIT_OK


def _undo(arguments: argparse.Namespace, root: Path) -> int:
    record = load(root)
    paths = [] if record is None else [path for path, entry in record.entries.items()]
    if arguments.dry_run or record is None:
        if arguments.json:
            print(json.dumps({"schema_version": 1, "done": False, "files": paths}, indent=1))
        elif record is None:
            print(f"nothing to undo: {RECORD_PATH} does not exist")
        else:
            for path, entry in record.entries.items():
                print(f"{'removes ' if entry.before.absent else 'restores'} {path}")
            for user in record.users:
                print(f"removes the user {user}")
        return EXIT_OK
    if not arguments.yes and not _agreed(f"Restore {len(paths)} files to their previous contents?"):
        print_error("companion install: cancelled; nothing was changed")
        return EXIT_ABORTED
    apply.undo(root, (lambda _: None) if arguments.json else print)
    if arguments.json:
        print(json.dumps({"schema_version": 1, "done": True, "files": paths}, indent=1))
    return EXIT_OK


def _settings(arguments: argparse.Namespace, root: Path) -> tuple[Settings, tuple[str, ...]]:
    """Return the checked settings, and lines that explain their origin; raises ConfigError."""

    live = root == Path("/")
    if _NAME.fullmatch(arguments.user) is None or arguments.user == "root":
        raise ConfigError(f"--user {arguments.user!r:.60}: expected a user name such as {USER}, not root")
    for option in ("arm_serial", "force_serial"):
        given = getattr(arguments, option)
        if given is not None and _SERIAL.fullmatch(given) is None:
            raise ConfigError(
                f"--{option.replace('_', '-')} {given!r:.80}: expected a serial number as udevadm info prints it"
            )
    program = arguments.program or (str(Path(sys.prefix) / "bin/companion") if live else PROGRAM)
    files = {"--program": program, "--mission": arguments.mission, "--vehicle": arguments.vehicle}
    for option, file in files.items():
        if file is not None:
            files[option] = _seen_by_the_service(option, file, root)
    mission, vehicle = files["--mission"], files["--vehicle"]
    assert mission is not None and files["--program"] is not None
    seen = None if vehicle is None else under_root(root, vehicle)
    config = load_flight(
        under_root(root, mission), seen, overrides=["mission.start.takeoff=by_operator"], hardware=True
    )
    mqtt = config.vehicle.ground.mqtt
    if mqtt is None or not mqtt.commands:
        key = "vehicle.ground.mqtt is null" if mqtt is None else "vehicle.ground.mqtt.commands is false"
        raise ConfigError(
            f"{vehicle or mission}: the service waits for an operator's START, but commands are not possible: {key}"
        )
    arm, force, explanations = choose_adapters(adapters() if live else (), arguments.arm_serial, arguments.force_serial)
    return Settings(
        user=arguments.user,
        program=files["--program"],
        mission=mission,
        vehicle=vehicle,
        arm_serial=arm,
        force_serial=force,
        at_boot=arguments.at_boot,
    ), explanations


def _seen_by_the_service(option: str, file: str, root: Path) -> str:
    """Return the absolute path of a file on the vehicle's computer; raises ConfigError if the service could not read it there."""
    path = os.path.abspath(file)
    if any(ord(c) < 32 for c in path):
        raise ConfigError(f"{option} {file!r:.80}: expected a path without control characters")
    if any(path.startswith(f"{folder}/") for folder in _HIDDEN):
        raise ConfigError(
            f"{option} {path}: the service cannot see {'/'.join(path.split('/')[:2])}; copy the file below /etc/companion or /opt"
        )
    here = under_root(root, path)
    if option == "--program" and root != Path("/"):
        return path
    if not here.is_file():
        raise ConfigError(
            f"{option} {here}: no such file; copy a mission and its vehicle file there, or give another path"
        )
    for part in (here.resolve(), *here.resolve().parents):
        wanted = stat.S_IROTH if part == here.resolve() else stat.S_IXOTH
        if part.is_relative_to(root) and part != root and not part.stat().st_mode & wanted:
            raise ConfigError(f"{option} {path}: the service's user cannot read it: chmod o+rX {part}")
    return path


def _summary(wanted: Plan, found: Changes, live: bool) -> Iterator[tuple[str, str]]:
    """Yield each path ("" for a command) with a line about its change."""
    to_do = set(found.to_do)
    why = {item.path: f": {item.why}" for item in wanted.items}
    for path, entry in found.entries.items():
        if path not in to_do:
            verb = "unchanged"
        elif entry.after.absent:
            verb = "removes  "
        else:
            verb = "writes   " if found.now[path].absent else "replaces "
        yield path, f"{verb} {path}{why.get(path, '')}"
    for command in wanted.commands:
        yield "", f"{'runs     ' if live else 'next boot'} {command}: {command.why}"


def _shown(wanted: Plan, found: Changes, live: bool) -> Iterator[str]:
    content = {item.path: item.content if item.link is None else f"-> {item.link}" for item in wanted.items}
    for path, line in _summary(wanted, found, live):
        yield line
        yield from (f"    {text}".rstrip() for text in (content.get(path) or "").splitlines())
    yield f"writes    {RECORD_PATH}: previous contents, for --undo"
    yield "Nothing was changed."


def _afterwards(settings: Settings, live: bool) -> Iterator[str]:
    arm, force = (
        ("/dev/companion-arm" if settings.arm_serial else None),
        ("/dev/companion-force" if settings.force_serial else None),
    )
    if arm or force:
        yield f"Vehicle file: {', '.join(f'devices.{k}.port: {v}' for k, v in (('arm', arm), ('force', force)) if v)}"
    if live:
        yield "Log in again before you fly from a shell: limits and groups are set at login."
    boot = " (it also starts at boot)" if settings.at_boot else ""
    yield f"Start the service with: systemctl start companion{boot}. It then waits for an operator's START."
    yield "Stop it with: systemctl stop companion (a flying vehicle lands first). To undo everything: companion install --undo"


def _as_json(wanted: Plan, found: Changes, live: bool, *, done: bool) -> dict[str, Any]:
    to_do = set(found.to_do)
    return {
        "schema_version": 1,
        "done": done,
        "files": [
            {"path": item.path, "why": item.why, "content": item.content, "link": item.link, "mode": f"{item.mode:04o}",
             "to_do": item.path in to_do, "replaces": item.path in to_do and not found.now[item.path].absent}
            for item in wanted.items
        ],
        "taken_away": [path for path, entry in found.entries.items() if path in to_do and entry.after.absent],
        "commands": [list(command.argv) for command in wanted.commands] if live else [],
    }  # fmt: skip


def _agreed(question: str) -> bool:
    return input(f"{question} [y/N] ").strip().lower() in ("y", "yes")


def _cancel() -> None:
    raise KeyboardInterrupt
