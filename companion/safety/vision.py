"""Tracker of external vision that another program sends to PX4, and the predicates of its rules.

The companion does not see those poses. The report of PX4's estimator shows whether PX4 uses them. The rows of these rules, with the
actions and the texts for the operator, are in `companion.safety.rules`.
"""

from __future__ import annotations

import math

from companion.model.estimator import EstimatorReport
from companion.model.types import Inputs
from companion.safety.flight_context import Age, Values

RATIO_MAX = 1.0
"""Innovation test ratio from which EKF2 rejects a measurement."""


class VisionTracker:
    """Tracks the newest ESTIMATOR_STATUS and its age."""

    def __init__(self) -> None:
        self._age = Age()
        self.age_s = math.inf
        """Awake time since the newest report arrived."""
        self.report: EstimatorReport | None = None
        """The newest report; None before PX4 has used external vision for the first time, for which the core waits."""

    def update(self, i: Inputs, awake_s: float) -> None:
        """Update with the inputs of one tick."""
        if i.estimator is not None and (self.report is not None or i.estimator.unaided is None):
            self.report = i.estimator
        self.age_s = self._age.update(awake_s, i.estimator.stamp_s if i.estimator is not None else None)


def estimator_silent(v: VisionTracker, timeout_s: float) -> Values | None:
    """Fires if no report has arrived for longer than the timeout."""
    return (timeout_s,) if v.age_s > timeout_s else None


def vision_lost(v: VisionTracker, _: None) -> Values | None:
    """Fires if PX4 has used external vision, but the newest report names a quantity that PX4 does not measure."""
    lacking = v.report.unaided if v.report is not None else None
    return (lacking,) if lacking is not None else None


def vision_rejected(v: VisionTracker, _: None) -> Values | None:
    """Fires if PX4's innovation tests fail."""
    ratio = v.report.worst_ratio if v.report is not None else 0.0
    return (ratio, RATIO_MAX) if ratio >= RATIO_MAX else None
