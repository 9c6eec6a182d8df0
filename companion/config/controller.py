"""The controller file: a control law and its gains. `companion.control` implements the laws and their initial estimates.

Control laws are plug-ins (`companion.plugins.CONTROL_LAWS`). An entry point names the class of a law, which implements
`companion.control.types.Law`; the class names the model of its settings, a subclass of `ControllerConfig`.
"""

from __future__ import annotations

import functools
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar, get_args

from pydantic import BeforeValidator, Field, SerializeAsAny, model_validator

from companion import plugins
from companion.config import tuned_gain
from companion.config.base import Location, Model, NonNegative, Positive, Positive3, refuse
from companion.config.gains import (
    NonNegative3,
    NonNegativeJoints,
    NonNegativeRows,
    Positive4,
    PositiveJoints,
    PositiveRows,
    six_digits,
)
from companion.config.tuned_gain import TunedGain


class ControllerConfig(Model):
    """Settings that every control law has. A subclass narrows `law` to `Literal[NAME]`, names its presets and adds its own settings."""

    presets: ClassVar[tuple[str, ...]] = ()
    """Names of the built-in presets, with the default last. Their files are files/controllers/LAW_PRESET.yaml next to the class's
    module.
    """
    tuned_gains: ClassVar[tuple[TunedGain, ...]] = ()
    """What `companion tune` searches."""
    needs_file: ClassVar[bool] = False
    """Whether the law has no presets, because every flight names a file."""

    schema_version: Literal[1]
    law: str
    preset: str

    def with_gains(self, gains: Mapping[str, Any]) -> Self:
        """Return the settings with other values of some keys. A law whose gains must meet conditions overrides this, so that they hold
        for every value within the bounds of `tuned_gains`.

        Raises:
            ValidationError: a value is invalid.
        """
        return type(self).model_validate(self.model_dump() | dict(gains))


class Machine(Model):
    """The inertia of the machine for which gains were found."""

    mass_kg: Positive
    """Mass of the vehicle, ready to fly (`airframe.mass_kg`)."""
    joint_inertia_kg_m2: PositiveJoints
    """Inertia of each joint, to four digits: the smallest within the joint limits of its diagonal element of the mass matrix of arm and
    tool, with the armatures of the servos. The last value stands for further joints."""


class LawConfig(ControllerConfig):
    """Settings that the companion's own laws share: for the measured force, additional compensation and limits of the commands."""

    gain_lists: ClassVar[tuple[str, ...]] = ()
    """Names of the lists of gains, one for each row or joint, which must have the same length."""
    scaled_by_mass: ClassVar[tuple[str, ...]] = ("disturbance_max_n", "lateral_force_max_n")
    """Names of the settings that are proportional to the vehicle's mass (`found_for`)."""
    scaled_by_row: ClassVar[tuple[str, ...]] = ()
    """Names of the lists of gains that are proportional to the mass in x, y and z and to the inertia of each joint."""
    scaled_by_joint: ClassVar[tuple[str, ...]] = ()
    """Names of the settings, a number or a list, that are proportional to the inertia of each joint."""
    shared_by_links: ClassVar[tuple[str, ...]] = ()
    """Names of those that are divided by the ratio of the numbers of joints on an arm with more joints than the machine of
    `found_for`: the moments of all links further out act on a joint, so its integral gain is the sum of their rates."""

    found_for: Machine | None = None
    """Machine for which the gains were found: on another vehicle they are multiplied by the ratio of its inertia to this one. null: the
    gains are used as written."""
    scale: PositiveRows | None = None
    """Factors on x, y, z, roll, pitch, yaw and each joint by which the gains in this record are multiplied already. The companion sets
    it; files leave it out."""
    force_lowpass_hz: Positive
    desired_force_time_s: Positive | None = None
    """Time constant T_d of F_d = lowpass(F_ext) on the joint rows. If it is absent, F_d = 0 and the arm sags under a carried
    payload.
    """
    force_feedforward_xyz: NonNegative3 = (0.0, 0.0, 0.0)
    """Fraction of the measured F_ext that is fed forward to the base, per world axis."""
    disturbance_time_xyz_s: NonNegative3 = (0.0, 0.0, 0.0)
    """Time constant of the disturbance observer, per world axis; 0 disables it, as in the paper. The observer estimates and compensates
    for the forces on the base that are neither commanded nor fed forward.
    """
    disturbance_lag_s: NonNegative = 0.1
    """Lag between commanded and actual force that the observer assumes."""
    disturbance_max_n: NonNegative = 6.0
    """Bound of the observer's estimate, per axis."""
    feedforward_lead_s: NonNegative = 0.0
    """Lead of the feedforward of the reference's horizontal acceleration (a + lead * jerk), which compensates for the attitude
    loop's delay.
    """
    arm_friction_share: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Fraction of the vehicle file's `arm.joint_friction_nm` that is fed forward in the direction of the requested joint rate:
    alpha'_d, and in the adaptive law alpha' - s."""
    lateral_force_max_n: Positive = 12.0
    """Largest horizontal force of a vehicle that may tilt by 20 deg. If it may tilt by more, in the ratio of the tangents more."""
    attitude_filter_rad_s: Positive = 30.0
    attitude_filter_damping: Annotated[float, Field(ge=0.5, le=2)] = 1.0

    @model_validator(mode="after")
    def _gain_lists_fit(self) -> Self:
        lengths = {key: len(getattr(self, key)) for key in self.gain_lists}
        wanted = statistics.mode(lengths.values()) if lengths else 0
        for key, length in lengths.items():
            if length != wanted:
                other = next(key for key in lengths if lengths[key] == wanted)
                text = f"expected {wanted} values, as many as {other} has, got {length}"
                refuse("controller", [((key,), text)])
        return self


class OnlineConfig(Model):
    """Slow optimisation of the target impedance in flight: one scale of Phi and Lambda on x, y and z (docs/internals/tune.md)."""

    bound: Annotated[float, Field(gt=1, le=2)] = 2.0
    """The scale stays within 1 / bound and bound."""
    rate_1_s: Annotated[float, Field(gt=0, le=0.1)] = 0.03
    """Largest rate at which the logarithm of the scale rises. It falls up to ten times as fast."""
    shake_rad_s: Annotated[float, Field(ge=2, le=10)] = 5.0
    """Angular frequency at which the position error is neither slow, which raises the scale, nor shaking, which lowers it."""
    keep: bool = False
    """Whether the scale is kept for the landing. If not, the landing begins by returning to the mission's gains."""


class AdaptiveConfig(LawConfig):
    """Adaptive impedance control (paper, tab:control_parameters).

    Rows are chi = [x y z | roll pitch yaw | joints]. All matrices are diagonal, and all lists of rows have the same length, 7 to 13: 6
    values and one or more for the joints. A vehicle with n joints uses the first 6 + n values; if there are fewer, the last value
    applies to the remaining joints too.
    """

    presets = ("paper", "paper_slow_leakage", "model_free", "recommended")
    gain_lists = ("inertia_md", "lambda_gain", "phi", "damping_kd", "stiffness_kp", "row_weights_s")
    scaled_by_mass = (*LawConfig.scaled_by_mass, "load_rate_xyz", "load_max_n")
    scaled_by_row = ("inertia_md", "lambda_gain", "damping_kd", "stiffness_kp", "robust_scale")
    scaled_by_joint = ("moment_rate", "friction_rate")
    shared_by_links = ("moment_rate",)
    tuned_gains = tuned_gain.ADAPTIVE

    law: Literal["adaptive"]
    inertia_md: PositiveRows
    """M_d of the paper, kg and kg m^2."""
    lambda_gain: PositiveRows
    """Lambda of the paper."""
    phi: PositiveRows
    """Phi of the paper, 1/s."""
    damping_kd: PositiveRows
    """K_d of the paper."""
    stiffness_kp: PositiveRows
    """K_p of the paper; must equal (K_d - M_d Phi) Phi (gain_cond)."""
    row_weights_s: NonNegativeRows
    """S: weight of each row in ||s||, ||xi|| and ||chi_dd||. Those of the attitude count as 0: PX4 controls it."""
    robust_scale: PositiveRows = (1.0,) * 7
    """Factor on each row of the robust term, -rho S^2 s / max(||S s||, varpi): 1 on the machine of `found_for`."""
    h_initial: Positive4
    """Initial values H_0(0) to H_3(0)."""
    zeta_initial: Positive
    nu: Positive4
    """Leakage of H_0 to H_3, 1/s."""
    epsilon: Positive
    boundary_layer: Positive
    """varpi of the paper."""
    rho_max: Positive
    acceleration_cap: NonNegative
    """Largest ||S chi_dd|| that may enter rho; 0 disables H_3."""
    acceleration_lowpass_hz: Positive
    h_max: Positive4 | None = None
    """Upper bounds of H_0 to H_3 (projection); if null, only the leakage bounds them, as in the paper."""
    load_rate_xyz: NonNegative3 = (0.0, 0.0, 0.0)
    """Adaptation rate Gamma of the adaptive load on x, y and z, kg/s^2; 0 disables it, as in the paper."""
    load_leakage: NonNegative = 0.0
    """Leakage of every adaptive load, 1/s."""
    load_max_n: NonNegative = 8.0
    """Bound of the adaptive load on x, y and z (projection)."""
    moment_rate: NonNegativeJoints = (0.0,)
    """Adaptation rate Gamma of the adaptive first moments of the links, kg s^2; 0 disables them."""
    moment_max_kg_m: NonNegative = 0.3
    """Bound of the adaptive first moments (projection)."""
    friction_rate: NonNegativeJoints = (0.0,)
    """Adaptation rate Gamma of the adaptive joint friction, kg m^2/s^2; 0 disables it."""
    friction_max_nm: NonNegative = 0.3
    """Bound of the adaptive joint friction (projection)."""
    arm_gravity_nominal: bool = True
    """Whether the arm's gravity torque, computed with the masses in the vehicle file, is fed forward."""
    base_compliance_xyz: NonNegative3 = (0.0, 0.0, 0.0)
    """Fraction of the measured F_ext that enters e_tau on the base rows; 0 as in the paper."""
    arm_inertia_nominal: bool = False
    """Whether the arm's nominal inertia and Coriolis torque are fed forward in place of M_d. The vehicle and the coupling remain
    unmodelled."""
    online: OnlineConfig | None = None
    """Optimisation of the target impedance in flight; null disables it."""

    @model_validator(mode="after")
    def _conditions(self) -> Self:
        problems: list[tuple[Location, str]] = []
        rows = zip(self.inertia_md, self.damping_kd, self.phi, self.stiffness_kp, strict=True)
        for row, (m_d, k_d, phi, k_p) in enumerate(rows):
            if not k_d / m_d - phi > 0:
                problems.append(
                    (("damping_kd", row), f"gain_new requires K_d / M_d > Phi, got {k_d / m_d:g} <= {phi:g}")
                )
                continue
            wanted = (k_d - m_d * phi) * phi
            if abs(wanted - k_p) > 2e-3 * k_p:
                problems.append(
                    (("stiffness_kp", row), f"gain_cond requires (K_d - M_d Phi) Phi = {wanted:g}, got {k_p:g}")
                )
        refuse("controller", problems)
        return self

    @property
    def damping_d(self) -> tuple[float, ...]:
        """D = K_d - M_d Phi of the paper, one value for each row. It is positive: this is gain_new."""
        rows = zip(self.damping_kd, self.inertia_md, self.phi, strict=True)
        return tuple([k_d - m_d * phi for k_d, m_d, phi in rows])

    def with_impedance_scale(self, k: float) -> Self:
        """Return the settings with Phi and Lambda of x, y and z times k, as `online` scales them in flight."""
        scaled = {
            key: tuple([six_digits(k * gain) if row < 3 else gain for row, gain in enumerate(getattr(self, key))])
            for key in ("phi", "lambda_gain")
        }
        return self.with_gains({**scaled, "damping_d": self.damping_d})

    def with_gains(self, gains: Mapping[str, Any]) -> Self:
        """Return the settings with other values of some keys; `damping_d` is D.

        K_d = D + M_d Phi and K_p = D Phi follow, so that gain_new and gain_cond hold for all positive M_d, Phi and D.
        """
        changed = {key: value for key, value in gains.items() if key != "damping_d"}
        m_d, phi = (changed.get(key, getattr(self, key)) for key in ("inertia_md", "phi"))
        rows = [*zip(gains.get("damping_d", self.damping_d), m_d, phi, strict=True)]
        changed["damping_kd"] = tuple([d + m_d * phi for d, m_d, phi in rows])
        changed["stiffness_kp"] = tuple([d * phi for d, _, phi in rows])
        return super().with_gains(changed)


class CscConfig(LawConfig):
    """Complete-system compliance (after Cataldi et al., IROS 2016): one impedance for vehicle and arm, realised by the nominal model.

    Rows are chi = [x y z | roll pitch yaw | joints]. All matrices are diagonal, and all lists of rows have the same length, 7 to 13: 6
    values and one or more for the joints. A vehicle with n joints uses the first 6 + n values; if there are fewer, the last value
    applies to the remaining joints too.
    """

    presets = ("tuned_extras", "tuned")
    gain_lists = scaled_by_row = ("inertia_md", "damping_kd", "stiffness_kp")
    tuned_gains = tuned_gain.CSC

    law: Literal["csc"]
    inertia_md: PositiveRows
    """Desired inertia M_d, kg and kg m^2."""
    damping_kd: PositiveRows
    """K_d. On the attitude rows it describes the damping of PX4's attitude loop and has no effect on commands."""
    stiffness_kp: PositiveRows
    """K_p. On the attitude rows it describes the stiffness of PX4's attitude loop and has no effect on commands."""
    external_xyz: NonNegative3 = (1.0, 1.0, 1.0)
    """Fraction of the measured F_ext, per world axis, that acts on the base's impedance and is cancelled by means of the model."""
    desired_force_xyz: NonNegative3 = (0.0, 0.0, 0.0)
    """Fraction of F_d, per world axis, that the base carries. If it is 0, the base also yields to a carried payload."""
    model_mass_scale: Positive = 1.0
    """Factor by which the law multiplies the masses and inertias of the vehicle file, for studies of model errors."""


class PscConfig(LawConfig):
    """Partitioned compliance (after Wang et al., RA-L 2024): an impedance for the arm only and position control of the vehicle.

    The lists of joint gains have the same length, 1 to 7. A vehicle with n joints uses the first n values; if there are fewer, the last
    value applies to the remaining joints too.
    """

    presets = ("tuned_extras", "tuned")
    gain_lists = scaled_by_joint = ("arm_inertia_md", "arm_damping_kd", "arm_stiffness_kp")
    tuned_gains = tuned_gain.PSC

    law: Literal["psc"]
    position_kp_xyz: Positive3
    """Position gain per world axis, 1/s^2."""
    position_kd_xyz: Positive3
    """Velocity gain per world axis, 1/s."""
    position_ki_xyz: NonNegative3
    """Integral gain per world axis, 1/s^3; 0 disables the integral term."""
    integral_max_m_s2: NonNegative = 1.5
    """Largest acceleration of the integral term, per axis."""
    arm_inertia_md: PositiveJoints
    """M_d of the joints, kg m^2."""
    arm_damping_kd: PositiveJoints
    arm_stiffness_kp: PositiveJoints
    payload_time_s: Positive
    """Time constant of the estimate of the payload's mass."""
    payload_max_kg: NonNegative = 1.0
    """Upper bound of the mass estimate; 0 disables the estimate."""
    thrust_lag_s: NonNegative = 0.05
    """Lag between commanded and actual thrust that the mass estimate assumes."""


@functools.cache
def law_class(law: str) -> Any:
    """Return the class of an installed control law, whose instances implement `companion.control.types.Law`.

    Raises:
        PluginError: the law is not installed or cannot be imported, or its settings or presets are invalid.
    """
    plugin = plugins.find(plugins.CONTROL_LAWS, law)
    found = plugin.load()
    settings = getattr(found, "settings", None)
    if not (isinstance(settings, type) and issubclass(settings, ControllerConfig)):
        raise plugin.error("its attribute 'settings' is not a subclass of companion.config.controller.ControllerConfig")
    if get_args(settings.model_fields["law"].annotation) != (law,):
        raise plugin.error(f"the field 'law' of {settings.__name__} is not Literal[\"{law}\"]")
    if not settings.presets and not settings.needs_file:
        raise plugin.error(f"{settings.__name__} names no presets")
    for path in (_preset_file(settings, law, preset) for preset in settings.presets):
        if not path.exists():
            raise plugin.error(f"the preset file {path} does not exist")
    return found


def preset_file(law: str, preset: str) -> Path:
    """Return the path of the file of a preset, which is one of `PRESETS[law]`."""
    return _preset_file(LAWS[law], law, preset)


def _preset_file(settings: type[ControllerConfig], law: str, preset: str) -> Path:
    module = Path(str(sys.modules[settings.__module__].__file__))
    return module.parent / "files" / "controllers" / f"{law}_{preset}.yaml"


T = TypeVar("T")


class _OfLaws(Mapping[str, T]):
    """A mapping from each installed law to a value, which is read from the law's class on access.

    Raises:
        PluginError: on access, the law cannot be used.
    """

    def __init__(self, read: Callable[[Any], T]) -> None:
        self._read = read

    def __getitem__(self, law: str) -> T:
        if law not in self:
            raise KeyError(law)
        return self._read(law_class(law))

    def __contains__(self, law: object) -> bool:
        return law in plugins.installed(plugins.CONTROL_LAWS)

    def __iter__(self) -> Iterator[str]:
        return iter(plugins.installed(plugins.CONTROL_LAWS))

    def __len__(self) -> int:
        return len(plugins.installed(plugins.CONTROL_LAWS))


LAWS: Mapping[str, type[ControllerConfig]] = _OfLaws(lambda law: law.settings)
"""Settings of each installed law."""
PRESETS: Mapping[str, tuple[str, ...]] = _OfLaws(lambda law: law.settings.presets)
"""Built-in presets of each installed law, with the default last."""


def _of_its_law(value: Any) -> Any:
    return law_class(str(value.get("law"))).settings.model_validate(value) if isinstance(value, dict) else value


AnyControllerConfig = Annotated[SerializeAsAny[ControllerConfig], BeforeValidator(_of_its_law)]
"""Type for a field of another model: settings of the law that their key `law` names."""
