"""The independent client `natnet` of PyPI reads the simulated NatNet server."""

from __future__ import annotations

import asyncio
import math
import time
from typing import Any

import pytest
from natnet import NatNetClient

from sitl.natnet import BodyPose, NatNetServer

GROUP = "239.255.42.99"
POSES = (
    BodyPose(1, (-1.25, 0.5, 1.0), (math.cos(0.3), 0.0, 0.0, math.sin(0.3)), error_m=0.00025),
    BodyPose(2, (3.0, 2.0, 0.5), (0.5, 0.5, 0.5, 0.5), valid=False),
)


def read_one(server: NatNetServer, multicast: bool, deadline_s: float = 20.0) -> tuple[Any, Any, Any]:
    """Return server info, first frame and model definitions as that client decodes them."""
    frames: list[Any] = []
    models: list[Any] = []
    client = NatNetClient(
        server_ip_address="127.0.0.1",
        local_ip_address="127.0.0.1",
        multicast_address=GROUP,
        command_port=server.command_port,
        data_port=server.data_port,
        use_multicast=multicast,
    )
    client.on_data_frame_received_event.handlers.append(frames.append)
    client.on_data_description_received_event.handlers.append(models.append)
    with client:
        info = client.server_info
        client.request_modeldef()
        end_s = time.monotonic() + deadline_s
        while not (frames and models):
            assert time.monotonic() < end_s, f"{len(frames)} frames and {len(models)} model definitions came"
            client.update_sync()
            time.sleep(0.01)
    return info, frames[0], models[0]


@pytest.mark.parametrize(("version", "multicast"), [("3.0", False), ("3.1", True), ("4.1", False), ("4.4", True)])
async def test_peer_reads_the_right_poses(version: str, multicast: bool) -> None:
    async def publish(server: NatNetServer) -> None:
        t_s = 0.0
        while True:
            t_s += 0.005
            server.publish(t_s, POSES, t_s - 0.004)
            await asyncio.sleep(0.005)

    group = GROUP if multicast else None
    async with NatNetServer(version, multicast_group=group, bodies=[(1, "quad"), (2, "ball")]) as server:
        publisher = asyncio.create_task(publish(server))
        try:
            info, frame, models = await asyncio.to_thread(read_one, server, multicast)
        finally:
            publisher.cancel()
            await asyncio.gather(publisher, return_exceptions=True)
    assert info.application_name == "Motive"
    assert str(info.nat_net_protocol_version.truncate(2)) == version
    assert [(body.id_num, body.tracking_valid) for body in frame.rigid_bodies] == [(1, True), (2, False)]
    for body, pose in zip(frame.rigid_bodies, POSES, strict=True):
        w, x, y, z = pose.quat_wxyz
        assert body.pos == pytest.approx(pose.position_m)
        assert body.rot == pytest.approx((x, y, z, w))
        assert body.marker_error == pytest.approx(pose.error_m)
    assert [marker_set.model_name for marker_set in frame.marker_sets] == ["quad", "ball", "all"]
    assert len(frame.unlabeled_marker_pos) == 1
    assert [marker.model_id for marker in frame.labeled_markers[:8]] == [1] * 4 + [2] * 4
    suffix = frame.suffix
    assert suffix.stamp_transmit - suffix.stamp_camera_mid_exposure == 40_000
    assert [(body.id_num, body.name) for body in models.rigid_bodies] == [(1, "quad"), (2, "ball")]
