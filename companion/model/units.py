"""Units that the names of keys, fields and columns state by their suffix."""

from __future__ import annotations

from typing import Final

UNITS: Final = {
    "m": "m", "mm": "mm", "us": "us", "ms": "ms", "s": "s", "deg": "deg", "rad": "rad", "counts": "counts", "count": "counts",
    "m_s": "m/s", "m_s2": "m/s^2", "m_s3": "m/s^3", "deg_s": "deg/s", "deg_s2": "deg/s^2", "deg_s3": "deg/s^3",
    "rad_s": "rad/s", "rad_s2": "rad/s^2", "hz": "Hz", "1_s": "1/s", "per_s": "1/s", "per_m": "1/m",
    "kg": "kg", "kg_m": "kg m", "kg_m2": "kg m^2", "n": "N", "n_m": "N/m", "n_per_m": "N/m", "per_n_m": "m/N", "g_per_m": "g/m",
    "nm": "N m", "nms": "N m s", "nm_a": "N m/A", "a": "A", "v": "V", "c": "degC", "wxyz": "unit quaternion w, x, y, z",
}  # fmt: skip
_WITHOUT: Final = frozenset({"row_weights_s"})
"""Names without a unit that nevertheless end like a unit."""


def split_unit(name: str, units: dict[str, str] = UNITS) -> tuple[str, str | None]:
    """Split a name before its longest suffix in `units`: `duration_ms` gives ("duration", "ms"), without a unit (name, None)."""
    words = name.split("_")
    for count in (3, 2, 1):
        suffix = "_".join(words[-count:]).lower()
        if len(words) > count and suffix in units and name not in _WITHOUT:
            return "_".join(words[:-count]), suffix
    return name, None


def unit_of(name: str) -> str | None:
    """Return the unit that a name states, or None."""
    _, suffix = split_unit(name)
    return None if suffix is None else UNITS[suffix]
