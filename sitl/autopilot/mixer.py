"""Mixer of the PX4 stub: collective thrust and torques to rotor commands, for any layout of rotors (control allocation)."""

from __future__ import annotations

import math

from companion.model.rotors import RotorLayout, allocation
from companion.model.types import Vec3
from sitl.autopilot.types import RotorCommands

_DIGITS = 12
"""Decimals of the matrix, so that the elements of a quad-x are exactly 1 and -1."""


class Mixer:
    """Distributes thrust and torques to the rotors.

    The matrix is PX4's, but with a root mean square of 1 instead of 0.71 for roll and pitch: the stub's rate gains refer to a rotor
    that receives the whole command.
    """

    def __init__(self, rotors: RotorLayout) -> None:
        root2 = math.sqrt(2.0)
        rows = [
            tuple(round(k, _DIGITS) for k in (root2 * roll, root2 * pitch, yaw, thrust))
            for roll, pitch, yaw, thrust in allocation(rotors)
        ]
        self.count = len(rows)
        self.roll, self.pitch, self.yaw, self.thrust = (tuple(row[axis] for row in rows) for axis in range(4))
        self._rows = [(t, roll / t, pitch / t, yaw / t) for roll, pitch, yaw, t in rows]
        self._most = 1.0 / max(self.thrust)
        self._turn_room = 1.0 / max(abs(yaw) for *_, yaw in self._rows)
        self.unsaturated = True
        """Whether the last mix left roll, pitch and thrust unchanged."""

    def mix(self, torque: Vec3, thrust: float) -> RotorCommands:
        """Return rotor commands, 0 to 1.

        If the largest command is too large, yaw is reduced first, then the collective thrust, and roll and pitch last. The thrust is
        never raised for a torque (MC_AIRMODE 0): near zero thrust, roll and pitch are reduced.
        """
        roll, pitch, yaw = torque
        rows = self._rows
        tilt = [r * roll + p * pitch for _, r, p, _ in rows]
        least, most = min(tilt), max(tilt)
        span = (most - least) / self._most
        if span > 1.0:
            tilt, least, most = [value / span for value in tilt], least / span, most / span
        base = max(0.0, min(self._most - most, thrust))
        reduced = base + least < 0.0
        if reduced:
            share = -base / least
            tilt, least, most = [share * value for value in tilt], share * least, share * most
        room = min(base + least, self._most - base - most) * self._turn_room
        turn = max(-room, min(room, yaw)) if room > 0 else 0.0
        self.unsaturated = span <= 1.0 and not reduced and abs(base - thrust) < 0.05
        commands = []
        for i, (t, _, _, y) in enumerate(rows):
            command = t * (base + tilt[i] + y * turn)
            commands.append(0.0 if command < 0.0 else 1.0 if command > 1.0 else command)
        return tuple(commands)
