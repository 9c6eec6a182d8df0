"""The guardian's part of the effective configuration, which the launcher has already checked."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

from companion.io.mocap.system import MocapSettings


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of the guardian."""

    autopilot_address: str
    """Address of the link, such as udpin://0.0.0.0:14540."""
    mocap: MocapSettings
    clearance_m: float
    """`airframe.ground_clearance_m`."""
    tilt_max_rad: float
    """`safety.tilt_abort_deg`, in rad."""
    timeout_s: float
    """`safety.guardian_timeout_s`."""


def read_settings(path: Path) -> Settings:
    """Read the settings from `config.json` in the flight's folder."""
    vehicle = json.loads(path.read_text(encoding="utf-8"))["vehicle"]
    devices = vehicle["devices"]
    mocap = devices["mocap"]
    return Settings(
        autopilot_address=devices["autopilot"]["address"],
        mocap=MocapSettings(**{name: mocap[name] for name in MocapSettings.__slots__}),
        clearance_m=vehicle["airframe"]["ground_clearance_m"],
        tilt_max_rad=math.radians(vehicle["safety"]["tilt_abort_deg"]),
        timeout_s=vehicle["safety"]["guardian_timeout_s"],
    )
