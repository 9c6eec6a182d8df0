"""A learned policy as a control law: every `period_ticks` ticks it turns an observation into an action, a force and joint torques.

The action acts from the next tick on: 5 ms later. In training the same class flies, with the agent in place of the network.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from msgspec.structs import replace
from pydantic import ValidationError

from companion import DISTRIBUTION
from companion.config.controller import LawConfig, law_class
from companion.config.document import ConfigError
from companion.config.policy import CARD, PolicyCard, PolicyConfig
from companion.config.vehicle import Vehicle
from companion.control.common import Actuation
from companion.control.types import Law, PlantState, Wrench
from companion.model.constants import GRAVITY_M_S2, TICK_PERIOD_S
from companion.model.frames import body_x_z_axes_world
from companion.model.types import Reference

TIME_MAX_S = 0.5 * TICK_PERIOD_S
"""Longest time that a network may take for one action on the computer that flies."""
_TIMED = 10
_VECTORS = {
    "position_error_world_m": 5.0,
    "velocity_error_world_m_s": 10.0,
    "reference_acceleration_world_m_s2": 20.0,
    "acceleration_world_m_s2": 100.0,
    "body_z_world": 1.0,
    "angular_rate_body_rad_s": 20.0,
    "force_ext_world_n": 100.0,
    "base_force_world_n": 200.0,
}
_PER_JOINT = {"joint_angle_rad": 7.0, "joint_error_rad": 7.0, "joint_error_rate_rad_s": 50.0, "base_torque_nm": 50.0}
"""Quantities of an observation, with the bound to which each of its elements is clipped."""


def observation_bounds(joints: int) -> dict[str, float]:
    """Return the names of the observation's elements, in order, with the bound to which each is clipped.

    A name gives quantity, frame and unit, with the index of the axis or joint in brackets. Errors are measured minus reference;
    `force_ext_world_n` is the law's filtered force on the net; `base_force_world_n` and `base_torque_nm` are what the base law
    commands, the force less the weight.
    """
    groups = ((_VECTORS, 3), (_PER_JOINT, joints))
    return {f"{name}[{i}]": bound for group, count in groups for name, bound in group.items() for i in range(count)}


def action_names(joints: int) -> tuple[str, ...]:
    """Return the names of the action's elements, as those of `observation_bounds`."""
    return (*(f"force_world_n[{i}]" for i in range(3)), *(f"arm_torque_nm[{i}]" for i in range(joints)))


class SteeredLaw:
    """A base law whose wrench a policy changes or replaces.

    Args:
        card: the policy.
        vehicle, hover_thrust: as for every law.
        decide: returns the action for an observation, before scaling.
    """

    def __init__(
        self,
        card: PolicyCard,
        vehicle: Vehicle,
        hover_thrust: float,
        decide: Callable[[Sequence[float]], Sequence[float]],
    ) -> None:
        assert isinstance(card.base, LawConfig)
        self.hover_thrust = hover_thrust
        self._base: Law = law_class(card.base.law)(card.base, vehicle, hover_thrust)
        self._actuation = Actuation(card.base, vehicle, hover_thrust)
        self._share = 1.0 if card.action == "residual" else 0.0
        self._weight_n = vehicle.airframe.mass_kg * GRAVITY_M_S2
        self._scale, self._period_ticks = card.action_scale, card.period_ticks
        self._bounds = tuple(observation_bounds(len(vehicle.arm.joints)).values())
        self._decide = decide
        self._ticks = 0
        self.action: tuple[float, ...] = (0.0,) * len(card.action_scale)
        """Force, N, and joint torques, N m, that act in the next tick."""

    def step(self, dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        """Run one tick; see `companion.control.types.Controller`. The policy does not act while the rotors spool."""
        self._base.hover_thrust = self.hover_thrust
        wrench = self._base.step(dt_s, state, reference, vertical_scale)
        if vertical_scale < 1.0:
            return wrench
        tau, action, share, body_z = (
            wrench.log.tau,
            self.action,
            self._share,
            body_x_z_axes_world(state.attitude_wxyz)[1],
        )
        weight_n = (1.0 - share) * self._weight_n
        force_n = (share * tau[0] + action[0], share * tau[1] + action[1], share * tau[2] + weight_n + action[2])
        torque_nm = tuple([share * base + added for base, added in zip(tau[6:], action[3:], strict=True)])
        if self._ticks % self._period_ticks == 0:
            self.set_action(self._decide(self._observe(state, reference, wrench, body_z)))
        self._ticks += 1
        sent = self._actuation
        sent.step(dt_s, force_n, torque_nm, body_z, reference.yaw_rad, vertical_scale, reference.yaw_rate_rad_s)
        before = wrench.log.saturated if share else sent.clipped
        z, xy, arm = [own or of_base for own, of_base in zip(sent.clipped, before, strict=True)]
        log = replace(
            wrench.log,
            tau=(*sent.force_world_n, 0.0, 0.0, 0.0, *sent.arm_torque_nm),
            attitude_desired_rad=sent.roll_pitch_yaw_rad,
            saturated=(z, xy, arm),
        )
        return Wrench(
            attitude_wxyz=sent.attitude_wxyz, collective_n=sent.collective_n, arm_torque_nm=sent.arm_torque_nm, log=log
        )

    def set_action(self, action: Sequence[float]) -> None:
        """Set the action that acts from the next tick on; its elements are clipped to -1 and 1, and NaN stays NaN."""
        pairs = zip(action, self._scale, strict=True)
        self.action = tuple([min(max(float(part), -1.0), 1.0) * scale for part, scale in pairs])

    def _observe(self, state: PlantState, reference: Reference, wrench: Wrench, body_z: Sequence[float]) -> list[float]:
        """Return the observation, in the order of `observation_bounds`; NaN stays NaN."""
        log = wrench.log
        values = [
            *log.error[:3],
            *log.error_rate[:3],
            *reference.acceleration_world_m_s2,
            *state.acceleration_world_m_s2,
            *body_z,
            *state.angular_rate_body_rad_s,
            *log.force_ext_world_n,
            log.tau[0],
            log.tau[1],
            log.tau[2] - self._weight_n,
            *state.arm_rad,
            *log.error[6:],
            *log.error_rate[6:],
            *log.tau[6:],
        ]
        return [min(max(value, -bound), bound) for value, bound in zip(values, self._bounds, strict=True)]


class Network:
    """The network in an ONNX file, on one thread, so that the same inputs give the same bits.

    Raises:
        ValueError: the file cannot be used; the text is one line that begins with its name.
    """

    def __init__(self, file: str) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise ValueError(f"{file}: needs onnxruntime: pip install '{DISTRIBUTION}[policy]'") from None
        try:
            content = Path(file).read_bytes()
        except OSError as error:
            raise ValueError(f"{file}: cannot be read: {error.strerror}") from None
        self.sha256 = hashlib.sha256(content).hexdigest()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # what onnxruntime prints is in its exception as well
        try:
            session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # it has no common class
            first = str(error).splitlines()[0]
            raise ValueError(f"{file}: expected a policy in an ONNX file, found none: {first}") from None
        inputs, outputs = session.get_inputs(), session.get_outputs()
        if len(inputs) != 1 or len(outputs) != 1:
            raise ValueError(f"{file}: expected one input and one output, found {len(inputs)} and {len(outputs)}")
        card = session.get_modelmeta().custom_metadata_map.get(CARD)
        if card is None:
            raise ValueError(
                f"{file}: its metadata have no key '{CARD}', which says what it was trained for (docs/gym.md)"
            )
        try:
            self.card = PolicyCard.model_validate_json(card)
        except ValidationError as error:
            problem = error.errors()[0]
            at = ".".join(map(str, problem["loc"]))
            raise ValueError(f"{file}: metadata '{CARD}': {at}: {problem['msg']}") from None
        for what, port, wanted in (
            ("input", inputs[0], len(self.card.observations)),
            ("output", outputs[0], len(self.card.actions)),
        ):
            if port.type != "tensor(float)" or list(port.shape) != [1, wanted]:
                raise ValueError(f"{file}: expected an {what} of 1 x {wanted} float32, found {port.shape} {port.type}")
        self._run: Any = session.run
        self._input = inputs[0].name
        self._offset = np.array(self.card.observation_offset, np.float32)
        self._scale = np.array(self.card.observation_scale, np.float32)

    def decide(self, observation: Sequence[float]) -> list[float]:
        """Return the network's output for an observation."""
        row = (np.array(observation, np.float32) - self._offset) / self._scale
        output: list[float] = self._run(None, {self._input: row[None]})[0][0].tolist()
        return output


class PolicyLaw(SteeredLaw):
    """The law: a policy in an ONNX file."""

    settings: ClassVar = PolicyConfig

    def __init__(self, config: PolicyConfig, vehicle: Vehicle, hover_thrust: float) -> None:
        network = Network(config.file)
        if config.sha256 not in (None, network.sha256):
            raise ValueError(
                f"{config.file}: is not the file that flew: its SHA-256 is {network.sha256}, not {config.sha256}"
            )
        super().__init__(network.card, vehicle, hover_thrust, network.decide)

    @staticmethod
    def for_vehicle(vehicle: Vehicle, config: PolicyConfig) -> PolicyConfig:
        """Return the settings with the file's SHA-256, after checking before the flight that the policy fits the vehicle.

        Raises:
            ConfigError: the file is not a policy, was trained for another vehicle, returns NaN, draws its
                actions or takes too long.
        """
        try:
            network = Network(config.file)
        except ValueError as error:
            raise ConfigError(str(error)) from None
        problem = _problem_of(network, vehicle)
        if problem is not None:
            raise ConfigError(f"{config.file}: {problem}")
        return config.model_copy(update={"sha256": network.sha256})


def _problem_of(network: Network, vehicle: Vehicle) -> str | None:
    """Return why a policy cannot fly a vehicle, or None if it can."""
    card, joints, mass_kg = network.card, len(vehicle.arm.joints), vehicle.airframe.mass_kg
    if (card.vehicle, card.mass_kg) != (vehicle.name, mass_kg):
        trained = f"'{card.vehicle}' of {card.mass_kg:g} kg"
        return f"was trained for the vehicle {trained}, but this one is '{vehicle.name}' of {mass_kg:g} kg"
    for what, found, wanted in (
        ("observations", card.observations, tuple(observation_bounds(joints))),
        ("actions", card.actions, action_names(joints)),
    ):
        if found != wanted:
            differ = [name for name in (*found, *wanted) if (name in found) != (name in wanted)]
            return f"its {what} are not those of this companion and vehicle: {differ[0] if differ else 'another order'}"
    fastest_s, answers = math.inf, dict[int, list[float]]()
    for step in range(_TIMED):
        deviations = (step % 3 - 1.0) * np.array(card.observation_scale)  # -1, 0 and 1 after normalisation
        begin_s = time.perf_counter()
        action = network.decide((np.array(card.observation_offset) + deviations).tolist())
        fastest_s = min(fastest_s, time.perf_counter() - begin_s)
        if not all(map(math.isfinite, action)):
            return f"returns {action}, which is not finite"
        if answers.setdefault(step % 3, action) != action:
            return "returns different actions for the same observation; export its mean, without sampling or dropout"
    if fastest_s > TIME_MAX_S:
        return f"takes {fastest_s * 1e3:.1f} ms for an action (limit {TIME_MAX_S * 1e3:g} ms, half a tick)"
    return None
