"""USB serial adapters that are plugged in, read from /sys."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

FTDI = "0403"
U2D2 = "6014"
"""Product id of the FT232H in a U2D2 (ROBOTIS). The force sensor's USB-RS485 adapter has a different one (6001 FT232R, 6015 FT-X)."""


@dataclass(frozen=True, slots=True)
class Adapter:
    """One USB serial port."""

    tty: str
    """Current name under /dev."""
    vendor: str
    product: str
    """USB vendor and product id, four hexadecimal digits each."""
    serial: str
    """Serial number of the chip; empty if it has none."""
    name: str
    """Product name that the chip reports."""

    def __str__(self) -> str:
        return (
            f"/dev/{self.tty} ({self.vendor}:{self.product} {self.name or 'unnamed'}, serial {self.serial or 'none'})"
        )


def adapters(sysfs: Path = Path("/sys")) -> tuple[Adapter, ...]:
    """Return all USB serial ports, sorted by name."""
    found = []
    for tty in sorted((sysfs / "class/tty").glob("tty[UA][SC][BM]*")):
        device = next((folder for folder in tty.resolve().parents if (folder / "idVendor").is_file()), None)
        if device is not None:
            vendor, product, serial, name = (
                _text(device / key) for key in ("idVendor", "idProduct", "serial", "product")
            )
            found.append(Adapter(tty=tty.name, vendor=vendor, product=product, serial=serial, name=name))
    return tuple(found)


def choose_adapters(
    found: Sequence[Adapter], arm_serial: str | None, force_serial: str | None
) -> tuple[str | None, str | None, tuple[str, ...]]:
    """Return the serial numbers of the arm's and the force sensor's adapter, and one line of explanation for each.

    A given serial number is used unchanged. Otherwise the only remaining FTDI adapter of the right kind is chosen: a U2D2 for the
    arm, any other for the force sensor. The serial number is None if no adapter or more than one fits.
    """
    reasons = []
    chosen: dict[str, str | None] = {"arm": arm_serial, "force": force_serial}
    for which, given in (("arm", arm_serial), ("force", force_serial)):
        if given is not None:
            there = any(adapter.serial == given for adapter in found)
            reasons.append(f"{which}: serial {given}, as given{'' if there else '; it is not plugged in'}")
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
            reasons.append(f"{which}: {fits[0]}, the only one of its kind")
        elif fits:
            reasons.append(
                f"{which}: no stable name: several adapters fit ({', '.join(map(str, fits))}); choose one with --{which}-serial"
            )
        else:
            reasons.append(
                f"{which}: no stable name: no adapter of its kind is plugged in; plug one in, or give --{which}-serial"
            )
    return chosen["arm"], chosen["force"], tuple(reasons)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
