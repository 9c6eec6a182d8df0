"""The quantities that metrics and plots share, as arrays with one row per tick."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np

from companion.analysis.timing import Array, plausible
from companion.model.best_pose import best_pose
from companion.model.constants import GRADED_POSE_MAX_AGE_S
from companion.model.frames import euler_zyx_from_quat
from companion.model.outputs import Outputs, Sent
from companion.model.types import Inputs, MocapPose

Row = tuple[Inputs, Outputs, Sent]


def array_of(values: Sequence[Any], width: int | None = None) -> Array:
    """Return one row per value: a float (`width` None) or `width` floats; NaN where the value is None, or a number is infinite or so
    large that no quantity of a flight has it.
    """
    if width is None:
        found = np.array([math.nan if v is None else v for v in values], dtype=np.float64)
    else:
        blank = (math.nan,) * width
        # Half the time that np.array needs for a list of tuples.
        flat = np.fromiter(chain.from_iterable([blank if v is None else v for v in values]), np.float64)
        found = flat.reshape(len(values), width)
    return plausible(found)


@dataclass(frozen=True)
class Columns:
    """Arrays with one row per tick; NaN where a value is unknown. World ENU, body FLU."""

    t_s: Array
    mission_t_s: Array
    mocap_position_world_m: Array
    """Position from valid frames with an age of `GRADED_POSE_MAX_AGE_S` or less; PX4's estimate if another program fed PX4."""
    mocap_attitude_rad: Array
    """Roll, pitch, yaw (ZYX)."""
    mocap_age_s: Array
    """Time from the frame's exposure to the tick."""
    reference_position_world_m: Array
    reference_velocity_world_m_s: Array
    attitude_desired_rad: Array
    arm_rad: Array
    arm_reference_rad: Array
    lateness_s: Array


def columns_of(rows: Iterable[Row], joints: int) -> Columns:
    """Return the columns of the rows of a log of an arm with this number of joints."""
    ticks = list(rows)

    def column(value: Callable[[Inputs, Outputs, Sent], Any], width: int | None = None) -> Array:
        return array_of([value(*row) for row in ticks], width)

    def graded(i: Inputs) -> MocapPose | None:
        pose = best_pose(i)
        fresh = pose is not None and pose.tracking_valid and i.t_s - pose.stamp_s <= GRADED_POSE_MAX_AGE_S
        return pose if fresh else None

    poses = [(i.t_s, graded(i)) for i, _, _ in ticks]
    return Columns(
        t_s=column(lambda i, o, s: i.t_s),
        mission_t_s=column(lambda i, o, s: o.mission_t_s),
        mocap_position_world_m=array_of([pose.position_world_m if pose else None for _, pose in poses], 3),
        mocap_attitude_rad=array_of(
            [euler_zyx_from_quat(pose.attitude_wxyz) if pose else None for _, pose in poses], 3
        ),
        mocap_age_s=array_of([t_s - pose.stamp_s + (pose.latency_s or 0.0) if pose else None for t_s, pose in poses]),
        reference_velocity_world_m_s=column(lambda i, o, s: o.reference.velocity_world_m_s if o.reference else None, 3),
        reference_position_world_m=column(lambda i, o, s: o.reference.position_world_m if o.reference else None, 3),
        attitude_desired_rad=column(lambda i, o, s: o.control.attitude_desired_rad if o.control else None, 3),
        arm_rad=column(lambda i, o, s: i.arm.angle_rad if i.arm else None, joints),
        arm_reference_rad=column(lambda i, o, s: o.reference.arm_rad if o.reference else None, joints),
        lateness_s=column(lambda i, o, s: s.lateness_s),
    )
