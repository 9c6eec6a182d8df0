"""The paper's equations as printed against their corrected forms (docs/internals/control-law.md, errata); tests carry their labels.

Two closed loops. `Machine` is a coupled machine flown by the whole controller: there the corrected identities must hold to 1e-6.
`fly` is a decoupled machine, one mass per row, flown by the law's own adaptation and impedance with one equation at a time replaced:
what the printed form alone does to an otherwise correct law.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pytest
from msgspec.structs import replace

from companion.config.controller import AdaptiveConfig
from companion.config.loader import FlightConfig, load_flight
from companion.control.adaptive import Adaptation, AdaptiveController, Row, rows_of
from companion.control.arm_model import manipulator_of
from companion.control.types import PlantState
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import IDENTITY_QUAT, Vec3
from tests.control.states import at, at_rest

Array = npt.NDArray[np.float64]
DT_S = 0.005
ROWS = [0, 1, 2, 6, 7]
"""The law's own rows; 3 to 5 belong to PX4."""
POSE = (1.7, 1.0)
HOVER = 0.49


@pytest.fixture(
    scope="module",
    params=[
        ("paper", ()),
        ("recommended", ("controller.disturbance_time_xyz_s=[0.65, 0.65, 0.8]", "controller.arm_friction_share=0.75")),
    ],
    ids=["paper", "recommended with every option"],
)
def config(request: pytest.FixtureRequest) -> FlightConfig:
    preset, overrides = request.param
    return load_flight("configs/missions/catch.yaml", preset=preset, overrides=overrides)


@pytest.fixture(scope="module")
def law(config: FlightConfig) -> AdaptiveConfig:
    return adaptive(config)


@pytest.fixture(scope="module")
def table() -> AdaptiveConfig:
    """The paper's gains."""
    return adaptive(load_flight("configs/missions/catch.yaml", preset="paper"))


def adaptive(config: FlightConfig) -> AdaptiveConfig:
    assert isinstance(config.controller, AdaptiveConfig)
    return config.controller


# -- the corrected identities, whole controller, coupled machine -----------------------------------------------------------------


INERTIA: Array = np.diag([3.3, 3.2, 3.1, 0.05, 0.03]) + 0.01 * np.ones((5, 5))


def advanced(rows: list[Row], gamma: Sequence[float], dt_s: float, e_tau: Sequence[float]) -> list[float]:
    """gamma after a step of the law's own rows from a given gamma."""
    for row, start, held in zip(rows, gamma, e_tau, strict=True):
        row.gamma, row.e_tau = start, held
        row.advance(dt_s)
    return [row.gamma for row in rows]


@dataclass
class Machine:
    """M chi'' + C chi' + g + d = tau + tau_ext on the law's five rows: M coupled and unlike M_d, drag, gravity off by some."""

    config: FlightConfig
    chi: Array = field(default_factory=lambda: np.array([0.04, -0.03, 1.05, POSE[0] + 0.1, POSE[1] - 0.05]))
    rate: Array = field(default_factory=lambda: np.array([0.05, 0.0, -0.1, 0.2, -0.1]))
    force_world_n: Vec3 = (0.6, 0.0, -1.5)
    """A steady pull on the net: the force low-pass, which starts at its first sample, then adds nothing."""

    def __post_init__(self) -> None:
        self.manipulator = manipulator_of(self.config.vehicle)

    def state(self) -> PlantState:
        x, y, z, a1, a2 = self.chi.tolist()
        vx, vy, vz, w1, w2 = self.rate.tolist()
        return at(position=(x, y, z), velocity=(vx, vy, vz), arm=(a1, a2), arm_rate=(w1, w2), force=self.force_world_n)

    def tau_ext(self) -> Array:
        a1, a2 = self.chi[3:5].tolist()
        return np.array([*self.force_world_n, *self.manipulator.joint_torque_from_force((a1, a2), self.force_world_n)])

    def known_gravity(self) -> Array:
        """What the law feeds forward."""
        a1, a2 = self.chi[3:5].tolist()
        weight_n = self.config.vehicle.airframe.mass_kg * GRAVITY_M_S2
        return np.array([0.0, 0.0, weight_n, *self.manipulator.gravity_torque_nm((a1, a2), IDENTITY_QUAT)])

    def unknown(self) -> Array:
        """C chi' + d, and the part of g that is not known."""
        wrong = np.array([0.0, 0.0, 0.4, 0.02, -0.01])
        out: Array = np.array([0.3, 0.3, 0.3, 0.05, 0.05]) * self.rate + 0.02 * self.rate[3] * self.rate[::-1] + wrong
        return out

    def acceleration(self, tau: Array) -> Array:
        forces = tau + self.tau_ext() - self.known_gravity() - self.unknown()
        return np.linalg.solve(INERTIA, forces).astype(np.float64)

    def advance(self, acceleration: Array) -> None:
        self.chi += DT_S * self.rate + 0.5 * DT_S**2 * acceleration
        self.rate += DT_S * acceleration


TARGET = replace(
    at_rest((0.0, 0.0, 1.0), 0.0, POSE),
    acceleration_world_m_s2=(0.1, 0.0, 0.0),
    arm_acceleration_rad_s2=(0.2, -0.1),
    jerk_world_m_s3=(0.3, -0.2, 0.0),
)
OPTIONS_OFF = {
    "disturbance_time_xyz_s": (0.0, 0.0, 0.0),
    "feedforward_lead_s": 0.0,
    "arm_inertia_nominal": False,
    "arm_friction_share": 0.0,
    "load_rate_xyz": (0.0, 0.0, 0.0),
    "moment_rate": (0.0,),
    "friction_rate": (0.0,),
}


def wide(five: Array) -> list[float]:
    """Five rows among eight."""
    eight = np.zeros(8)
    eight[ROWS] = five
    return list(eight.tolist())


def rate_of(value: Callable[[float], Array]) -> Array:
    """Right derivative at 0, three levels of Richardson."""
    start, h = value(0.0), 2e-5
    slopes = [(value(h / 2**k) - start) / (h / 2**k) for k in range(3)]
    first = [2 * slopes[k + 1] - slopes[k] for k in range(2)]
    out: Array = (4 * first[1] - first[0]) / 3
    return out


@dataclass(frozen=True)
class Instant:
    """One tick of `Machine` under the whole controller; five rows."""

    e: Array
    e_rate: Array
    e_acceleration: Array
    s: Array
    s_rate: Array
    """By differentiation of the law's own s along the motion."""
    gamma: Array
    gamma_rate: Array
    e_tau: Array
    big_e: Array
    """The overall uncertainty E, as the machine has it."""
    dtau: Array
    added: Array
    """What the options beyond the paper add to tau."""


def instants(config: FlightConfig, ticks: int = 400) -> list[Instant]:
    """Closed loop from an initial error under a steady pull."""
    law = adaptive(config)
    controller = AdaptiveController(law, config.vehicle, HOVER)
    # The same law with the options beyond the paper off: what they add to tau is the difference, and belongs to E.
    plain = AdaptiveController(law.model_copy(update=OPTIONS_OFF), config.vehicle, HOVER)
    machine = Machine(config=config)
    m_d, phi, weight = (np.array(gain)[ROWS] for gain in (law.inertia_md, law.phi, law.row_weights_s))
    share = np.array([*law.base_compliance_xyz, 1.0, 1.0])
    fed = np.array([*law.force_feedforward_xyz, 0.0, 0.0])
    wanted_acceleration = np.array([*TARGET.acceleration_world_m_s2, *TARGET.arm_acceleration_rad_s2])
    gamma_before = [0.0] * 8
    out = []
    for _ in range(ticks):
        log = controller.step(DT_S, machine.state(), TARGET, 1.0).log
        without = plain.step(DT_S, machine.state(), TARGET, 1.0).log
        assert not any(log.saturated)
        assert not any(without.saturated)
        added = (np.array(log.tau) - np.array(without.tau))[ROWS]
        acceleration = machine.acceleration(np.array(log.tau)[ROWS])
        e, e_rate = np.array(log.error)[ROWS], np.array(log.error_rate)[ROWS]
        e_acceleration = acceleration - wanted_acceleration
        gamma_now, e_tau = gamma_before, log.e_tau

        def gamma_after(h: float, start: list[float] = gamma_now, held: tuple[float, ...] = e_tau) -> list[float]:
            return advanced(rows_of(law, 2), start, h, held)

        def s_after(
            h: float,
            e: Array = e,
            v: Array = e_rate,
            a: Array = e_acceleration,
            after: Callable[[float], list[float]] = gamma_after,
        ) -> Array:
            return np.array(v + h * a + phi * (e + h * v + 0.5 * h * h * a) - np.array(after(h))[ROWS])

        s = np.array(log.sliding)[ROWS]
        norm = max(float(np.linalg.norm(weight * s)), law.boundary_layer)
        # E holds what the machine has and the law does not know; a force that the law neither complies with nor feeds forward too.
        unanswered = machine.tau_ext() * (1.0 - share - fed)
        big_e = INERTIA @ acceleration - m_d * acceleration + machine.unknown() - unanswered - added
        out.append(
            Instant(
                e=e,
                e_rate=e_rate,
                e_acceleration=e_acceleration,
                s=s,
                s_rate=rate_of(s_after),
                gamma=np.array(gamma_now)[ROWS],
                gamma_rate=rate_of(lambda h, after=gamma_after: np.array(after(h))[ROWS]),  # type: ignore[misc]
                e_tau=np.array(e_tau)[ROWS],
                big_e=big_e,
                dtau=-log.rho * weight**2 * s / norm,
                added=added,
            )
        )
        gamma_before = list(log.gamma)
        machine.advance(acceleration)
    return out


def gains(law: AdaptiveConfig) -> tuple[Array, Array, Array, Array, Array]:
    """M_d, K_d, K_p, Phi, D on five rows."""
    m_d, k_d, k_p, phi = (np.array(g)[ROWS] for g in (law.inertia_md, law.damping_kd, law.stiffness_kp, law.phi))
    return m_d, k_d, k_p, phi, k_d - m_d * phi


def test_step4_closed_loop_is_md_sdot_equals_minus_lambda_s_minus_e_plus_dtau(
    config: FlightConfig, law: AdaptiveConfig
) -> None:
    m_d = gains(law)[0]
    lam = np.array(law.lambda_gain)[ROWS]
    seen = instants(config)
    for now in seen:
        np.testing.assert_allclose(m_d * now.s_rate, -lam * now.s - now.big_e + now.dtau, atol=1e-6)
    assert max(np.abs(now.s_rate).max() for now in seen) > 0.5, "nothing moved"
    assert max(np.abs(now.gamma).max() for now in seen) > 0.1, "gamma was not exercised"
    assert max(np.abs(now.added).max() for now in seen) > 0.01 or law.preset == "paper", "no option was exercised"


def test_I_cl_impedance_error_is_md_sdot_plus_d_s(config: FlightConfig, law: AdaptiveConfig) -> None:
    """deviation_error by its definition, against I_cl."""
    m_d, k_d, k_p, _, d = gains(law)
    for now in instants(config):
        impedance_error = m_d * now.e_acceleration + k_d * now.e_rate + k_p * now.e - now.e_tau
        np.testing.assert_allclose(impedance_error, m_d * now.s_rate + d * now.s, atol=1e-6)


def test_step1_the_line_after_it_needs_plus_d_gamma(config: FlightConfig, law: AdaptiveConfig) -> None:
    """Printed: M_d s' + D s - D Phi e + K_p e - D gamma + M_d gamma' - e_tau. It misses the impedance error by 2 D gamma."""
    m_d, k_d, k_p, phi, d = gains(law)
    missed = []
    for now in instants(config):
        impedance_error = m_d * now.e_acceleration + k_d * now.e_rate + k_p * now.e - now.e_tau
        both = m_d * now.s_rate + d * now.s - d * phi * now.e + k_p * now.e + m_d * now.gamma_rate - now.e_tau
        np.testing.assert_allclose(both + d * now.gamma, impedance_error, atol=1e-6)
        missed.append(np.abs(both - d * now.gamma - impedance_error).max())
    assert max(missed) > 0.1


# -- one printed equation at a time, decoupled machine ---------------------------------------------------------------------------

MASSES = np.array([3.2, 3.2, 3.2, 0.045, 0.045, 0.075, 0.05, 0.03])
START = np.array([0.2, -0.1, 0.1, 0.0, 0.0, 0.0, 0.15, -0.1])
NOTHING = np.zeros(8)
PULL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.2, -0.3])
"""e_tau on the joints of a 2 N pull on the net."""

GammaLaw = Callable[[list[Row], Array, Array], Array]
TauTerm = Callable[[Array, Array], Array]
RobustTerm = Callable[[float, Array, float], Array]


def gamma_corrected(rows: list[Row], gamma: Array, e_tau: Array) -> Array:
    """Exactly as the law does it."""
    return np.array(advanced(rows, gamma.tolist(), DT_S, e_tau.tolist()))


def gamma_printed(rows: list[Row], gamma: Array, e_tau: Array) -> Array:
    """gamma' = M_d^-1 (e_tau + D) gamma, e_tau as a diagonal; exact for a held e_tau."""
    rate = (e_tau + np.array([row.D for row in rows])) / np.array([row.M_d for row in rows])
    out: Array = gamma * np.exp(np.minimum(rate * DT_S, 50.0))
    return out


def tau_corrected(d: Array, gamma: Array) -> Array:
    return -d * gamma


def tau_printed(d: Array, gamma: Array) -> Array:
    return -d


def robust_corrected(rho: float, s: Array, norm: float) -> Array:
    return -rho * s / norm


def robust_printed(rho: float, s: Array, norm: float) -> Array:
    return rho * s / norm


@dataclass(frozen=True)
class Flown:
    """Rows are ticks."""

    e: Array
    s: Array
    gamma: Array
    h: Array
    zeta: Array
    lost_s: float | None
    """When an error grew beyond a metre or a radian."""


def fly(
    law: AdaptiveConfig,
    *,
    gamma_law: GammaLaw = gamma_corrected,
    tau_term: TauTerm = tau_corrected,
    robust: RobustTerm = robust_corrected,
    e_tau: Array = NOTHING,
    gamma_start: float = 0.0,
    start: Array = START,
    unknown: Array = NOTHING,
    duration_s: float = 8.0,
) -> Flown:
    """Hold a point from an initial error, tau_d = 0, ||.|| over all eight rows as the paper has it; `unknown` is force not in e_tau."""
    law_rows, adaptation = rows_of(law, 2), Adaptation(law)
    m_d, lam, phi, d = (
        np.array(law.inertia_md),
        np.array(law.lambda_gain),
        np.array(law.phi),
        np.array([row.D for row in law_rows]),
    )
    e, rate, gamma, acceleration = start.copy(), np.zeros(8), np.full(8, gamma_start), np.zeros(8)
    rows: list[tuple[Array, Array, Array, list[float], float]] = []
    lost_s = None
    for tick in range(round(duration_s / DT_S)):
        s = rate + phi * e - gamma
        norm, x = float(np.linalg.norm(s)), float(np.linalg.norm([e, rate]))
        regressor = (1.0, x, x * x, min(float(np.linalg.norm(acceleration)), law.acceleration_cap))
        dtau = robust(adaptation.rho(regressor), s, max(norm, law.boundary_layer))
        tau = -lam * s + dtau - m_d * phi * rate + tau_term(d, gamma)
        rows.append((e.copy(), s, gamma.copy(), list(adaptation.H), adaptation.zeta))
        if lost_s is None and np.abs(e).max() > 1.0:
            lost_s = tick * DT_S
            break
        acceleration = (tau + e_tau + unknown) / MASSES
        adaptation.advance(DT_S, norm, regressor, False)
        gamma = gamma_law(law_rows, gamma, e_tau)
        rate = rate + DT_S * acceleration
        e = e + DT_S * rate
    e_rows, s_rows, gamma_rows, h_rows, zeta_rows = (np.array(column) for column in zip(*rows, strict=True))
    return Flown(e=e_rows, s=s_rows, gamma=gamma_rows, h=h_rows, zeta=zeta_rows, lost_s=lost_s)


def test_corrected_law_comes_to_rest(table: AdaptiveConfig) -> None:
    flown = fly(table)
    assert flown.lost_s is None
    assert np.abs(flown.e[-1]).max() < 0.01


def test_adaptive_1_printed_gamma_runs_away(table: AdaptiveConfig) -> None:
    """From gamma(0) > 0, as the paper asks for, at rest and with nothing touching the machine."""
    printed = fly(table, gamma_law=gamma_printed, gamma_start=1e-3, start=NOTHING)
    assert printed.lost_s is not None
    assert printed.lost_s < 2.0
    corrected = fly(table, gamma_start=1e-3, start=NOTHING)
    assert corrected.lost_s is None
    assert np.abs(corrected.gamma[-1]).max() < 1e-12


def test_adaptive_1_printed_gamma_never_yields_from_zero(table: AdaptiveConfig) -> None:
    """From gamma(0) = 0 the printed form is 0 for ever: no compliance. The corrected one gives way by e_tau / K_p."""
    printed = fly(table, gamma_law=gamma_printed, e_tau=PULL, start=NOTHING)
    assert not printed.gamma.any()
    corrected = fly(table, e_tau=PULL, start=NOTHING)
    d = np.array([row.D for row in rows_of(table, 2)])
    np.testing.assert_allclose(corrected.gamma[-1], PULL / d, atol=1e-9)
    np.testing.assert_allclose(corrected.e[-1], PULL / np.array(table.stiffness_kp), atol=1e-3)


def test_tau_printed_constant_d_throws_the_machine(table: AdaptiveConfig) -> None:
    """ "- D" is a constant push of 36 N and 0.35 N m."""
    printed = fly(table, tau_term=tau_printed, start=NOTHING)
    assert printed.lost_s is not None
    assert printed.lost_s < 2.0
    assert fly(table, start=NOTHING).lost_s is None


def test_del_tau_printed_sign_feeds_the_error(table: AdaptiveConfig) -> None:
    """0.6 m off with a payload of 0.2 kg on board."""
    start, weight = 3.0 * START, np.array([0.0, 0.0, -2.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    printed = fly(table, robust=robust_printed, start=start, unknown=weight)
    assert printed.lost_s is not None
    assert printed.lost_s < 7.0
    corrected = fly(table, start=start, unknown=weight)
    assert corrected.lost_s is None
    assert np.abs(corrected.e[-1]).max() < 0.3


def test_gamma_nonnegative_is_false_once_e_tau_is_negative(table: AdaptiveConfig) -> None:
    """Claimed in the appendix, needed by nothing: even from gamma(0) > 0 a pull leads below zero, and the law holds."""
    flown = fly(table, e_tau=PULL, gamma_start=0.05, start=NOTHING)
    assert flown.gamma[0].min() > 0.0
    assert flown.gamma[-1, 7] < -0.1
    assert flown.lost_s is None


def test_V_bound_printed_is_no_bound(table: AdaptiveConfig) -> None:
    """lyp along a flight, against V_bound as printed and with + lambda_max(M_d) / 2. H* may be anything: the mean is taken."""
    flown = fly(table, e_tau=PULL)
    m_d, lam = np.array(table.inertia_md), np.array(table.lambda_gain)
    h_star = flown.h.mean(axis=0)
    zeta_low, zeta_high = flown.zeta.min(), flown.zeta.max()
    s_squared = np.sum(flown.s**2, axis=1)
    h_part = 0.5 * np.sum((flown.h - h_star) ** 2, axis=1)
    v = 0.5 * flown.s**2 @ m_d + h_part + flown.zeta / zeta_low
    printed = -lam.max() * s_squared + h_part + zeta_high / zeta_low
    corrected = 0.5 * m_d.max() * s_squared + h_part + zeta_high / zeta_low
    assert (v <= corrected + 1e-12).all()
    assert (v > printed).any()
    # With zeta at its upper bound, as it is at the start, the printed form fails for every s but 0.
    at_top = (flown.zeta == zeta_high) & (s_squared > 0.0)
    assert at_top.any()
    assert (v[at_top] > printed[at_top]).all()
