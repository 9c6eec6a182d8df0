"""`companion command` with a real broker and a vehicle that verifies commands."""

from __future__ import annotations

import asyncio
from pathlib import Path

import aiomqtt
import pytest

from companion.cli import command as command_command
from companion.ground.protocol.keys import Operator, load_operators, operators_text, write_private
from companion.ground.protocol.messages import Presence, Topic
from companion.ground.station.command_sender import ATTEMPTS
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_LOST, EXIT_OK, EXIT_REFUSED
from tests.broker import Broker
from tests.commands import refused
from tests.ground.monitor_rig import ANNA, OPERATORS
from tests.ground.vehicle import played_vehicle
from tests.support import Ended, free_port, run_here, sandbox_in


@pytest.fixture
def keys(tmp_path: Path) -> str:
    """An operators file with one operator, anna."""
    file = tmp_path / "operators.yaml"
    write_private(file, operators_text([ANNA]).encode())
    return str(file)


async def command(name: str, broker: Broker | str, keys: str, *more: str) -> Ended:
    url = broker if isinstance(broker, str) else broker.url
    ended = await asyncio.to_thread(run_here, "command", name, "--broker", url, "--operators", keys, *more)
    assert "Traceback" not in ended.err
    return ended


async def test_the_answer_of_the_vehicle_is_printed(broker: Broker, keys: str) -> None:
    async with played_vehicle(broker.port, OPERATORS) as vehicle:
        for name in ("hold", "resume", "land", "abort", "start"):
            ended = await command(name, broker, keys)
            assert (ended.code, ended.out, ended.err) == (EXIT_OK, f"rig: {name}: {name}: done\n", "")
        assert [heard.command.value for heard in vehicle.accepted] == ["hold", "resume", "land", "abort", "start"]


async def test_a_refusal_is_reported_with_its_reason(broker: Broker, keys: str) -> None:
    async with played_vehicle(broker.port, OPERATORS) as vehicle:
        vehicle.accepts = lambda heard: (False, "start refused: PX4 is not ready")
        ended = await command("start", broker, keys)
        assert ended.code == EXIT_REFUSED
        assert ended.err_lines == ["companion command: rig: start refused: PX4 is not ready"]
        vehicle.streams = False
        await vehicle.say_state(presence=Presence.ENDED, outcome="completed")
        ended = await command("land", broker, keys, "--vehicle", "rig")
        assert (ended.code, ended.err_lines) == (
            EXIT_REFUSED,
            ["companion command: rig: land: the flight of rig has ended"],
        )


async def test_an_unknown_operator_is_informed_that_the_vehicle_does_not_have_the_key(
    broker: Broker, tmp_path: Path
) -> None:
    """With another key under the same name no message is proven, so no command can be dated."""
    keys = tmp_path / "stranger.yaml"
    write_private(keys, operators_text([Operator("anna", b"x" * 32)]).encode())

    async with played_vehicle(broker.port, OPERATORS) as vehicle:
        ended = await command("start", broker, str(keys))
        assert ended.code == EXIT_REFUSED
        assert (
            "start: no message from rig could be verified with anna's key: the vehicle does not have that key"
            in ended.err
        )
        assert not vehicle.commands_heard


async def test_a_missing_answer_is_reported_after_each_attempt(broker: Broker, keys: str) -> None:
    async with played_vehicle(broker.port, OPERATORS) as vehicle:
        vehicle.answers = False
        ended = await command("land", broker, keys)
        assert ended.code == EXIT_LOST and ended.out == ""
        assert len(ended.err_lines) == ATTEMPTS == len(vehicle.accepted)
        assert all("no answer from the vehicle within 1.5 s" in line for line in ended.err_lines)


async def test_no_broker_and_no_vehicle_are_reported_in_one_line(
    broker: Broker, keys: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command_command, "FOUND_S", 1.0)

    nowhere = f"mqtt://127.0.0.1:{free_port()}"
    ended = await command("land", nowhere, keys)
    assert ended.code == EXIT_LOST and len(ended.err_lines) == 1
    assert ended.err.startswith(f"companion command: no broker at {nowhere}")
    ended = await command("land", broker, keys)
    assert ended.code == EXIT_LOST
    assert ended.err.startswith("companion command: no message from a vehicle at the broker within")
    async with played_vehicle(broker.port, OPERATORS):
        ended = await command("land", broker, keys, "--vehicle", "rug")
    assert ended.code == EXIT_LOST
    assert "no message from 'rug'" in ended.err and "known: rig (flying)" in ended.err


async def test_several_vehicles_have_to_be_distinguished(broker: Broker, keys: str) -> None:
    async with (
        played_vehicle(broker.port, OPERATORS, "one") as one,
        played_vehicle(broker.port, OPERATORS, "two") as two,
    ):
        ended = await command("land", broker, keys)
        assert ended.code == EXIT_BAD_INPUT
        assert ended.err_lines == [
            "companion command: there are several vehicles (one, two); choose one: --vehicle NAME"
        ]
        ended = await command("land", broker, keys, "--vehicle", "two")
        assert (ended.code, ended.out) == (EXIT_OK, "two: land: land: done\n")
        assert (len(one.accepted), len(two.accepted)) == (0, 1)


async def test_a_retained_state_prevents_resume_and_start_but_not_hold_land_and_abort(
    broker: Broker, keys: str
) -> None:
    """All retained messages are known before a command is sent, however many there are. A retained state may be forged: a command that
    makes the flight safer goes to the one vehicle with a proven stream, and the other is named.
    """
    async with played_vehicle(broker.port, OPERATORS, "rig") as vehicle:
        await leave_states(broker)
        for name in ("resume", "start"):
            ended = await command(name, broker, keys)
            assert ended.code == EXIT_BAD_INPUT and "(quiet-49, rig)" in ended.err
        assert not vehicle.accepted
        for name in ("hold", "land", "abort"):
            ended = await command(name, broker, keys)
            assert (ended.code, ended.out) == (EXIT_OK, f"rig: {name}: {name}: done\n")
            assert ended.err_lines == [
                "companion command: sent to rig; no authenticated messages from: quiet-49; to command another: --vehicle NAME"
            ]
        assert [heard.command.value for heard in vehicle.accepted] == ["hold", "land", "abort"]


async def leave_states(broker: Broker) -> None:
    """Publish fifty retained states of vehicles that send nothing else; ``quiet-49`` claims to fly."""
    async with aiomqtt.Client("127.0.0.1", broker.port) as client:
        for number in range(50):
            name = f"quiet-{number:02}"
            state = b'{"v":2,"vehicle":"%s","session":"s","presence":"%s","simulated":true,"mission":"m","law":"l",' \
                b'"preset":"p","wall_s":0.0,"commands":true}'  # fmt: skip
            presence = b"flying" if number == 49 else b"ended"
            await client.publish(Topic.STATE.of(name), state % (name.encode(), presence), qos=1, retain=True)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["jump"], "invalid choice: 'jump'"),
        (["hold", "--vehicle", "a/b"], "--vehicle 'a/b': expected a vehicle name"),
        (["hold", "--operators", "nofile.yaml"], "nofile.yaml: no such file"),
        (["hold", "--broker", "mqtt://192.0.2.1"], "is not encrypted"),
    ],
)
def test_bad_input(arguments: list[str], why: str) -> None:
    assert why in refused(EXIT_BAD_INPUT, "command", *arguments)


async def test_vehicle_and_ground_station_of_one_user_need_no_setting_up(broker: Broker, tmp_path: Path) -> None:
    """The real command, with a key file that the vehicle's side has created."""
    home = {"XDG_CONFIG_HOME": str(tmp_path / "config")}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(*next(iter(home.items())))
        operators = load_operators(None)
    async with played_vehicle(broker.port, operators):
        with sandbox_in(tmp_path, home) as sandbox:
            ended = await asyncio.to_thread(sandbox.run, "command", "hold", "--broker", broker.url)
            sandbox.assert_nobody_left()
    assert (ended.code, ended.out, ended.err) == (EXIT_OK, "rig: hold: hold: done\n", "")
