"""Differences between laboratories, drawn from the seed: numbers that a world file gives as distributions, and the signs of the model
error.
"""

from __future__ import annotations

import copy
import json
import math
import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from companion.config.base import Location, Model, Vector2
from companion.config.document import RANK_VALUE, ConfigError, Document, key_path, problem_lines
from companion.config.explain import nearest, problem, schema_of, validate, values
from companion.sitl_config.effects.machine import Machine
from companion.sitl_config.per_joint import of_joints
from companion.sitl_config.world import World

if TYPE_CHECKING:
    import numpy as np

_FAULTLESS = Machine(
    on=True,
    centre_of_mass_m=(0.0, 0.0, 0.0),
    inertia_error=(0.0, 0.0, 0.0),
    shoulder_offset_m=(0.0, 0.0, 0.0),
    shoulder_rpy_deg=(0.0, 0.0, 0.0),
    link_length_error_m=(0.0, 0.0),
    link_com_error_m=(0.0, 0.0),
)
"""The vehicle exactly as the vehicle file describes it."""
NORMAL_ENDS = 3.0
"""Number of standard deviations at which a normal distribution is truncated."""
_PARAMETERS = {
    "uniform": "[low, high] with low < high",
    "log_uniform": "[low, high] with 0 < low < high",
    "normal": "[mean, sigma] with sigma > 0",
}
DISTRIBUTIONS = tuple(_PARAMETERS)
_DIGITS = 6
_EXPECTED = "expected a number, {uniform: [low, high]}, {log_uniform: [low, high]} or {normal: [mean, sigma]}"


class Uniform(Model):
    """A number drawn uniformly from an interval."""

    uniform: Vector2
    """[low, high], with low < high."""


class LogUniform(Model):
    """A number whose logarithm is drawn uniformly from an interval."""

    log_uniform: Vector2
    """[low, high], with 0 < low < high."""


class Normal(Model):
    """A number drawn from a normal distribution, truncated at 3 sigma."""

    normal: Vector2
    """[mean, sigma], with sigma > 0."""


Distribution = Uniform | LogUniform | Normal


class Range(Model):
    """One number of the world and its distribution."""

    at: tuple[str | int, ...]
    """Keys and indices of the number in the world."""
    distribution: Distribution

    @property
    def key(self) -> str:
        """Location of the number as text, such as `imu.accel_bias_m_s2[0]`."""
        return key_path(self.at)

    @property
    def ends(self) -> Vector2:
        """Smallest and largest number that can be drawn."""
        if isinstance(self.distribution, Uniform):
            return self.distribution.uniform
        if isinstance(self.distribution, LogUniform):
            return self.distribution.log_uniform
        mean, sigma = self.distribution.normal
        return (mean - NORMAL_ENDS * sigma, mean + NORMAL_ENDS * sigma)

    def sample(self, seed: int) -> float:
        """Draw the number, rounded to six digits; it depends only on the seed and the key."""
        rng = _generator(seed, self.key)
        low, high = self.ends
        if isinstance(self.distribution, Uniform):
            value = float(rng.uniform(low, high))
        elif isinstance(self.distribution, LogUniform):
            value = math.exp(float(rng.uniform(math.log(low), math.log(high))))
        else:
            mean, sigma = self.distribution.normal
            value = math.inf
            while not low <= value <= high:
                value = float(rng.normal(mean, sigma))
        return min(max(float(f"{value:.{_DIGITS}g}"), low), high)


class Laboratory(Model):
    """A world file and those of its numbers that are drawn from the seed."""

    name: str = "ideal"
    """Name of a built-in world, or path of a file as the user gave it."""
    ranges: tuple[Range, ...] = ()

    def drawn(self, world: World) -> dict[str, Any]:
        """Return the drawn numbers of a world by their keys."""
        data = world.model_dump(mode="json")
        return {one.key: _get(data, one.at) for one in self.ranges if _holds(data, one.at)}

    def without(self, keys: Sequence[str]) -> Laboratory:
        """Return the laboratory without the ranges at or below these keys of the world, so that they are not drawn."""
        return self.model_copy(update={"ranges": tuple(one for one in self.ranges if one.at[0] not in keys)})


def _generator(seed: int, key: str) -> np.random.Generator:
    import numpy as np  # the import takes a tenth of a second, and a command in the ideal world draws nothing

    return np.random.default_rng((seed, zlib.crc32(key.encode())))


def draw(data: dict[str, Any], ranges: Sequence[Range], seed: int) -> dict[str, Any]:
    """Return a copy of a world's plain data in which each range is replaced by a sample.

    The same seed gives the same laboratory. Adding or removing a range does not change any other sample.

    Args:
        data: plain data of a world. A range at a missing location (a section that is null, a shorter list) is ignored.
    """
    return _filled(data, [(one.at, one.sample(seed)) for one in ranges])


def with_model_error(world: World, joints: int) -> World:
    """Return the world of an arm with so many joints, `model_error` added to its errors of masses, inertia and torque constants."""
    if world.model_error == 0.0:
        return world

    def off(error: float, key: str) -> float:
        sign = 1.0 if _generator(world.seed, f"model_error.{key}").random() < 0.5 else -1.0
        return (1.0 + error) * (1.0 + sign * world.model_error) - 1.0

    machine, links = world.machine if world.machine.on else _FAULTLESS, of_joints(world.link_mass_error, joints)
    servos = [world.servo(joint) for joint in range(joints)]
    x, y, z = machine.inertia_error
    return world.model_copy(
        update={
            "mass_error": off(world.mass_error, "mass"),
            "link_mass_error": tuple(off(error, f"link{number}") for number, error in enumerate(links, start=1)),
            "machine": machine.model_copy(
                update={"inertia_error": (off(x, "inertia"), off(y, "inertia"), off(z, "inertia"))}
            ),
            "servos": tuple(
                servo.model_copy(update={"torque_per_amp_error": off(servo.torque_per_amp_error, f"servo{index}")})
                for index, servo in enumerate(servos)
            ),
        }
    )


def take_ranges(document: Document) -> tuple[Range, ...]:
    """Return the distributions in the document of a world; report invalid distributions in the document's problems.

    A valid number replaces each invalid distribution, so that it is reported only once.
    """
    found: list[Range] = []
    if not any(isinstance(value, dict | list) for value in document.data.values()):
        return ()  # without the schema, which takes long to generate
    for at, node, value in list(values(schema_of(World), document.data)):
        if not isinstance(value, dict) or node is None or node.get("type") != "number":
            continue
        try:
            found.append(Range(at=at, distribution=_distribution(value)))
        except ValueError as error:
            document.problems.append(problem(RANK_VALUE, document.origin(at), at, str(error)))
            _put(document.data, at, _acceptable(node))
    return tuple(found)


def check_world(document: Document, ranges: Sequence[Range], seed: int) -> World:
    """Draw and validate a world. Both ends of every range must be valid, so that acceptance of a file does not depend on the seed.

    Raises:
        ConfigError: the world has problems; the exception has one message per problem.
    """
    if ranges:
        at_ends = []
        for end in range(2):
            data = _filled(document.data, [(one.at, one.ends[end]) for one in ranges])
            ends = replace(document, data=data, problems=list(document.problems))
            validate(World, ends)
            at_ends.append(set(ends.problems))
        everywhere = at_ends[0] & at_ends[1]
        lines = problem_lines(list(everywhere))
        for name, problems in zip(("lower", "upper"), at_ends, strict=True):
            lines += [
                f"{line} at the {name} end of the drawn range" for line in problem_lines(list(problems - everywhere))
            ]
        if lines:
            raise ConfigError(lines)
        document.data = draw(document.data, ranges, seed)
    world = validate(World, document)
    if world is None:
        raise ConfigError(problem_lines(document.problems))
    return world


def _distribution(value: dict[str, Any]) -> Distribution:
    """Parse a distribution; raises ValueError with a text for the user."""
    if len(value) != 1:
        raise ValueError(f"{_EXPECTED}, got a mapping with {len(value)} keys")
    ((name, pair),) = value.items()
    if name not in DISTRIBUTIONS:
        close = nearest(str(name), list(DISTRIBUTIONS))
        raise ValueError(
            f"unknown distribution {json.dumps(name)}; " + (f"did you mean {close}?" if close else _EXPECTED)
        )
    names = _PARAMETERS[name]
    numbers = isinstance(pair, list) and all(type(x) in (int, float) and math.isfinite(x) for x in pair)
    if (
        not numbers
        or len(pair) != 2
        or not (pair[1] > 0 if name == "normal" else pair[0] < pair[1])
        or (name == "log_uniform" and not pair[0] > 0)
    ):
        raise ValueError(f"{name}: expected {names}, got {pair}")
    first, second = map(float, pair)
    if name == "log_uniform":
        return LogUniform(log_uniform=(first, second))
    return Uniform(uniform=(first, second)) if name == "uniform" else Normal(normal=(first, second))


def _acceptable(node: dict[str, Any]) -> float:
    """Return a number within the bounds of a schema node."""
    low = node.get("minimum", node.get("exclusiveMinimum"))
    high = node.get("maximum", node.get("exclusiveMaximum"))
    if low is not None and high is not None:
        return float(0.5 * (low + high))
    return float(low + 1.0 if low is not None else high - 1.0 if high is not None else 0.0)


def _filled(data: dict[str, Any], numbers: Sequence[tuple[Location, float]]) -> dict[str, Any]:
    data = copy.deepcopy(data)
    for at, number in numbers:
        if _holds(data, at):
            _put(data, at, number)
    return data


def _holds(data: Any, at: Location) -> bool:
    try:
        _get(data, at)
    except (KeyError, IndexError, TypeError):
        return False
    return True


def _get(data: Any, at: Location) -> Any:
    for step in at:
        data = data[step]
    return data


def _put(data: Any, at: Location, value: float) -> None:
    _get(data, at[:-1])[at[-1]] = value
