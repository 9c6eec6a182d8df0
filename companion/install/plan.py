"""Plan of an installation: the files and commands that follow from its settings. Pure functions."""

from __future__ import annotations

from dataclasses import dataclass

from companion.install import templates

SERVICE = "companion.service"
PERFORMANCE = "companion-performance.service"
_UNITS = "/etc/systemd/system"
_AT_BOOT = f"{_UNITS}/multi-user.target.wants"
_SYSUSERS = "/etc/sysusers.d/companion.conf"


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of the installation. Paths are those on the vehicle's computer."""

    user: str
    program: str
    """The `companion` executable that the service starts."""
    mission: str
    vehicle: str | None
    arm_serial: str | None
    """Serial number of the arm's USB adapter; None to install no stable device name."""
    force_serial: str | None
    at_boot: bool
    """Whether the service starts at boot."""


@dataclass(frozen=True, slots=True)
class Item:
    """A file or symbolic link to install."""

    path: str
    """Absolute path on the vehicle's computer."""
    why: str
    content: str | None = None
    link: str | None = None
    """Target of a symbolic link; a link has no `content`."""
    mode: int = 0o644


@dataclass(frozen=True, slots=True)
class Command:
    """A command to run as root on the vehicle's computer."""

    argv: tuple[str, ...]
    why: str
    needed: bool = False
    """Whether a failure of the command rolls the installation back. If not, the next boot has the same effect as the command."""

    def __str__(self) -> str:
        return " ".join(self.argv)


@dataclass(frozen=True, slots=True)
class Plan:
    """All files and commands of an installation."""

    items: tuple[Item, ...]
    commands: tuple[Command, ...]


def plan(settings: Settings) -> Plan:
    """Return the files to install, in order, and the commands to run after them."""
    unit = templates.service(settings.user, settings.program, settings.mission, settings.vehicle)
    rules = templates.udev_rules(settings.arm_serial, settings.force_serial)
    items = [
        Item(_SYSUSERS, "service user, without login, member of dialout", templates.sysusers(settings.user)),
        Item("/etc/modules-load.d/companion.conf", "USB serial drivers, loaded at boot", templates.modules()),
        Item("/etc/udev/rules.d/99-companion.rules", "latency timer of 1 ms, stable device names", rules),
        Item(
            "/etc/security/limits.d/companion.conf",
            "real-time limits for members of the dialout group",
            templates.limits(),
        ),
        Item(f"{_UNITS}/{PERFORMANCE}", "the service that sets the full CPU clock", templates.performance_service()),
        Item(f"{_UNITS}/{SERVICE}", "the flight service; it waits for an operator's START", unit),
        Item(f"{_AT_BOOT}/{PERFORMANCE}", "full CPU clock from boot", link=f"{_UNITS}/{PERFORMANCE}"),
    ]
    if settings.at_boot:
        items.append(Item(f"{_AT_BOOT}/{SERVICE}", "starts the service at boot", link=f"{_UNITS}/{SERVICE}"))
    return Plan(
        items=tuple(items),
        commands=(
            Command(("systemd-sysusers", _SYSUSERS), "creates the user", needed=True),
            Command(("modprobe", "-a", "ftdi_sio", "cdc_acm"), "loads the drivers"),
            Command(("udevadm", "control", "--reload"), "reloads the udev rules"),
            Command(
                ("udevadm", "trigger", "--action=add", "--subsystem-match=usb-serial", "--subsystem-match=tty"),
                "applies the udev rules to connected adapters",
            ),
            Command(("systemctl", "daemon-reload"), "reloads the systemd units"),
            Command(("systemctl", "restart", PERFORMANCE), "sets the full CPU clock now"),
        ),
    )


def isolation(cores: int) -> tuple[str, ...]:
    """Return advice on reserving cores on computers with more than two; the installation reserves none."""
    if cores < 3:
        return ()
    rest, own = f"0-{cores - 3}" if cores > 3 else "0", f"{cores - 2},{cores - 1}"
    return (
        f"Cores: none are reserved. If the report shows late ticks, keep cores {own} for the flight:",
        f"  vehicle file                                   computer: {{cpus: [{own.replace(',', ', ')}]}}",
        f"  /etc/systemd/system.conf.d/50-cores.conf       [Manager] CPUAffinity={rest}",
        "isolcpus= can replace CPUAffinity, but only with real-time scheduling: threads are not balanced between isolated cores.",
    )
