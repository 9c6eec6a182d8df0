"""The guardian process with real sockets, a flight process to kill, and peers for PX4 and motion capture."""

from __future__ import annotations

import math
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.guardian.flight_process import FlightProcess, HeartbeatReceiver
from companion.guardian.heartbeat import MAX_BYTES, PROBLEM, READY
from companion.guardian.process import main
from companion.launcher.guardian_process import outcome_of
from companion.model.frames import attitude_enu_flu_from_ned_frd, ned_from_enu, wrap_rad
from companion.model.launcher_messages import FlightEvent, GuardianEnded, TookOver
from companion.model.types import Outcome
from tests.guardian.rig import DISARMED, HOLD_MODE, LAND_MODE, OWN_IDS, POSITION_M, EchoLess, Rig
from tests.support import DEADLINE_S, wait_until

NAV_LAND, ARM_DISARM = mavlink.MAV_CMD_NAV_LAND, mavlink.MAV_CMD_COMPONENT_ARM_DISARM


def test_it_imports_no_more_than_it_needs() -> None:
    code = "import sys, companion.guardian.process; print(*sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=DEADLINE_S)
    tops = {name.partition(".")[0] for name in done.stdout.split()}
    assert not tops & {"numpy", "pydantic", "mavsdk", "asyncio", "yaml", "rich", "serial", "foxglove", "subprocess"}


def test_a_clean_end_of_the_flight_ends_it_quietly_and_ticks_that_it_did_not_hear_of_are_counted(
    tmp_path: Path,
) -> None:
    with Rig(tmp_path) as rig:
        rig.beat_until_ready()
        rig.tick += 3
        rig.beat()
        rig.beat(goodbye=True, lifting=False)
        assert rig.guardian.wait(DEADLINE_S) == 0
        assert rig.flight.poll() is None, "it was not its business to end it"
        assert (rig.events, rig.result) == ([], None)
        assert rig.log.read_text().startswith(f"heard {rig.tick - 3} heartbeats, 3 missed, silent for ")
        assert rig.peer.received == []


def test_the_end_of_the_flight_process_is_awaited_for_the_time_given() -> None:
    with subprocess.Popen(["sleep", "60"]) as process:
        flight, begin_s = FlightProcess(os.pidfd_open(process.pid)), time.monotonic()
        assert not flight.wait(0.05) and not flight.watch(0.05)
        assert time.monotonic() - begin_s >= 0.1
        flight.kill()
        assert flight.wait(DEADLINE_S) and flight.watch(DEADLINE_S)
        os.close(flight.pidfd)
    assert time.monotonic() - begin_s < DEADLINE_S


@pytest.mark.parametrize("ticks", [True, False])
def test_a_flight_process_that_dies_on_the_ground_needs_no_guardian(tmp_path: Path, ticks: bool) -> None:
    with Rig(tmp_path) as rig:
        if ticks:
            rig.beat_until_ready(lifting=False)
        rig.flight.kill()
        assert rig.guardian.wait(DEADLINE_S) == 0
        assert (rig.events, rig.result) == ([], None)
        assert rig.peer.received == []


def test_silence_on_the_ground_is_no_stall(tmp_path: Path) -> None:
    with Rig(tmp_path, timeout_s=0.05) as rig:
        rig.beat_until_ready(lifting=False)
        # "ready" comes every 0.1 s of the loop that also counts silence
        for _ in range(10):
            rig.beats.setblocking(True)
            rig.beats.recv(1024)
        rig.beats.setblocking(False)
        assert rig.flight.poll() is None
        rig.beat(lifting=False, goodbye=True)
        assert rig.guardian.wait(DEADLINE_S) == 0
        assert rig.events == []


def sound(events: list[str]) -> list[str]:
    """Leave out a gap of the rig's motion capture, whose thread may wait for a core, and what follows from it."""
    return [event for event in events if event not in ("guardian_mocap", "guardian_touchdown")]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_dead_or_hanging_in_the_air_it_takes_over_and_lands(tmp_path: Path, number: signal.Signals) -> None:
    with Rig(tmp_path) as rig:
        rig.beat_until_ready()
        os.kill(rig.flight.pid, number)
        rig.land()
        assert rig.guardian.wait(DEADLINE_S) == 0, rig.log.read_text()
        assert rig.flight.wait(DEADLINE_S) == -signal.SIGKILL
        assert sound(rig.events) == ["guardian_took_over", "guardian_land", "guardian_landed"]
        assert outcome_of(rig.result) is Outcome.ABORTED
        assert rig.log_ids == rig.events, "the recorder got the same"
        said = [message for message in rig.messages if isinstance(message, FlightEvent)]
        assert all(5.0 <= message.mission_t_s < 5.0 + message.t_s for message in said)
        assert rig.result == GuardianEnded(landed=True, overturned=False)
        sources = {(m.get_srcSystem(), m.get_srcComponent()) for m in rig.peer.received}
        assert sources == {OWN_IDS}
        beat = rig.peer.of("HEARTBEAT")[0]
        assert (beat.type, beat.autopilot) == (mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID)
        assert len(rig.peer.commands(ARM_DISARM)) >= 1
        assert {m.param1 for m in rig.peer.commands(ARM_DISARM)} == {0.0}


def test_a_flight_that_ends_with_px4_armed_is_taken_over_and_is_not_said_to_hang(tmp_path: Path) -> None:
    """Nor does a full disk under the guardian's log cost the landing."""
    with Rig(tmp_path, disk_full=True) as rig:
        rig.beat_until_ready()
        rig.beat(goodbye=True)
        rig.land()
        assert rig.guardian.wait(DEADLINE_S) == 0, rig.log.read_text()
        assert sound(rig.events) == ["guardian_took_over", "guardian_land", "guardian_landed"]
        assert TookOver(hangs=False) in rig.messages
        [first] = [m for m in rig.messages if isinstance(m, FlightEvent) and m.id == "guardian_took_over"]
        assert (
            first.text == "the flight process has ended its flight, and PX4 may be armed; the guardian has taken over"
        )


def test_poses_go_on_as_the_flight_sent_them(tmp_path: Path) -> None:
    """Frames, fields and time base are compared with the motion capture server's values, not with the converting code."""
    with Rig(tmp_path) as rig:
        rig.beat_until_ready()
        rig.flight.kill()
        rig.peer.wait_for("VISION_POSITION_ESTIMATE", 20)
        poses = rig.peer.of("VISION_POSITION_ESTIMATE")
        pose = poses[-1]
        assert (pose.x, pose.y, pose.z) == pytest.approx(ned_from_enu(POSITION_M), abs=1e-5)
        assert (pose.roll, pose.pitch) == pytest.approx((0.0, 0.0), abs=1e-6)
        assert wrap_rad(pose.yaw - (math.pi / 2 - 0.5)) == pytest.approx(0.0, abs=1e-6)
        assert math.isnan(pose.covariance[0])
        stamps_s = [p.usec * 1e-6 for p in poses]
        assert stamps_s == sorted(stamps_s)
        assert 10.0 < stamps_s[0] < 10.0 + DEADLINE_S, "on the flight clock, which was 10 s old"


def test_poses_that_are_late_from_the_takeover_on_are_not_sent(tmp_path: Path) -> None:
    """The server answers no echo request: only the poses before the takeover show its clock."""
    with Rig(tmp_path, server=EchoLess) as rig:
        rig.beat_until_ready()
        rig.cameras.held_s, held = 0.3, rig.cameras.frames + 2
        wait_until(lambda: rig.cameras.frames >= held, rig.log.read_text)
        rig.beat()
        rig.flight.kill()
        wait_until(lambda: "guardian_mocap" in rig.events, rig.log.read_text)
        assert not rig.peer.of("VISION_POSITION_ESTIMATE")
        rig.cameras.held_s = 0.0
        rig.peer.wait_for("VISION_POSITION_ESTIMATE", 20)


def test_land_is_commanded_until_px4_lands(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        rig.peer.acks[NAV_LAND] = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
        rig.beat_until_ready()
        rig.flight.kill()
        wait_until(lambda: len(rig.peer.commands(NAV_LAND)) >= 4, rig.log.read_text)
        wait_until(lambda: "guardian_refused" in rig.events, rig.log.read_text)
        rig.land()
        assert rig.guardian.wait(DEADLINE_S) == 0
        assert rig.events[-1] == "guardian_landed"


def test_without_any_heartbeat_it_lands_all_the_same(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        rig.beat_until_ready()
        rig.peer.beating = False
        rig.flight.kill()

        def commanded() -> bool:
            # One message of any kind tells where PX4 is; none tells its mode.
            rig.peer.say(mavlink.MAVLink_system_time_message(0, 0))
            return bool(rig.peer.commands(NAV_LAND))

        wait_until(commanded, rig.log.read_text)


@pytest.mark.parametrize("told_by", ["beat", "mode"])
def test_a_pilot_is_respected(tmp_path: Path, told_by: str) -> None:
    with Rig(tmp_path) as rig:
        rig.beat_until_ready(pilot=told_by == "beat")
        rig.peer.custom_mode = HOLD_MODE
        rig.flight.kill()
        wait_until(lambda: "guardian_pilot" in rig.events, rig.log.read_text)
        rig.peer.wait_for("VISION_POSITION_ESTIMATE", 50)
        rig.peer.base_mode &= ~mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        assert rig.guardian.wait(DEADLINE_S) == 0
        asked = {m.command for m in rig.peer.of("COMMAND_LONG")}
        assert asked <= {mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_REQUEST_MESSAGE}
        assert rig.peer.of("SET_ATTITUDE_TARGET") == []


def test_a_pilot_who_takes_over_from_the_guardian_is_respected(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        rig.beat_until_ready()
        rig.flight.kill()
        wait_until(lambda: bool(rig.peer.commands(NAV_LAND)), rig.log.read_text)
        rig.peer.custom_mode = 3 << 16  # position mode
        wait_until(lambda: "guardian_pilot" in rig.events, rig.log.read_text)
        before = len(rig.peer.commands(NAV_LAND))
        rig.peer.wait_for("VISION_POSITION_ESTIMATE", len(rig.peer.of("VISION_POSITION_ESTIMATE")) + 50)
        assert len(rig.peer.commands(NAV_LAND)) == before


def test_after_a_kill_the_guardian_sends_no_command_and_no_setpoint(tmp_path: Path) -> None:
    """The mode stays OFFBOARD; a LAND would start the rotors when the switch is released."""
    with Rig(tmp_path) as rig:
        rig.beat_until_ready()
        rig.peer.system_status = mavlink.MAV_STATE_FLIGHT_TERMINATION
        rig.flight.kill()
        wait_until(lambda: "guardian_pilot" in rig.events, rig.log.read_text)
        rig.peer.system_status = mavlink.MAV_STATE_ACTIVE
        rig.peer.wait_for("VISION_POSITION_ESTIMATE", 100)
        rig.peer.base_mode &= ~mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        assert rig.guardian.wait(DEADLINE_S) == 0
        assert rig.peer.commands(NAV_LAND) == rig.peer.commands(ARM_DISARM) == []
        assert rig.peer.of("SET_ATTITUDE_TARGET") == []
        assert "kill switch" in rig.log.read_text()


def test_a_hold_by_px4s_own_failsafe_is_no_pilot_and_is_landed(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        rig.beat_until_ready()
        rig.peer.custom_mode, rig.peer.system_status = HOLD_MODE, mavlink.MAV_STATE_CRITICAL
        rig.flight.kill()
        rig.land()
        assert rig.guardian.wait(DEADLINE_S) == 0, rig.log.read_text()
        assert "guardian_pilot" not in rig.events


def test_in_the_air_it_never_disarms_on_the_land_detectors_word_alone(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        rig.beat_until_ready()
        rig.flight.kill()
        wait_until(lambda: bool(rig.peer.commands(NAV_LAND)), rig.log.read_text)
        rig.peer.custom_mode, rig.peer.landed = LAND_MODE, mavlink.MAV_LANDED_STATE_ON_GROUND
        rig.peer.wait_for("VISION_POSITION_ESTIMATE", len(rig.peer.of("VISION_POSITION_ESTIMATE")) + 250)
        assert rig.peer.commands(ARM_DISARM) == []


@pytest.mark.parametrize("contradicted", [False, True])
def test_a_flipped_vehicle_is_disarmed_by_force_again_and_again(tmp_path: Path, contradicted: bool) -> None:
    """A rejected command is repeated; an attitude that motion capture contradicts stops no rotor."""
    with Rig(tmp_path) as rig:
        rig.peer.acks[ARM_DISARM] = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
        rig.beat_until_ready()
        rig.peer.custom_mode = LAND_MODE
        if not contradicted:
            rig.peer.attitude_ned_frd = (0.0, 1.0, 0.0, 0.0)
            rig.cameras.attitude = attitude_enu_flu_from_ned_frd(rig.peer.attitude_ned_frd)
        rig.flight.kill()
        if contradicted:
            rig.peer.wait_for("VISION_POSITION_ESTIMATE", 5)
            rig.peer.attitude_ned_frd = (0.0, 1.0, 0.0, 0.0)
            rig.peer.wait_for("VISION_POSITION_ESTIMATE", 150)
            assert rig.peer.commands(ARM_DISARM) == []
            return
        wait_until(lambda: len(rig.peer.commands(ARM_DISARM)) > 3, rig.log.read_text)
        assert {(m.param1, m.param2) for m in rig.peer.commands(ARM_DISARM)} == {(0.0, 21196.0)}
        rig.peer.base_mode = DISARMED
        assert rig.guardian.wait(DEADLINE_S) == 0, rig.log.read_text()
        assert "guardian_landing" in rig.events
        assert rig.result is not None and outcome_of(rig.result) is Outcome.CRASHED


def test_a_jump_of_motion_capture_is_held_back(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        rig.beat_until_ready()
        rig.flight.kill()
        rig.peer.wait_for("VISION_POSITION_ESTIMATE", 5)
        x, y, z = POSITION_M
        rig.cameras.position_m = (x + 50.0, y, z)
        wait_until(lambda: "guardian_mocap" in rig.events, rig.log.read_text)
        assert max(abs(pose.y - x) for pose in rig.peer.of("VISION_POSITION_ESTIMATE")) < 1e-3


def test_it_is_not_ready_without_a_body_of_its_own(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        rig.cameras.tracked = False
        said: list[bytes] = []

        def blind() -> bool:
            try:
                said.append(rig.beats.recv(1024))
            except BlockingIOError:
                return False
            return b"does not track rigid body" in said[-1]

        wait_until(blind, lambda: f"{said} {rig.log.read_text()}")


def test_in_the_air_it_is_no_worse_than_a_flight_process_that_sees_nothing_either(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        rig.beat_until_ready()
        rig.cameras.tracked = False

        def until(kind: bytes, *, lifting: bool, pose_age_s: float) -> None:
            heard: list[bytes] = []

            def said() -> bool:
                rig.beat(lifting=lifting, pose_age_s=pose_age_s)
                try:
                    heard.append(rig.beats.recv(1024))
                except BlockingIOError:
                    return False
                return heard[-1][:1] == kind

            wait_until(said, lambda: f"{kind!r} was never said: {heard[-3:]} {rig.log.read_text()}")

        until(PROBLEM, lifting=True, pose_age_s=0.0)
        until(READY, lifting=True, pose_age_s=1.0)
        until(PROBLEM, lifting=False, pose_age_s=1.0)


_BUGS = """
import sys

if "companion.guardian" in sys.orig_argv:
    import companion.guardian.process as process
    import companion.guardian.takeover_landing as takeover_landing

    class Breaking({module}.{broken}):
        def {method}(self, *arguments):
            Breaking.calls += 1
            if {when}:
                raise ZeroDivisionError("a bug")
            return super().{method}(*arguments)

    Breaking.calls = 0
    {module}.{broken} = Breaking
"""


@pytest.mark.parametrize(
    ("module", "broken", "method", "when", "where"),
    [
        ("takeover_landing", "AutopilotLanding", "step", "Breaking.calls == 5", "the landing"),
        ("takeover_landing", "AutopilotLanding", "step", "True", "the landing"),
        ("takeover_landing", "Px4State", "take", "arguments[1].get_type() != 'HEARTBEAT'", "PX4's messages"),
        ("process", "PoseFilter", "check", "Breaking.calls < 50", "motion capture"),
    ],
    ids=["once", "always", "messages", "poses"],
)
def test_an_error_of_its_own_is_reported_and_the_landing_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, broken: str, method: str, when: str, where: str
) -> None:
    hooks = tmp_path / "hooks"
    hooks.mkdir()
    (hooks / "sitecustomize.py").write_text(
        _BUGS.format(module=module, broken=broken, method=method, when=when), encoding="utf-8"
    )
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (str(hooks), os.environ.get("PYTHONPATH")))))
    with Rig(tmp_path) as rig:
        rig.beat_until_ready()
        os.kill(rig.flight.pid, signal.SIGKILL)
        wait_until(lambda: bool(rig.peer.commands(NAV_LAND)), rig.log.read_text)
        wait_until(lambda: "guardian_error" in rig.events, rig.log.read_text)
        rig.peer.wait_for("VISION_POSITION_ESTIMATE", 20)
        rig.peer.custom_mode = LAND_MODE
        rig.peer.base_mode = DISARMED
        assert rig.guardian.wait(DEADLINE_S) == 0, rig.log.read_text()
        assert rig.result == GuardianEnded(landed=True, overturned=False)
        errors = [m.text for m in rig.messages if isinstance(m, FlightEvent) and m.id == "guardian_error"]
        assert len(errors) == 1, "told once"
        assert errors[0] == f"an error in {where} (ZeroDivisionError: a bug); the landing continues"
        assert "Traceback" in rig.log.read_text()


@pytest.mark.parametrize("missing", ["--config", "--heartbeats", "--channel", "--pidfd"])
def test_without_one_of_its_arguments_it_does_not_start(missing: str, capsys: pytest.CaptureFixture[str]) -> None:
    given = [
        word for name in ("--config", "--heartbeats", "--channel", "--pidfd") if name != missing for word in (name, "0")
    ]
    with pytest.raises(SystemExit) as ended:
        main(given)
    assert ended.value.code == 2 and missing in capsys.readouterr().err


def test_a_long_problem_is_cut_to_one_datagram() -> None:
    flight, ours = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with flight, ours:
        HeartbeatReceiver(ours).send_status("x" * 2000)
        assert flight.recv(4096) == PROBLEM + b"x" * (MAX_BYTES - 1)
