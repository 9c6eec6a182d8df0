"""Land detection as in PX4's MulticopterLandDetector: ground contact, then maybe landed, then landed."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from sitl.autopilot.params import Params
from sitl.autopilot.types import Estimate

_DESCENT_THRESHOLD_M_S = 0.3
_HOVER_ESTIMATED_ABOVE_M, _HOVER_ESTIMATED_S = 1.0, 2.0
"""PX4 estimates the hover thrust only after it was this high above the ground, and needs some time for it."""
_BLIND_S: Final = 8.0
"""Without a velocity estimate, the vehicle counts as landed after this time at minimum thrust without rotation."""


class _Settings(NamedTuple):
    hold_s: float
    thrust_min: float
    thrust_hover: float
    thrust_manual_min: float
    still_z_m_s: float
    still_xy_m_s: float
    still_rad_s: float


class LandDetector:
    """Three conditions in sequence; each must hold for a third of LNDMC_TRIG_TIME and is reset at once."""

    def __init__(self, params: Params) -> None:
        self._params = params
        self._revision = params.revision
        self._settings = self._read()
        self._contact_since_s: float | None = None
        self._maybe_since_s: float | None = None
        self._landed_since_s: float | None = None
        self._low_since_s: float | None = None
        self._ground_down_m = 0.0
        self._high_since_s: float | None = None
        """When the vehicle was first high enough for an estimate of the hover thrust; None if it was not."""
        self.ground_contact = True
        self.maybe_landed = True
        self.landed = True

    def update(
        self,
        t_s: float,
        armed: bool,
        estimate: Estimate,
        thrust: float,
        climb_rate_controlled: bool,
        descend_m_s: float,
    ) -> None:
        """Run one cycle. `thrust` is the collective thrust setpoint (0 to 1), `descend_m_s` the commanded descent speed."""
        if not armed:
            self.ground_contact = self.maybe_landed = self.landed = True
            self._contact_since_s = self._maybe_since_s = self._landed_since_s = -math.inf
            self._low_since_s = self._high_since_s = None
            self._ground_down_m = estimate.position_ned_m[2]
            return
        if self._high_since_s is None and self._ground_down_m - estimate.position_ned_m[2] > _HOVER_ESTIMATED_ABOVE_M:
            self._high_since_s = t_s
        if self._revision != self._params.revision:
            self._revision = self._params.revision
            self._settings = self._read()
        hold_s = self._settings.hold_s
        contact = self._contact_now(t_s, estimate, thrust, climb_rate_controlled, descend_m_s)
        self._contact_since_s, self.ground_contact = _held(t_s, contact, self._contact_since_s, hold_s)
        maybe = self._maybe_now(t_s, estimate, thrust, climb_rate_controlled)
        self._maybe_since_s, self.maybe_landed = _held(t_s, maybe, self._maybe_since_s, hold_s)
        self._landed_since_s, self.landed = _held(t_s, self.maybe_landed, self._landed_since_s, hold_s)

    def _contact_now(
        self, t_s: float, estimate: Estimate, thrust: float, climb_rate_controlled: bool, descend_m_s: float
    ) -> bool:
        if not estimate.height_valid:
            return False
        settings = self._settings
        estimated = self._high_since_s is not None and t_s - self._high_since_s > _HOVER_ESTIMATED_S
        share = 0.6 if estimated else 0.3
        if thrust > settings.thrust_min + share * (settings.thrust_hover - settings.thrust_min):
            return False
        if climb_rate_controlled and not self.maybe_landed and not self.landed and descend_m_s < _DESCENT_THRESHOLD_M_S:
            return False
        vx, vy, vz = estimate.velocity_ned_m_s
        still_m_s = settings.still_z_m_s * (2.5 if self.landed else 1.0)
        moves = estimate.position_valid and math.hypot(vx, vy) > settings.still_xy_m_s
        return abs(vz) <= still_m_s and not moves

    def _maybe_now(self, t_s: float, estimate: Estimate, thrust: float, climb_rate_controlled: bool) -> bool:
        settings = self._settings
        least = settings.thrust_manual_min + 0.01
        if climb_rate_controlled:
            least = settings.thrust_min + 0.1 * (settings.thrust_hover - settings.thrust_min)
        if thrust > least:
            self._low_since_s = None
            return False
        if self._low_since_s is None:
            self._low_since_s = t_s
        turning_rad_s = settings.still_rad_s * (2.5 if self.landed else 1.0)
        p, q, _ = estimate.rates_frd_rad_s
        if math.hypot(p, q) > turning_rad_s:
            return False
        if estimate.height_valid:
            return self.ground_contact
        return t_s - self._low_since_s > _BLIND_S

    def _read(self) -> _Settings:
        real = self._params.real
        return _Settings(
            hold_s=real("LNDMC_TRIG_TIME") / 3.0,
            thrust_min=real("MPC_THR_MIN"),
            thrust_hover=real("MPC_THR_HOVER"),
            thrust_manual_min=real("MPC_MANTHR_MIN"),
            still_z_m_s=real("LNDMC_Z_VEL_MAX"),
            still_xy_m_s=real("LNDMC_XY_VEL_MAX"),
            still_rad_s=math.radians(real("LNDMC_ROT_MAX")),
        )


def _held(t_s: float, now: bool, since_s: float | None, hold_s: float) -> tuple[float | None, bool]:
    """Return the time at which a condition began to hold, None if it does not hold, and whether it has held for `hold_s`."""
    if not now:
        return None, False
    if since_s is None:
        since_s = t_s
    return since_s, t_s - since_s >= hold_s
