"""The grid of a comparison: controllers with their presets, payloads, model errors and seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from companion.campaigns.process import Message

ABLATED = ("adaptive", "recommended")
LESS = " - "
ADAPTATION = ("on", "off")
ADAPTATION_OFF = f"{LESS}adaptation off"
"""Suffix of the name of a preset that is flown without its adaptation."""
ABLATIONS: dict[str, tuple[str, ...]] = {
    # rho = min(H . b + zeta, rho_max): the first override removes all that H and zeta learn, the paper's adaptation; the others
    # remove the adaptive loads.
    "adaptation off": (
        "controller.rho_max=1.0e-9",
        "controller.load_rate_xyz=[0, 0, 0]",
        "controller.moment_rate=0",
        "controller.friction_rate=0",
    ),
    "H and zeta off": ("controller.rho_max=1.0e-9",),
    "H3 uncapped": ("controller.acceleration_cap=1.0e9",),
    "S = I": ("controller.row_weights_s=[1, 1, 1, 0, 0, 0, 1, 1]",),
    "base feed-forward off": ("controller.force_feedforward_xyz=[0, 0, 0]",),
    # The base does not comply with a force that feed-forward compensates.
    "base rows on": ("controller.base_compliance_xyz=[1, 1, 1]", "controller.force_feedforward_xyz=[0, 0, 0]"),
    "F_d off": ("controller.desired_force_time_s=null",),
    "adaptive force off": ("controller.load_rate_xyz=[0, 0, 0]",),
    "adaptive moments and friction off": ("controller.moment_rate=0", "controller.friction_rate=0"),
    "lead off": ("controller.feedforward_lead_s=0",),
    "arm friction off": ("controller.arm_friction_share=0",),
}
"""Overrides of each ablation of `ABLATED`. The attitude rows remain masked, because PX4 closes that loop."""


def is_ablation(preset: str) -> bool:
    """Return whether the preset is an ablation."""
    return LESS in preset


def short_label(controller: str, preset: str) -> str:
    """Return only the removed part for an ablation, such as ` - F_d off`, otherwise `law/preset`."""
    _, less, what = preset.partition(LESS)
    return f"{less}{what}" if less else f"{controller}/{preset}"


@dataclass(frozen=True, slots=True)
class Variant:
    """A control law with its gains: one line of the table."""

    controller: str
    preset: str
    """Name in the table: a preset, or a preset and the part that is removed from it."""
    base_preset: str | None
    """Preset of a law; None for a file."""
    overrides: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Label of the variant, `law/preset`."""
        return f"{self.controller}/{self.preset}"


def variants_of(
    available: Mapping[str, Sequence[str]],
    controllers: Sequence[str],
    presets: Sequence[str],
    ablation: bool,
    adaptation: Sequence[str] = ADAPTATION[:1],
) -> list[Variant]:
    """Return the variants in the order of the table, one per line. Each law is flown with those requested presets that it has, or
    with all of its presets if it has none of them.

    Args:
        controllers: requested laws; empty for all.
        presets: requested presets; empty for all.
        ablation: whether to add variants of `ABLATED`, each with one part removed.
        adaptation: members of `ADAPTATION`: whether the presets of the adaptive law are flown with their adaptation, without it, or
            both.

    Raises:
        ValueError: there is no such law or preset, or nothing to ablate. The text is one line.
    """
    for law in controllers:
        if law not in available:
            raise ValueError(f"--controllers {law}: no such controller; available: {', '.join(available)}")
    laws = list(dict.fromkeys(controllers)) or list(available)
    for law in controllers:
        if not available[law]:
            raise ValueError(f"--controllers {law}: has no presets; name its file, such as {law}.onnx")
    known = list(dict.fromkeys(preset for law in laws for preset in available[law]))
    for preset in presets:
        if preset not in known:
            raise ValueError(f"--presets {preset}: no such preset of {', '.join(laws)}; available: {', '.join(known)}")
    if ablation and ABLATED[0] not in laws:
        raise ValueError(f"--ablation: applies to {'/'.join(ABLATED)}, but --controllers leaves it out")
    found = []
    for law in laws:
        chosen = [preset for preset in available[law] if preset in presets] or list(available[law])
        if ablation and law == ABLATED[0] and ABLATED[1] not in chosen:
            chosen.append(ABLATED[1])  # an ablation is compared with the complete preset
        for preset in chosen:
            adaptive = law == ABLATED[0]
            less = list(ABLATIONS) if ablation and (law, preset) == ABLATED else []
            if "on" in adaptation or less or not adaptive:
                found.append(Variant(law, preset, preset))
            if "off" in adaptation and adaptive:
                less = list(dict.fromkeys([ADAPTATION_OFF.removeprefix(LESS), *less]))
            found += [Variant(law, f"{preset}{LESS}{what}", preset, ABLATIONS[what]) for what in less]
    return found


def flights_of(
    variants: Sequence[Variant],
    payloads_kg: Sequence[float],
    seeds: Sequence[int],
    model_errors: Sequence[float] = (0.0,),
) -> list[Message]:
    """Return the flights in the order of the table: payload, model error, variant, seed."""
    return [
        {
            "variant": position,
            "controller": variant.controller,
            "preset": variant.preset,
            "payload_kg": payload_kg,
            "model_error": model_error,
            "seed": seed,
        }
        for payload_kg in payloads_kg
        for model_error in model_errors
        for position, variant in enumerate(variants)
        for seed in seeds
    ]
