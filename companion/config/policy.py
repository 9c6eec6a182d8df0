"""The settings of the law `policy`, and what the file of a policy states about it."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from companion.config.base import Model, Positive, refuse
from companion.config.controller import AnyControllerConfig, ControllerConfig, LawConfig

CARD = "companion"
"""Key of the ONNX file's metadata whose value is the policy's card, as JSON."""
PolicyAction = Literal["residual", "wrench"]


class PolicyConfig(ControllerConfig):
    """A learned policy in an ONNX file, run by onnxruntime: a residual on a base law, or the whole wrench."""

    needs_file: ClassVar = True

    law: Literal["policy"]
    file: str
    """Path of the ONNX file, relative to the working directory."""
    sha256: str | None = None
    """SHA-256 of the file that flew. The companion sets it; files leave it out."""


class PolicyCard(Model):
    """What an ONNX file states about its policy: for which machine it was trained, with which base law, inputs and outputs."""

    schema_version: Literal[1] = 1
    vehicle: str
    """Name of the vehicle for which the policy was trained."""
    mass_kg: Positive
    """Its mass."""
    action: PolicyAction
    """`residual`: the action is added to the base law's force and torques. `wrench`: it replaces them, and its force is added to the
    weight."""
    base: AnyControllerConfig
    """Base law with its gains, as they flew in training. It also flies where the policy does not act: while the rotors spool."""
    period_ticks: Annotated[int, Field(ge=1, le=50)]
    """Number of ticks for which an action is held."""
    observations: tuple[str, ...]
    """Names of the inputs, in order (`companion.control.policy.observation_bounds`)."""
    observation_offset: tuple[float, ...]
    """The network's input is (observation - offset) / scale."""
    observation_scale: tuple[Positive, ...]
    actions: tuple[str, ...]
    """Names of the outputs, in order (`companion.control.policy.action_names`)."""
    action_scale: tuple[Positive, ...]
    """Force (N) and joint torque (N m) of an output of 1; outputs are clipped to -1 and 1."""

    @model_validator(mode="after")
    def _lists_fit(self) -> Self:
        pairs = (
            ("observation_offset", "observations"),
            ("observation_scale", "observations"),
            ("action_scale", "actions"),
        )
        sizes = [(key, len(getattr(self, key)), len(getattr(self, names))) for key, names in pairs]
        wrong = [((key,), f"expected {wanted} values, got {found}") for key, found, wanted in sizes if found != wanted]
        if not isinstance(self.base, LawConfig):
            wrong.append((("base",), f"the law '{self.base.law}' has none of the settings that laws share (LawConfig)"))
        refuse("policy", [(tuple(at), text) for at, text in wrong])
        return self
