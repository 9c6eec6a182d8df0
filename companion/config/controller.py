"""The controller file: gains of the adaptive impedance law (paper, tab:control_parameters)."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from companion.config.base import Location, Model, NonNegative, Positive, refuse

Positive8 = tuple[Positive, Positive, Positive, Positive, Positive, Positive, Positive, Positive]
NonNegative8 = tuple[
    NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative
]
NonNegative3 = tuple[NonNegative, NonNegative, NonNegative]
Positive4 = tuple[Positive, Positive, Positive, Positive]


class AdaptiveConfig(Model):
    """Adaptive impedance control; rows are chi = [x y z | roll pitch yaw | alpha_1 alpha_2]. All matrices are diagonal."""

    schema_version: Literal[1]
    law: Literal["adaptive"]
    preset: str
    inertia_md: Positive8
    """M_d: kg and kg m^2."""
    lambda_gain: Positive8
    """Lambda."""
    phi: Positive8
    """Phi, 1/s."""
    damping_kd: Positive8
    """K_d."""
    stiffness_kp: Positive8
    """K_p; must equal (K_d - M_d Phi) Phi (gain_cond)."""
    row_weights_s: NonNegative8
    """S: weight of each row in ||s||, ||xi||, ||chi_dd||; 0 masks a row that another loop closes."""
    h_initial: Positive4
    """H_0(0) .. H_3(0)."""
    zeta_initial: Positive
    nu: Positive4
    """Leakage of H, 1/s."""
    epsilon: Positive
    boundary_layer: Positive
    """varpi."""
    rho_max: Positive
    acceleration_cap: NonNegative
    """Largest ||S chi_dd|| that may enter rho; 0 switches H_3 off."""
    acceleration_lowpass_hz: Positive
    force_lowpass_hz: Positive
    desired_force_time_s: Positive | None = None
    """T_d of F_d = lowpass(F_ext); absent: F_d = 0, as in the paper."""
    force_feedforward_xyz: NonNegative3 = (0.0, 0.0, 0.0)
    """Share of the measured F_ext that the base carries directly, per world axis."""
    base_compliance_xyz: NonNegative3 = (0.0, 0.0, 0.0)
    """Share of the measured F_ext that enters e_tau on the base rows (0: as in the paper)."""
    lateral_force_max_n: Positive = 12.0
    attitude_filter_rad_s: Positive = 30.0
    attitude_filter_damping: Annotated[float, Field(ge=0.5, le=2)] = 1.0

    @model_validator(mode="after")
    def _conditions(self) -> Self:
        problems: list[tuple[Location, str]] = []
        rows = zip(self.inertia_md, self.damping_kd, self.phi, self.stiffness_kp, strict=True)
        for row, (m_d, k_d, phi, k_p) in enumerate(rows):
            if not k_d / m_d - phi > 0:
                problems.append(
                    (("damping_kd", row), f"gain_new asks for K_d / M_d > Phi, got {k_d / m_d:g} <= {phi:g}")
                )
                continue
            wanted = (k_d - m_d * phi) * phi
            if abs(wanted - k_p) > 2e-3 * k_p:
                problems.append(
                    (("stiffness_kp", row), f"gain_cond asks for (K_d - M_d Phi) Phi = {wanted:g}, got {k_p:g}")
                )
        refuse("controller", problems)
        return self
