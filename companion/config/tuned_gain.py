"""What a control law declares for `companion tune`: which of its gains are searched, and within which bounds."""

from __future__ import annotations

from dataclasses import dataclass

Rows = tuple[int, int | None]
"""The first value of a list, and the one after the last; None for the end of the list."""
XY: Rows = (0, 2)
Z: Rows = (2, 3)
XYZ: Rows = (0, 3)
JOINTS: Rows = (6, None)
"""The joints in a list of rows, x y z | roll pitch yaw | joints."""
EACH: Rows = (0, None)
"""All values of a list, such as one of joint gains."""


@dataclass(frozen=True, slots=True)
class TunedGain:
    """A number, or some values of a list, that the search multiplies by one common factor, on a logarithmic scale.

    A value of 0 switches a part of the law off, and the search leaves it off.
    """

    key: str
    """Key of the settings, or a property of them that `ControllerConfig.with_gains` accepts."""
    low: float
    """Lower bound. If the gain is proportional to mass or inertia (`LawConfig.scaled_by_mass`, `scaled_by_row`, `scaled_by_joint`), the
    bounds are those of the gain divided by the vehicle's mass, or by the inertia of the joint."""
    high: float
    rows: Rows = EACH
    """Which values of a list."""
    scaled_as: str = ""
    """Key that tells how the gain follows the vehicle, for a property; empty for `key` itself."""
    only_with: str = ""
    """Key without whose value (0) the gain has no effect, so that it is not searched; empty for none."""

    @property
    def place(self) -> slice:
        """Return the place of the values in a list."""
        return slice(*self.rows)
