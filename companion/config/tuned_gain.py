"""What a control law declares for `companion tune`: which of its gains are searched, and within which bounds; and what ours declare."""

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
    """If `key` is a property: the key whose scaling with the vehicle the gain follows. Empty for `key` itself."""
    only_with: str = ""
    """Key of another setting; if that is 0, the gain has no effect and is not searched. Empty if there is no such setting."""

    @property
    def place(self) -> slice:
        """Return the slice of the list that holds the values."""
        return slice(*self.rows)


_COMPENSATION = (
    TunedGain("disturbance_time_xyz_s", 0.2, 5.0, XY),
    TunedGain("disturbance_time_xyz_s", 0.2, 5.0, Z),
    TunedGain("feedforward_lead_s", 0.01, 0.4),
    TunedGain("attitude_filter_rad_s", 15.0, 150.0),
)
"""Gains that all of the companion's own laws have."""
ADAPTIVE = (
    TunedGain("inertia_md", 0.25, 1.5, XYZ),
    TunedGain("lambda_gain", 0.3, 10.0, XY),
    TunedGain("lambda_gain", 0.6, 27.0, Z),
    TunedGain("lambda_gain", 12.0, 180.0, JOINTS),
    TunedGain("phi", 0.7, 6.0, XY),
    TunedGain("phi", 0.7, 8.0, Z),
    TunedGain("phi", 1.0, 10.0, JOINTS),
    TunedGain("damping_d", 4.0, 180.0, JOINTS, scaled_as="damping_kd"),
    TunedGain("nu", 0.05, 50.0),
    TunedGain("rho_max", 0.5, 20.0),
    TunedGain("row_weights_s", 0.01, 1.0, JOINTS),
    TunedGain("load_rate_xyz", 0.1, 10.0, XY),
    TunedGain("load_rate_xyz", 0.3, 66.0, Z),
    TunedGain("moment_rate", 0.1, 18.0),
    TunedGain("friction_rate", 0.6, 180.0),
    *_COMPENSATION,
)

CSC = (
    TunedGain("stiffness_kp", 1.0, 50.0, XY),
    TunedGain("damping_kd", 1.0, 20.0, XY),
    TunedGain("stiffness_kp", 1.7, 200.0, Z),
    TunedGain("damping_kd", 1.7, 50.0, Z),
    TunedGain("inertia_md", 0.3, 18.0, JOINTS),
    TunedGain("damping_kd", 6.0, 180.0, JOINTS),
    TunedGain("stiffness_kp", 24.0, 1200.0, JOINTS),
    *_COMPENSATION,
)

PSC = (
    TunedGain("position_kp_xyz", 1.0, 40.0, XY),
    TunedGain("position_kd_xyz", 1.0, 20.0, XY),
    TunedGain("position_ki_xyz", 0.05, 20.0, XY),
    TunedGain("position_kp_xyz", 2.0, 200.0, Z),
    TunedGain("position_kd_xyz", 1.0, 40.0, Z),
    TunedGain("position_ki_xyz", 0.05, 100.0, Z),
    TunedGain("arm_inertia_md", 0.3, 18.0),
    TunedGain("arm_damping_kd", 6.0, 180.0),
    TunedGain("arm_stiffness_kp", 24.0, 1200.0),
    TunedGain("payload_time_s", 0.03, 2.0, only_with="payload_max_kg"),
    *_COMPENSATION,
)
