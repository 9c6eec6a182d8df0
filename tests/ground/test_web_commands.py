"""Commands through the page: signed, verified by the vehicle, repeated until they are answered."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import aiomqtt
import pytest

from companion.config.document import ConfigError
from companion.ground.protocol.access import broker_access
from companion.ground.protocol.keys import Operator, operators_text, write_private
from companion.ground.protocol.messages import Presence, Topic
from companion.ground.protocol.proof import Signer, with_proof
from companion.ground.station.command_sender import ATTEMPTS, NO_ANSWER, signer_of
from companion.ground.station.vehicles import LIVE_S
from companion.model.commands import COMMANDS
from companion.model.types import OperatorCommand
from tests.broker import Broker, loopback_broker
from tests.ground.monitor_rig import ANNA, OPERATORS, SIGNER, monitor_at, on_page, token_of, until, viewer_of
from tests.ground.vehicle import PlayedVehicle, ack_of, played_vehicle


def with_data(**values: Any) -> Callable[[dict[str, Any]], bool]:
    """Whether the data of a message have these values."""
    return lambda message: values.items() <= message["data"].items()


async def test_each_command_is_signed_judged_by_the_vehicle_and_its_answer_shown(broker: Broker) -> None:
    async with (
        played_vehicle(broker.port, OPERATORS) as vehicle,
        monitor_at(broker.url) as monitor,
        viewer_of(monitor) as viewer,
        viewer_of(monitor) as other,
    ):
        vehicle.accepts = lambda heard: (
            heard.command is not OperatorCommand.RESUME,
            f"answer to {heard.command.value}",
        )
        await viewer.until("stream")
        for command in COMMANDS.values():
            await viewer.order(command.value)
            ack = await viewer.until("ack", with_data(command=command.value))
            # A late answer may be to the second of two attempts.
            nonce = ack["data"]["nonce"]
            (sent,) = [one for one in viewer.heard if one["kind"] == "sent" and one["nonce"] == nonce]
            (heard,) = [one for one in vehicle.accepted if one.nonce == nonce]
            assert (sent["vehicle"], sent["command"]) == ("rig", command.value)
            assert ack["data"]["text"] == f"answer to {command.value}"
            assert ack["data"]["accepted"] == (command is not OperatorCommand.RESUME)
            assert heard.command is command and heard.operator == "anna"
            await other.until("ack", with_data(**ack["data"]))
        assert not [message for message in other.heard if message["kind"] == "sent"]


@pytest.mark.parametrize("command", ["hold", "start"])
async def test_a_missing_answer_is_reported_and_only_hold_land_and_abort_are_sent_again(
    broker: Broker, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.ground.station.command_sender.ANSWER_S", 0.5)
    tries = ATTEMPTS if command == "hold" else 1
    async with on_page(broker) as (vehicle, _monitor, viewer):
        vehicle.answers = False
        await viewer.until("stream")
        await viewer.order(command)
        texts = [(await viewer.until("refused"))["text"] for _ in range(tries)]
        again = [f"{NO_ANSWER} (sent again, {number} of {tries})" for number in range(2, tries + 1)]
        assert texts == [*again, NO_ANSWER]
        nonces = [message["nonce"] for message in viewer.heard if message["kind"] == "sent"]
        assert len(set(nonces)) == tries
        assert [heard.nonce for heard in vehicle.accepted] == nonces


async def test_a_late_answer_ends_the_tries(broker: Broker) -> None:
    async with on_page(broker) as (vehicle, _monitor, viewer):
        vehicle.answers = False
        await viewer.until("stream")
        await viewer.order("land")
        await viewer.until("refused")
        vehicle.answers = True
        ack = await viewer.until("ack")
        assert ack["data"]["nonce"] == vehicle.accepted[-1].nonce
        await viewer.order("hold")
        await viewer.until("ack", lambda message: message["data"]["command"] == "hold")
        assert sum(heard.command is OperatorCommand.LAND for heard in vehicle.accepted) <= 2


async def test_a_newer_command_ends_the_tries_of_an_older_one(broker: Broker) -> None:
    """A HOLD that is repeated after a RESUME would hold again."""

    async with on_page(broker) as (vehicle, _monitor, viewer):
        vehicle.answers = False
        await viewer.until("stream")
        await viewer.order("hold")
        await viewer.until("sent")
        await viewer.order("resume")
        await viewer.until("refused", lambda message: message["command"] == "resume")
        held = [message for message in viewer.heard if message["kind"] == "refused" and message["command"] == "hold"]
        assert [message["text"] for message in held] == [NO_ANSWER]
        assert [heard.command.value for heard in vehicle.accepted] == ["hold", "resume"]


@pytest.mark.parametrize("answered", [True, False])
async def test_the_monitor_goes_on_when_a_newer_command_is_answered_first(
    broker: Broker, answered: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As by a vehicle that hears HOLD and LAND in one tick: it answers the gravest first."""
    monkeypatch.setattr("companion.ground.station.command_sender.ANSWER_S", 2.0)
    async with on_page(broker) as (vehicle, _monitor, viewer):
        vehicle.answers = False
        await viewer.until("stream")
        await viewer.order("hold")
        held = await viewer.until("sent")
        await until(lambda: bool(vehicle.accepted))
        vehicle.answers = True
        await viewer.order("land")
        await viewer.until("ack", with_data(command="land"))
        if answered:
            values = {"operator": ANNA.name, "command": OperatorCommand.HOLD, "text": "holding"}
            await vehicle.say(Topic.ACK, with_proof(ack_of(vehicle.session, held["nonce"], **values), "rig", ANNA.key))
            await viewer.until("ack", with_data(command="hold"))
        else:
            await viewer.until("refused", lambda message: message["command"] == "hold")
        await viewer.order("abort")
        await viewer.until("ack", with_data(command="abort"))


async def test_commands_that_cannot_be_given_are_refused_with_the_reason(broker: Broker) -> None:
    async with on_page(broker, quiet=True) as (vehicle, _monitor, viewer):

        async def why_not(name: str) -> str:
            await viewer.order("hold", name)
            return str((await viewer.until("refused"))["text"])

        await viewer.until("broker", lambda message: message["connected"])
        assert "no vehicle 'other' is known" in await why_not("other")
        assert "a command cannot be dated" in await why_not("rig")
        await vehicle.say_stream()
        await viewer.until("stream")
        await asyncio.sleep(
            LIVE_S
        )  # as long as proven messages come in, a state that nobody has proven is not believed
        await vehicle.say_state(commands=False, text="the broker is another computer")
        await viewer.until("state", lambda message: not message["data"]["commands"])
        assert "accepts no commands: the broker is another computer" in await why_not("rig")
        await vehicle.say_state(presence=Presence.ENDED, outcome="completed")
        await viewer.until("state", lambda message: message["data"]["presence"] == "ended")
        assert "has ended" in await why_not("rig")
        assert vehicle.commands_heard == 0


async def test_a_viewer_without_the_token_receives_everything_and_cannot_command(broker: Broker) -> None:
    async with played_vehicle(broker.port, OPERATORS) as vehicle, monitor_at(broker.url) as monitor:
        for token in ("", "x", token_of(monitor)[:-1], token_of(monitor).swapcase()):
            async with viewer_of(monitor, token) as viewer:
                hello = await viewer.next()
                assert hello["can_command"] is False and "#" in hello["why_not"]
                await viewer.until("stream")
                await viewer.order("land")
                assert (await viewer.until("refused"))["text"] == hello["why_not"]
        async with viewer_of(monitor, "") as viewer:
            await viewer.ws.send_json({"kind": "token", "token": token_of(monitor)})
            await viewer.until("hello", lambda message: message["can_command"])
            await viewer.order("hold")
            await viewer.until("ack")
        assert [command.command.value for command in vehicle.accepted] == ["hold"]


async def test_a_command_that_the_broker_does_not_let_pass_is_reported_as_that(tmp_path: Path) -> None:
    with loopback_broker(tmp_path) as broker:
        broker.stop()
        (tmp_path / "acl").write_text("topic read companion/#\nuser vehicle\ntopic readwrite companion/#\n")
        config = tmp_path / "loopback.conf"
        config.write_text(
            config.read_text() + f"user root\nacl_file {tmp_path / 'acl'}\n"
        )  # root alone sees this folder
        broker.start()

        async with (
            aiomqtt.Client("127.0.0.1", broker.port, username="vehicle") as client,
            monitor_at(broker.url) as monitor,
            viewer_of(monitor) as viewer,
        ):
            await viewer.until("broker", lambda message: message["connected"])
            vehicle = PlayedVehicle(client, "rig", "s", OPERATORS)
            await vehicle.say_all()
            await vehicle.say_stream()
            await viewer.until("stream")
            await viewer.order("start")
            refused = await viewer.until("refused")
            assert refused["text"].startswith("the broker refused the command: Not authorized")


def test_the_signer_of_a_monitor(broker: Broker, tmp_path: Path) -> None:
    here = broker_access(broker.url, None, None)
    remote = broker_access("mqtt://192.0.2.1", None, None)
    file = tmp_path / "operators.yaml"
    write_private(file, operators_text([ANNA, Operator("bob", b"b" * 32)]).encode())
    assert "is not encrypted" in str(signer_of(remote, str(file), "anna"))
    assert "--view-only" in str(signer_of(here, str(file), "anna", view_only=True))
    assert "several operators (anna, bob); choose one" in str(signer_of(here, str(file), None))
    assert signer_of(here, str(file), "anna") == SIGNER
    with pytest.raises(ConfigError, match="no operator 'eve'"):
        signer_of(here, str(file), "eve")


def test_a_key_is_made_for_this_computer_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A vehicle on another computer would not know it."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    why_not = signer_of(broker_access("mqtts://192.0.2.1", None, None), None, None)
    assert "give a file: --operators" in str(why_not)
    assert not list(tmp_path.iterdir())
    signer = signer_of(broker_access("mqtt://127.0.0.1", None, None), None, None)
    assert isinstance(signer, Signer) and list(tmp_path.rglob("operators.yaml"))


async def test_a_view_only_monitor_sends_no_commands(broker: Broker) -> None:
    async with on_page(broker, "nobody shall", "") as (vehicle, monitor, viewer):
        assert "#" not in monitor.url
        hello = await viewer.next()
        assert (hello["can_command"], hello["operator"], hello["why_not"]) == (False, None, "nobody shall")
        await viewer.until("stream")
        await viewer.order("hold")
        assert (await viewer.until("refused"))["text"] == "nobody shall"
        assert vehicle.commands_heard == 0
