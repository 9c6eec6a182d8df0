"""The guardian's part of the effective configuration, which the launcher has already checked."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

from companion.io.mocap.system import MocapSettings
from companion.io.team_link import TeamSettings
from companion.safety.pose_filter import PoseLimits


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
    pose_limits: PoseLimits
    """Limits of a pose that is sent to PX4, as in the flight process."""
    team: TeamSettings | None = None
    """`devices.team`; None for a vehicle that flies alone."""


def read_settings(path: Path) -> Settings:
    """Read the settings from `config.json` in the flight's folder."""
    vehicle = json.loads(path.read_text(encoding="utf-8"))["vehicle"]
    devices, safety = vehicle["devices"], vehicle["safety"]
    mocap = devices["mocap"]
    return Settings(
        autopilot_address=devices["autopilot"]["address"],
        mocap=MocapSettings(**{name: mocap[name] for name in MocapSettings.__slots__}),
        clearance_m=vehicle["airframe"]["ground_clearance_m"],
        tilt_max_rad=math.radians(safety["tilt_abort_deg"]),
        timeout_s=safety["guardian_timeout_s"],
        pose_limits=PoseLimits(
            jump_m=safety["mocap_jump_m"],
            jump_rad=math.radians(safety["mocap_jump_deg"]),
            disagreement_m=safety["estimate_disagreement_m"],
            latency_max_s=max(safety["mocap_latency_warn_s"], safety["mocap_latency_max_s"]),
        ),
        team=None if devices.get("team") is None else TeamSettings(**devices["team"]),
    )
