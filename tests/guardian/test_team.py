"""What a guardian announces to the other vehicle of a team, over a real socket."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from companion.io.team_link import TeamLink, TeamSettings
from companion.model.team import Grip
from companion.runtime.clock import flight_clock
from tests.guardian.rig import POSITION_M, Rig
from tests.support import DEADLINE_S, free_udp_port, wait_until

LOOPBACK = "127.0.0.1"


def team(key_file: Path) -> tuple[TeamSettings, TeamSettings]:
    """Return the settings of the guardian's vehicle and of the other."""
    own, other = free_udp_port(), free_udp_port()
    return TeamSettings(own, LOOPBACK, other, str(key_file)), TeamSettings(other, LOOPBACK, own, str(key_file))


async def test_after_the_takeover_it_announces_that_px4_lands_and_that_it_holds_nothing(tmp_path: Path) -> None:
    key_file = tmp_path / "team.key"
    key_file.write_bytes(bytes(32))
    own, other = team(key_file)
    async with TeamLink(other, flight_clock()) as link:
        with Rig(tmp_path, team=own) as rig:
            rig.partner_session = link._sender.session
            rig.beat_until_ready()
            assert link.newest() is None and sum(link.counts()) == 0
            os.kill(rig.flight.pid, signal.SIGKILL)
            wait_until(lambda: link.newest() is not None and link.counts().received > 3, rig.log.read_text)
            newest = link.newest()
            assert newest is not None
            said = newest.said
            assert (said.grip, said.holds, said.lands, said.px4_lands) == (Grip.FREE, True, True, True)
            assert max(abs(a - b) for a, b in zip(said.position_world_m, POSITION_M, strict=True)) < 0.01
            rig.land()
            assert rig.guardian.wait(DEADLINE_S) == 0, rig.log.read_text()


async def test_without_the_key_it_is_not_ready(tmp_path: Path) -> None:
    own, _ = team(tmp_path / "missing.key")
    with Rig(tmp_path, team=own) as rig:
        told = b""

        def problem() -> bool:
            nonlocal told
            rig.beat(lifting=False)
            try:
                told = rig.beats.recv(1024)
            except BlockingIOError:
                return False
            return True

        wait_until(problem, rig.log.read_text)
        assert b"devices.team.key_file: " in told and b"No such file or directory" in told
