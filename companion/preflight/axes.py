"""The 48 ways in which three axes can be exchanged and turned round: 24 rotations, 24 mirrorings. Pure."""

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
    """Streamed axis i is `sign[i]` times true axis `index[i]`."""

    index: tuple[int, int, int]
    sign: tuple[int, int, int]

    @classmethod
    def of(cls, names: tuple[str, str, str]) -> AxisMap:
        """From names such as ("x", "z", "-y")."""
        x, y, z = (_LETTERS.index(name[-1]) for name in names)
        a, b, c = (-1 if name[0] == "-" else 1 for name in names)
        return cls((x, y, z), (a, b, c))

    @property
    def names(self) -> tuple[str, str, str]:
        """As ("x", "z", "-y"): what the streamed x, y and z truly are."""
        x, y, z = (("-" if s < 0 else "") + _LETTERS[i] for i, s in zip(self.index, self.sign, strict=True))
        return (x, y, z)

    @cached_property
    def determinant(self) -> int:
        """1 for a rotation, -1 for a mirroring."""
        a, b, c = self.index
        parity = 1 if (a, b, c) in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) else -1
        return parity * self.sign[0] * self.sign[1] * self.sign[2]

    @property
    def inverse(self) -> AxisMap:
        """The way back."""
        index, sign = [0, 0, 0], [1, 1, 1]
        for streamed, (true, factor) in enumerate(zip(self.index, self.sign, strict=True)):
            index[true], sign[true] = streamed, factor
        return AxisMap((index[0], index[1], index[2]), (sign[0], sign[1], sign[2]))

    def vector(self, true: Vec3) -> Vec3:
        """A true vector as it is streamed."""
        (a, b, c), (i, j, k) = self.sign, self.index
        return (a * true[i], b * true[j], c * true[k])

    def rotation(self, true: Quat) -> Quat:
        """A true rotation as it is streamed when the axes of what turns are exchanged as well: A R A', a rotation even if A mirrors."""
        x, y, z = self.vector((true[1], true[2], true[3]))
        d = self.determinant
        return (true[0], d * x, d * y, d * z)

    @cached_property
    def quat(self) -> Quat:
        """The map as a rotation of true vectors; for determinant 1 only.

        Raises:
            ValueError: the map mirrors.
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
"""What a stream with y up says of a world with z up: Motive's other setting."""
ALL: Final = tuple(
    AxisMap((i, j, k), (a, b, c))
    for i, j, k in itertools.permutations(range(3))
    for a, b, c in itertools.product((1, -1), repeat=3)
)
ROTATIONS: Final = tuple(axes for axes in ALL if axes.determinant > 0)
MIRRORINGS: Final = tuple(axes for axes in ALL if axes.determinant < 0)
