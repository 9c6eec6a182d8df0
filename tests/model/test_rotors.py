"""PX4's standard layouts against PX4's own geometry, and its allocation matrix against numpy's pseudo-inverse."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.model.rotors import (
    LAYOUTS,
    LayoutName,
    SingularLayoutError,
    allocation,
    listed_layout,
    logged_layout,
    standard_layout,
)

H, C, S = math.sqrt(0.5), math.cos(math.pi / 8), math.sin(math.pi / 8)
PX4: dict[LayoutName, list[tuple[float, float, int]]] = {
    "quad_x": [(H, H, 1), (-H, -H, 1), (H, -H, -1), (-H, H, -1)],
    "quad_plus": [(0, 1, 1), (0, -1, 1), (1, 0, -1), (-1, 0, -1)],
    "hexa_x": [
        (0, 0.5, -1), (0, -0.5, 1), (0.433, -0.25, -1), (-0.433, 0.25, 1), (0.433, 0.25, 1), (-0.433, -0.25, -1),
    ],
    "hexa_plus": [
        (0.5, 0, -1), (-0.5, 0, 1), (-0.25, -0.433, -1), (0.25, 0.433, 1), (0.25, -0.433, 1), (-0.25, 0.433, -1),
    ],
    "octa_x": [(C, S, -1), (-C, -S, -1), (S, C, 1), (-C, S, 1), (C, -S, 1), (-S, -C, 1), (S, -C, -1), (-S, C, -1)],
    "octa_plus": [(1, 0, -1), (-1, 0, -1), (H, H, 1), (-H, H, 1), (H, -H, 1), (-H, -H, 1), (0, -1, -1), (0, 1, -1)],
}  # fmt: skip
"""CA_ROTORi_PX, _PY (FRD, any scale) and the sign of _KM of PX4's airframes."""


@pytest.mark.parametrize("name", LAYOUTS)
def test_positions_and_spins_are_px4s(name: LayoutName) -> None:
    layout = standard_layout(name, 0.4, 0.05)
    places = np.array([(x, y) for x, y, _ in PX4[name]], dtype=float)
    places *= 0.4 / np.linalg.norm(places[0])
    found = np.array(layout.positions_body_m)
    np.testing.assert_allclose(found[:, :2] * (1, -1), places, atol=2e-4)
    assert set(found[:, 2]) == {0.05}
    assert list(layout.spins) == [spin for _, _, spin in PX4[name]]


@pytest.mark.parametrize("name", LAYOUTS)
def test_allocation_is_px4s_scaled_pseudo_inverse(name: LayoutName) -> None:
    """The effectiveness matrix of ActuatorEffectivenessRotors and the scale of ControlAllocationPseudoInverse, in numpy."""
    thrust_coefficient, moment_ratio, arm_m = 6.5, 0.05, 0.5
    columns = []
    for x, y, spin in PX4[name]:
        axis = np.array([0.0, 0.0, -1.0])
        place = np.array([x, y, 0.0]) * arm_m
        moment = thrust_coefficient * np.cross(place, axis) - thrust_coefficient * moment_ratio * spin * axis
        columns.append([*moment, thrust_coefficient])
    mix = np.linalg.pinv(np.array(columns).T)
    tilt_scale = max(math.sqrt((c**2).sum() / ((abs(c) > 1e-3).sum() / 2.0)) for c in (mix[:, 0], mix[:, 1]))
    mix /= (tilt_scale, tilt_scale, mix[:, 2].max(), mix[:, 3].mean())
    np.testing.assert_allclose(allocation(standard_layout(name, 0.3, 0.03)), mix, atol=2e-3)


def test_rotors_of_unequal_levers_carry_unequal_shares() -> None:
    """Torques of the hover thrusts balance."""
    places = ((0.3, -0.2, 0.0), (-0.2, 0.2, 0.0), (0.3, 0.2, 0.0), (-0.2, -0.2, 0.0))
    thrust = np.array(allocation(listed_layout(places, (1, 1, -1, -1))))[:, 3]
    assert thrust @ np.array(places) == pytest.approx((0.0, 0.0, 0.0))
    assert thrust.mean() == pytest.approx(1.0)
    assert thrust[0] < 0.9


@pytest.mark.parametrize(
    ("places", "spins", "reason"),
    [
        (((0.3, 0.0), (0.1, 0.0), (-0.1, 0.0), (-0.3, 0.0)), (1, -1, 1, -1), "on one line"),
        (((H, -H), (-H, H), (H, H), (-H, -H)), (1, 1, 1, 1), "no yaw torque"),
        (((H, -H), (H, H), (-H, H), (-H, -H)), (1, 1, -1, -1), "no yaw torque"),
        (((0.0, 0.0),) * 4, (1, 1, -1, -1), "on one line"),
    ],
)
def test_rotors_that_cannot_control_the_vehicle_are_rejected(
    places: tuple[tuple[float, float], ...], spins: tuple[int, ...], reason: str
) -> None:
    """In the third case, yaw torque comes only with pitch torque."""
    with pytest.raises(SingularLayoutError, match=reason):
        allocation(listed_layout([(x, y, 0.0) for x, y in places], spins))


def test_layout_of_a_logged_configuration() -> None:
    assert logged_layout({"radius_m": 0.5}) == standard_layout("quad_x", 0.3, 0.03)
    hexa = {"radius_m": 0.5, "rotor_arm_m": 0.34, "layout": "hexa_x", "rotors": None, "rotor_height_m": 0.1}
    assert logged_layout(hexa) == standard_layout("hexa_x", 0.34, 0.1)
    listed = [
        {"position_body_m": [x, y, 0.0], "spin": "cw" if x * y > 0 else "ccw"} for x in (0.3, -0.3) for y in (0.3, -0.3)
    ]
    assert logged_layout({**hexa, "rotors": listed}).spins == (-1, 1, 1, -1)
