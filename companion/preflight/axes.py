"""The 48 signed permutations of three axes: 24 rotations and 24 reflections. Pure functions."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

from companion.model.frames import quat_normalize
from companion.model.types import Quat, Vec3

_LETTERS = "xyz"


@dataclass(frozen=True)
class AxisMap:
    """Map between true and streamed axes: streamed axis i is `sign[i]` times true axis `index[i]`."""

    index: tuple[int, int, int]
    sign: tuple[int, int, int]

    @classmethod
    def of(cls, names: tuple[str, str, str]) -> AxisMap:
        """Return the map for names such as ("x", "z", "-y")."""
        x, y, z = (_LETTERS.index(name[-1]) for name in names)
        a, b, c = (-1 if name[0] == "-" else 1 for name in names)
        return cls((x, y, z), (a, b, c))

    @property
    def names(self) -> tuple[str, str, str]:
        """Return the true axes of the streamed x, y and z, such as ("x", "z", "-y")."""
        x, y, z = (("-" if s < 0 else "") + _LETTERS[i] for i, s in zip(self.index, self.sign, strict=True))
        return (x, y, z)

    @cached_property
    def determinant(self) -> int:
        """Return 1 for a rotation, -1 for a reflection."""
        a, b, c = self.index
        parity = 1 if (a, b, c) in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) else -1
        return parity * self.sign[0] * self.sign[1] * self.sign[2]

    @property
    def inverse(self) -> AxisMap:
        """Return the inverse map."""
        index, sign = [0, 0, 0], [1, 1, 1]
        for streamed, (true, factor) in enumerate(zip(self.index, self.sign, strict=True)):
            index[true], sign[true] = streamed, factor
        return AxisMap((index[0], index[1], index[2]), (sign[0], sign[1], sign[2]))

    def vector(self, true: Vec3) -> Vec3:
        """Convert a true vector to the streamed one."""
        (a, b, c), (i, j, k) = self.sign, self.index
        return (a * true[i], b * true[j], c * true[k])

    def rotation(self, true: Quat) -> Quat:
        """Convert a true rotation R to the streamed R A R', of a server that permutes the body axes too; a rotation for any A."""
        x, y, z = self.vector((true[1], true[2], true[3]))
        d = self.determinant
        return (true[0], d * x, d * y, d * z)

    @cached_property
    def quat(self) -> Quat:
        """Return the map as a quaternion (w, x, y, z) that rotates true vectors to streamed ones; the determinant must be 1.

        Raises:
            ValueError: the map is a reflection.
        """
        if self.determinant < 0:
            raise ValueError(f"axes {self.names} are left-handed: no rotation")
        m = [[s if column == i else 0 for column in range(3)] for i, s in zip(self.index, self.sign, strict=True)]
        trace = m[0][0] + m[1][1] + m[2][2]
        w = math.sqrt(max(0.0, 1.0 + trace)) / 2.0
        if w > 0.1:
            k = 1.0 / (4.0 * w)
            return (w, k * (m[2][1] - m[1][2]), k * (m[0][2] - m[2][0]), k * (m[1][0] - m[0][1]))
        # Half a turn: the axis is the largest column of R + 1.
        columns = [tuple(float(m[row][column] + (row == column)) for row in range(3)) for column in range(3)]
        x, y, z = max(columns, key=lambda column: sum(part * part for part in column))
        return quat_normalize((0.0, x, y, z))


IDENTITY: Final = AxisMap((0, 1, 2), (1, 1, 1))
Y_UP: Final = AxisMap.of(("x", "z", "-y"))
"""Axis map of a stream with y up, Motive's other setting, in a world with z up."""
ALL: Final = tuple(
    AxisMap((i, j, k), (a, b, c))
    for i, j, k in itertools.permutations(range(3))
    for a, b, c in itertools.product((1, -1), repeat=3)
)
ROTATIONS: Final = tuple(axes for axes in ALL if axes.determinant > 0)
MIRRORINGS: Final = tuple(axes for axes in ALL if axes.determinant < 0)
