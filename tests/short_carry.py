"""A carry by two vehicles for tests of what is done with it, as `tests/short_catch.yaml` is a catch."""

SHORT_CARRY = (
    "mission.limits.acceleration_max_m_s2=1.2",
    "mission.limits.jerk_max_m_s3=12.0",
    "mission.phases[0]={type: takeoff, height_m: 0.55, duration_s: 1.6}",
    "mission.phases[1].above_m=0.1",
    "mission.phases[1].lower_s=0.8",
    "mission.phases[2].lift_m=0.25",
    "mission.phases[2].lift_s=2",
    "mission.phases[2].waypoints=[{position_m: [-0.85, 0.0], yaw_deg: 85.0}]",
    "mission.phases[3].rise_s=1.0",
    "mission.phases[3].apart_s=2.2",
    "mission.phases[4].speed_m_s=0.6",
    "vehicle.safety.land_speed_m_s=0.5",
    "left.mission.start.position_m=[-1.0, 1.15]",
    "right.mission.start.position_m=[-1.0, -1.15]",
)
"""Overrides of the team `carry`: one short way instead of three."""
