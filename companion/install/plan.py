"""What is to be installed: settings in, files and commands out. Pure."""

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
    """What the user wants. Paths are those on the vehicle's computer."""

    user: str
    program: str
    """The `companion` that the service starts."""
    mission: str
    vehicle: str | None
    arm_serial: str | None
    """Serial numbers of the USB adapters; None: no stable name for it."""
    force_serial: str | None
    at_boot: bool
    """The service starts with the computer."""


@dataclass(frozen=True, slots=True)
class Item:
    """A file or a symbolic link that is to be there."""

    path: str
    """On the vehicle's computer, absolute."""
    why: str
    content: str | None = None
    link: str | None = None
    """Where a symbolic link points; then there is no content."""
    mode: int = 0o644


@dataclass(frozen=True, slots=True)
class Command:
    """A program that is run, as root, on the computer itself."""

    words: tuple[str, ...]
    why: str
    needed: bool = False
    """Without it nothing of the rest makes sense: if it fails, all is put back. Else the next boot does the same."""

    def __str__(self) -> str:
        return " ".join(self.words)


@dataclass(frozen=True, slots=True)
class Plan:
    """Everything that an installation does."""

    items: tuple[Item, ...]
    commands: tuple[Command, ...]


def plan(settings: Settings) -> Plan:
    """Files first, in this order, then commands."""
    unit = templates.service(settings.user, settings.program, settings.mission, settings.vehicle)
    rules = templates.udev_rules(settings.arm_serial, settings.force_serial)
    items = [
        Item(_SYSUSERS, "the service's user, without a login, in dialout", templates.sysusers(settings.user)),
        Item("/etc/modules-load.d/companion.conf", "drivers of USB serial ports, from boot on", templates.modules()),
        Item("/etc/udev/rules.d/99-companion.rules", "latency timer 1 ms, stable names", rules),
        Item("/etc/security/limits.d/companion.conf", "real time for people in dialout", templates.limits()),
        Item(f"{_UNITS}/{PERFORMANCE}", "full clock", templates.performance_service()),
        Item(f"{_UNITS}/{SERVICE}", "the flight, waiting for an operator's start", unit),
        Item(f"{_AT_BOOT}/{PERFORMANCE}", "full clock from boot on", link=f"{_UNITS}/{PERFORMANCE}"),
    ]
    if settings.at_boot:
        items.append(Item(f"{_AT_BOOT}/{SERVICE}", "the flight waits from boot on", link=f"{_UNITS}/{SERVICE}"))
    return Plan(
        items=tuple(items),
        commands=(
            Command(("systemd-sysusers", _SYSUSERS), "makes the user", needed=True),
            Command(("modprobe", "-a", "ftdi_sio", "cdc_acm"), "loads the drivers"),
            Command(("udevadm", "control", "--reload"), "reads the rules"),
            Command(
                ("udevadm", "trigger", "--action=add", "--subsystem-match=usb-serial", "--subsystem-match=tty"),
                "applies them to what is plugged in",
            ),
            Command(("systemctl", "daemon-reload"), "reads the units"),
            Command(("systemctl", "restart", PERFORMANCE), "full clock now"),
        ),
    )


def isolation(cores: int) -> tuple[str, ...]:
    """A suggestion in words for computers with more than two cores; nothing of it is ever done by the program."""
    if cores < 3:
        return ()
    rest, own = f"0-{cores - 3}" if cores > 3 else "0", f"{cores - 2},{cores - 1}"
    return (
        f"Cores: nothing is reserved. Should the report show late ticks, keep cores {own} for the flight:",
        f"  vehicle file                                   computer: {{cpus: [{own.replace(',', ', ')}]}}",
        f"  /etc/systemd/system.conf.d/50-cores.conf       [Manager] CPUAffinity={rest}",
        "isolcpus= does the same as the second, but only with real-time scheduling: nothing balances threads between isolated cores.",
    )
