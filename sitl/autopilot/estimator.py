"""EKF-like estimator of the PX4 stub: IMU prediction, delayed vision fusion."""

from __future__ import annotations

from companion.types import Quat, Vec3
from sitl.autopilot.types import Estimate, ImuSample


class Estimator:
    """Fixed-gain observer that behaves as EKF2 with external vision does."""

    def predict(self, imu: ImuSample) -> None:
        """Advance to the sample's time."""
        raise NotImplementedError

    def fuse_vision(self, t_s: float, position_ned_m: Vec3, attitude_ned_frd: Quat) -> None:
        """Fuse a vision pose that was taken at world time `t_s` (arrival minus EKF2_EV_DELAY)."""
        raise NotImplementedError

    def estimate(self) -> Estimate:
        """Newest output."""
        raise NotImplementedError
