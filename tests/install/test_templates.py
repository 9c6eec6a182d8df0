"""The installed files as systemd, udev and a shell read them."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from companion.cli.main import _normalised, make_parser
from companion.install import templates
from companion.install.adapters import adapters, choose_adapters
from companion.runtime.realtime import FLIGHT_PRIORITY, GUARDIAN_PRIORITY

PROGRAM = str(Path(sys.prefix) / "bin/companion")


def value(text: str, key: str) -> str:
    """Return the value of the one line KEY=VALUE."""
    [found] = re.findall(rf"^{key}=(.*)$", text, flags=re.M)
    return str(found)


def test_systemd_accepts_the_units(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not here (Debian package systemd)")
    awkward = "/etc/companion/a mission, 100% $HOME.yaml"
    units = {
        "companion.service": templates.service("companion", PROGRAM, awkward, None),
        "companion-performance.service": templates.performance_service(),
    }
    for name, text in units.items():
        (tmp_path / name).write_text(text)
    ended = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", "--recursive-errors=no", *(str(tmp_path / name) for name in units)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    told = [line for line in ended.stderr.splitlines() if any(name in line for name in units)]
    assert (ended.returncode, told) == (0, []), ended.stderr


def test_udev_accepts_the_rules(tmp_path: Path) -> None:
    tool = shutil.which("udevadm")
    if tool is None:
        pytest.skip("udevadm is not here (Debian package udev)")
    rules = tmp_path / "99-companion.rules"
    rules.write_text(templates.udev_rules("FT4THVLI", "A10M"))
    ended = subprocess.run([tool, "verify", str(rules)], capture_output=True, text=True, check=False)
    if "Unknown command" in ended.stderr:
        pytest.skip("this udevadm cannot verify rules (it can from 254 on)")
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_every_rule_is_a_list_of_matches_and_assignments() -> None:
    """udev(7): an invalid rule is skipped with a line in a log."""
    term = r'[A-Z]+(\{[A-Za-z_]+\})?(==|!=|\+=|=)"[^"]*"'
    for line in templates.udev_rules("FT4THVLI", "A10M").splitlines():
        assert line.startswith("#") or re.fullmatch(rf"{term}(, {term})*", line), line
    assert "SYMLINK" not in templates.udev_rules(None, None)


def test_the_service_starts_a_flight_that_waits_on_the_ground() -> None:
    unit = templates.service("companion", "/opt/companion/bin/companion", "/etc/m.yaml", "/etc/v.yaml")
    program, *words = value(unit, "ExecStart").split()
    assert program == "/opt/companion/bin/companion"
    arguments, unknown = make_parser().parse_known_args(_normalised(words))
    assert unknown == []
    assert (arguments.command, arguments.mission, arguments.vehicle) == ("fly", "/etc/m.yaml", "/etc/v.yaml")
    assert arguments.wait_for_start
    assert arguments.sitl is None


def test_nothing_starts_a_flight_again_and_stopping_lands() -> None:
    unit = templates.service("companion", "/opt/companion/bin/companion", "/etc/m.yaml", None)
    assert value(unit, "Restart") == "no"
    assert value(unit, "KillSignal") == "SIGTERM"
    assert value(unit, "KillMode") == "process"  # a SIGTERM to all would end the guardian in the air
    assert int(value(unit, "TimeoutStopSec")) >= 120
    assert "SystemCallFilter" not in unit
    assert "CPUSchedulingPolicy" not in unit
    assert "PrivateDevices" not in unit


def test_the_limits_allow_what_the_processes_ask_for() -> None:
    unit = templates.service("companion", "/opt/companion/bin/companion", "/etc/m.yaml", None)
    assert int(value(unit, "LimitRTPRIO")) >= max(FLIGHT_PRIORITY, GUARDIAN_PRIORITY)
    assert value(unit, "LimitMEMLOCK") == "infinity"
    assert f"@dialout - rtprio {value(unit, 'LimitRTPRIO')}\n" in templates.limits()


def test_full_clock_is_set_and_what_was_is_put_back(tmp_path: Path) -> None:
    """The service's own command lines, in a shell, on files that replace /sys."""
    before = {"policy0": "ondemand", "policy4": "schedutil"}
    for name, governor in before.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "scaling_governor").write_text(f"{governor}\n")
    unit = templates.performance_service(f"{tmp_path}/policy*/scaling_governor", f"{tmp_path}/before")

    def run(key: str) -> dict[str, str]:
        command = re.fullmatch(r"/bin/sh -c '(.*)'", value(unit, key))
        assert command is not None
        subprocess.run(["/bin/sh", "-c", command[1].replace("$$", "$")], check=True)
        return {name: (tmp_path / name / "scaling_governor").read_text().strip() for name in before}

    assert run("ExecStart") == dict.fromkeys(before, "performance")
    assert run("ExecStop") == before


def plug(sysfs: Path, tty: str, product: str, serial: str, vendor: str = "0403") -> None:
    """Create what the kernel shows for a USB serial port: the class links to the port, three folders below its USB device."""
    device = sysfs / f"devices/usb1/1-{tty}"
    port = device / f"1-{tty}:1.0/{tty}/tty/{tty}"
    port.mkdir(parents=True)
    for key, text in {"idVendor": vendor, "idProduct": product, "serial": serial, "product": "USB Serial"}.items():
        (device / key).write_text(f"{text}\n")
    (sysfs / "class/tty").mkdir(parents=True, exist_ok=True)
    (sysfs / "class/tty" / tty).symlink_to(port)


def test_adapters_are_found_and_distinguished(tmp_path: Path) -> None:
    plug(tmp_path, "ttyUSB0", "6001", "A10M")
    plug(tmp_path, "ttyUSB1", "6014", "FT4THVLI")
    plug(tmp_path, "ttyACM0", "0032", "0", vendor="26ac")  # an autopilot
    (tmp_path / "class/tty/ttyS0").mkdir()
    found = adapters(tmp_path)
    assert [(a.tty, a.serial) for a in found] == [("ttyACM0", "0"), ("ttyUSB0", "A10M"), ("ttyUSB1", "FT4THVLI")]
    assert choose_adapters(found, None, None)[:2] == ("FT4THVLI", "A10M")
    assert choose_adapters(found, "X", None)[:2] == ("X", "A10M")
    assert "not plugged in" in choose_adapters(found, "X", None)[2][0]


def test_adapters_that_cannot_be_distinguished_are_not_guessed(tmp_path: Path) -> None:
    plug(tmp_path, "ttyUSB0", "6014", "FT1")
    plug(tmp_path, "ttyUSB1", "6014", "FT2")
    arm, force, (about_arm, about_force) = choose_adapters(adapters(tmp_path), None, None)
    assert (arm, force) == (None, None)
    assert "FT1" in about_arm
    assert "--arm-serial" in about_arm
    assert "--force-serial" in about_force
    assert choose_adapters(adapters(tmp_path), "FT2", None)[0] == "FT2"
    assert adapters(tmp_path / "nothing") == ()
