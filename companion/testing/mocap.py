"""Checks of the contract of motion-capture systems, which the author of a plug-in calls while the system streams."""

from __future__ import annotations

import asyncio
import itertools
import math
import threading

from companion.config import device_plugins
from companion.config.devices import MocapDevice
from companion.guardian.mocap import GuardianMocap
from companion.io.mocap.driver import MocapDriver, settings_of
from companion.model.types import MocapPose
from companion.plugins import MOCAP_SYSTEMS
from companion.runtime.clock import flight_clock, monotonic

FIRST_POSE_S = 5.0
"""Timeout of the guardian's first tracked pose."""
LATE_READ_S = 0.1
"""Largest error of a stamp in a process that waited for a core between two datagrams (`companion.io.arrival`)."""
AT_REST_M = 0.05
_GUARDIAN_START_S = 100.0
"""The guardian's clock at the start, which differs from the clock with which its client is called."""


def check_mocap(device: MocapDevice, duration_s: float = 1.0) -> None:
    """Check a motion-capture system that streams a tracked body at rest.

    The flight's client and the guardian's must receive the same body at the same time, with frame numbers that increase and stamps that
    are arrivals; they must close without threads left over, and open again.

    Args:
        duration_s: duration for which poses are judged.

    Raises:
        AssertionError: a check fails; the text states what was found.
        DeviceError: the client cannot be opened.
    """
    problems = device_plugins.problems(MOCAP_SYSTEMS, device.type, device.options)
    assert not problems, f"devices.mocap: {problems}"
    for _ in range(2):
        asyncio.run(_both_clients(device, duration_s))


async def _both_clients(device: MocapDevice, duration_s: float) -> None:
    before, clock = set(threading.enumerate()), flight_clock()
    poses: list[MocapPose] = []
    seen: list[MocapPose] = []
    guardian, origin_s = GuardianMocap(settings_of(device)), monotonic() - _GUARDIAN_START_S
    try:
        async with MocapDriver(device, clock, poses.append) as driver:
            deadline_s, ends_s = clock() + FIRST_POSE_S, clock() + duration_s
            while clock() < ends_s or (not any(pose.tracking_valid for pose in seen) and clock() < deadline_s):
                guardian.keep_connected()
                seen += guardian.poses(origin_s)
                await asyncio.sleep(0.01)
            if device.ball is not None:
                assert driver.markers() is not None, f"markers() has no frame of {driver.client.where}"
            counts, server = driver.counts(), driver.server
            assert server is not None and server.name and server.name.isprintable(), f"server_name: {server}"
            assert not counts.malformed, f"{counts.malformed} malformed datagrams: {counts.problem}"
            assert counts.callback_error is None, counts.callback_error
            ended_s, guardian_s = clock(), monotonic() - origin_s
    finally:
        guardian.close()
    _check(poses, "flight")
    _check(seen, f"guardian ({guardian.problem})")
    assert poses[-1].stamp_s <= ended_s, f"a pose is stamped {poses[-1].stamp_s:g} s at {ended_s:g} s"
    assert guardian_s - FIRST_POSE_S <= seen[-1].stamp_s <= guardian_s, (
        f"the guardian's pose is stamped {seen[-1].stamp_s:g} s at {guardian_s:g} s: stamp with `now_s`"
    )
    apart_m = math.dist(_tracked(poses)[-1].position_world_m, _tracked(seen)[-1].position_world_m)
    assert apart_m <= AT_REST_M, f"flight and guardian see the body {apart_m:.2f} m apart, limit {AT_REST_M:g} m"
    left = [thread.name for thread in set(threading.enumerate()) - before]
    assert not left, f"still running after the clients were closed: {', '.join(left)}"


def _check(poses: list[MocapPose], client: str) -> None:
    assert len(_tracked(poses)) > 1, f"the client of the {client} has {len(_tracked(poses))} tracked poses"
    for earlier, later in itertools.pairwise(poses):
        assert earlier.frame_number < later.frame_number, (
            f"frame {later.frame_number} follows frame {earlier.frame_number} in the client of the {client}"
        )
        assert later.stamp_s > earlier.stamp_s - LATE_READ_S, (
            f"frame {later.frame_number} is stamped before frame {earlier.frame_number}"
        )


def _tracked(poses: list[MocapPose]) -> list[MocapPose]:
    return [pose for pose in poses if pose.tracking_valid]
