"""The report of PX4's estimator on itself."""

from __future__ import annotations

from companion.model.codec import Record

WATCHED_RATE_HZ = 20.0
"""Requested rate of ESTIMATOR_STATUS if another program feeds PX4 with poses: the report alone shows whether PX4 uses them."""
# ESTIMATOR_STATUS_FLAGS of position and height that EKF2 sets while measurements support them. Measured on PX4 1.16.1: they are cleared
# about 0.5 s after the last pose, those of a valid position 0.58 s before EKF2_NOAID_TOUT ends. With a barometer (EKF2_BARO_CTRL 1),
# that of height stays.
_AIDED = {256: "horizontal position", 32: "height"}


class EstimatorReport(Record, frozen=True, kw_only=True):
    """Content of ESTIMATOR_STATUS (MAVLink message 230), stamped with the flight clock on arrival."""

    stamp_s: float
    flags: int
    """Bit mask of ESTIMATOR_STATUS_FLAGS."""
    velocity_ratio: float
    """Innovation test ratio of the velocity; such a ratio is below 1 if measurements are accepted, exactly 0 if none is fused."""
    position_horizontal_ratio: float
    position_vertical_ratio: float
    position_horizontal_accuracy_m: float
    """Accuracy of the horizontal position, one standard deviation."""
    position_vertical_accuracy_m: float
    """Accuracy of the vertical position, one standard deviation."""

    @property
    def unaided(self) -> str | None:
        """Return the quantities for which PX4 fuses no measurement, or None if it fuses external vision."""
        return ", ".join([name for bit, name in _AIDED.items() if not self.flags & bit]) or None

    @property
    def worst_ratio(self) -> float:
        """Return the largest innovation test ratio."""
        return max(self.velocity_ratio, self.position_horizontal_ratio, self.position_vertical_ratio)
