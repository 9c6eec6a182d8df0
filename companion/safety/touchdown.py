"""Does the vehicle stand? Three sources that fail apart from one another, and two of them must say so. Pure; time is an argument.

* **Height**: PX4's estimate is near standing height and does not sink, though the reference has gone below it.
* **Thrust**: far less than hovering takes is commanded, and motion capture sees no sinking: something else carries the vehicle.
* **PX4**: its land detector says so (EXTENDED_SYS_STATE). In attitude control it waits for next to no thrust, which no law gives by
  itself. So when one of the others stands alone, thrust is taken back step by step (`relief`), for as long as nothing sinks.
"""

from __future__ import annotations

from collections import deque

from companion.model.types import MocapPose, VehicleState

HEIGHT_MARGIN_M = 0.12
"""Above standing height: so low the height counts as standing."""
STILL_M_S = 0.08
REFERENCE_BELOW_M = 0.05
HEIGHT_HOLD_S = 0.35
THRUST_SHARE = 0.75
"""Of hover thrust. A vehicle in the air that gets no more falls 0.2 m within 0.4 s."""
THRUST_HOLD_S = 0.2
NEVER_ABOVE_M = 0.5
"""Over standing height, by motion capture: there thrust and PX4 prove nothing, for the vehicle may hang on its tether."""
ALONE_S = 0.4
"""So long one source may wait for a second before it is put to the test."""
RELIEF_S = 1.0
"""From all of the thrust to none."""
RELIEF_SINK_MAX_M_S = 0.15
"""Sinks faster when thrust is taken back: it flew."""
SINK_WINDOW_S = 0.15
MOCAP_FRESH_S = 0.3


class HeightEvidence:
    """By PX4's estimate: low and still, held for a while.

    Args:
        clearance_m: height of the body's origin when the vehicle stands.
    """

    def __init__(self, clearance_m: float) -> None:
        self._low_m = clearance_m + HEIGHT_MARGIN_M
        self._since_s: float | None = None

    def update(self, t_s: float, height_m: float, vertical_m_s: float, reference_height_m: float) -> bool:
        """Whether it says that the vehicle stands."""
        pressed = reference_height_m < height_m - REFERENCE_BELOW_M
        if not (height_m < self._low_m and abs(vertical_m_s) < STILL_M_S and pressed):
            self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = t_s
        return t_s - self._since_s >= HEIGHT_HOLD_S


class Sinking:
    """Speed down by motion capture alone, over `SINK_WINDOW_S`."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, float]] = deque()

    def update(self, t_s: float, pose: MocapPose | None) -> float | None:
        """m/s, down positive; None: motion capture does not tell."""
        seen = self._seen
        if pose is None or not pose.tracking_valid or t_s - pose.stamp_s >= MOCAP_FRESH_S:
            seen.clear()
            return None
        if not seen or pose.stamp_s > seen[-1][0]:
            seen.append((pose.stamp_s, pose.position_world_m[2]))
        while len(seen) > 2 and seen[1][0] <= seen[-1][0] - SINK_WINDOW_S:
            seen.popleft()
        (first_s, first_m), (last_s, last_m) = seen[0], seen[-1]
        return (first_m - last_m) / (last_s - first_s) if last_s - first_s >= 0.5 * SINK_WINDOW_S else None


class Touchdown:
    """Two of three, in a landing that the companion flies itself.

    Args:
        clearance_m: height of the body's origin when the vehicle stands.
    """

    def __init__(self, clearance_m: float) -> None:
        self._ceiling_m = clearance_m + NEVER_ABOVE_M
        self._height = HeightEvidence(clearance_m)
        self._sinking = Sinking()
        self._thrust_since_s: float | None = None
        self._alone_since_s: float | None = None
        self._last_s: float | None = None
        self.relief = 1.0
        """Share of its thrust that the law may give."""
        self.found: tuple[str, ...] = ()
        """Who says that the vehicle stands."""

    def update(
        self,
        t_s: float,
        vehicle: VehicleState,
        pose: MocapPose | None,
        reference_height_m: float,
        thrust_share: float,
        landed: bool,
    ) -> bool:
        """One tick of a landing; True once touch-down is certain.

        Args:
            t_s: flight clock.
            vehicle: PX4's state.
            pose: motion capture, as far as it is believed.
            reference_height_m: where the law wants the body's origin.
            thrust_share: of hover thrust, in the last command.
            landed: PX4's land detector says that the vehicle stands.
        """
        dt_s = 0.0 if self._last_s is None else t_s - self._last_s
        self._last_s = t_s
        height = self._height.update(
            t_s, vehicle.position_world_m[2], vehicle.velocity_world_m_s[2], reference_height_m
        )
        sink_m_s = self._sinking.update(t_s, pose)
        thrust = self._carried(t_s, sink_m_s, thrust_share)
        below = pose is not None and pose.position_world_m[2] < self._ceiling_m
        said = (("height", height), ("thrust", thrust), ("PX4", landed))
        self.found = tuple(name for name, says in said if says)
        if len(self.found) >= 2 and (height or below):
            return True
        self._relieve(t_s, dt_s, sink_m_s, (height or thrust) and below)
        return False

    def _carried(self, t_s: float, sink_m_s: float | None, thrust_share: float) -> bool:
        if sink_m_s is None or sink_m_s > STILL_M_S or thrust_share > THRUST_SHARE:
            self._thrust_since_s = None
            return False
        if self._thrust_since_s is None:
            self._thrust_since_s = t_s
        return t_s - self._thrust_since_s >= THRUST_HOLD_S

    def _relieve(self, t_s: float, dt_s: float, sink_m_s: float | None, seems_to_stand: bool) -> None:
        """Less thrust while one source says that the vehicle stands, all of it at once when it does sink."""
        if not seems_to_stand or sink_m_s is None or sink_m_s > RELIEF_SINK_MAX_M_S:
            self.relief, self._alone_since_s = 1.0, None
            return
        if self._alone_since_s is None:
            self._alone_since_s = t_s
        if t_s - self._alone_since_s > ALONE_S:
            self.relief = max(0.0, self.relief - dt_s / RELIEF_S)
