"""USB serial adapters that are plugged in, as /sys tells of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

FTDI = "0403"
U2D2 = "6014"
"""Product of the FT232H in a U2D2 (ROBOTIS); the force sensor's USB-RS485 adapter has another (6001, FT232R; 6015, FT-X)."""


@dataclass(frozen=True, slots=True)
class Adapter:
    """One USB serial port."""

    tty: str
    """Its name under /dev, today."""
    vendor: str
    product: str
    """USB ids, four hexadecimal digits."""
    serial: str
    """Of the chip; empty: it has none."""
    name: str
    """What the chip calls itself."""

    def __str__(self) -> str:
        return f"/dev/{self.tty} ({self.vendor}:{self.product} {self.name or 'without a name'}, serial {self.serial or 'none'})"


def adapters(sysfs: Path = Path("/sys")) -> tuple[Adapter, ...]:
    """All USB serial ports, in the order of their names."""
    found = []
    for tty in sorted((sysfs / "class/tty").glob("tty[UA][SC][BM]*")):
        device = next((folder for folder in tty.resolve().parents if (folder / "idVendor").is_file()), None)
        if device is not None:
            vendor, product, serial, name = (
                _text(device / key) for key in ("idVendor", "idProduct", "serial", "product")
            )
            found.append(Adapter(tty.name, vendor, product, serial, name))
    return tuple(found)


def choose(
    found: Sequence[Adapter], arm_serial: str | None, force_serial: str | None
) -> tuple[str | None, str | None, tuple[str, ...]]:
    """Serial numbers of the arm's and of the force sensor's adapter, and a line of why for each.

    What was given is taken as it is. Else the only FTDI adapter of the right kind that is left: a U2D2 for the arm, another for the
    force sensor. None: nothing fits, or more than one does.
    """
    told = []
    chosen: dict[str, str | None] = {"arm": arm_serial, "force": force_serial}
    for which, given in (("arm", arm_serial), ("force", force_serial)):
        if given is not None:
            there = any(adapter.serial == given for adapter in found)
            told.append(f"{which}: serial {given}, as given{'' if there else '; it is not plugged in now'}")
            continue
        fits = [
            adapter
            for adapter in found
            if adapter.vendor == FTDI
            and adapter.serial
            and adapter.serial not in chosen.values()
            and (adapter.product == U2D2) == (which == "arm")
        ]
        if len(fits) == 1:
            chosen[which] = fits[0].serial
            told.append(f"{which}: {fits[0]}, the only one of its kind")
        elif fits:
            told.append(
                f"{which}: no stable name: {', '.join(map(str, fits))} would fit; say which with --{which}-serial"
            )
        else:
            told.append(
                f"{which}: no stable name: no adapter of its kind is plugged in; plug it in, or give --{which}-serial"
            )
    return chosen["arm"], chosen["force"], tuple(told)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
