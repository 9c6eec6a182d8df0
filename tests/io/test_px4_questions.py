"""Questions to PX4 over real UDP: repeated until they are answered, with the patience of the event loop's clock."""

from __future__ import annotations

import asyncio
import time

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.io.protocols import DeviceError
from companion.io.px4 import questions
from tests.io.test_px4 import linked
from tests.support import eventually

ASK_ORIGIN = mavlink.MAV_CMD_REQUEST_MESSAGE


async def test_a_question_is_repeated_until_it_is_answered() -> None:
    async with linked() as (peer, autopilot):
        peer.acks[ASK_ORIGIN] = None
        before = len(peer.commands(ASK_ORIGIN))
        asking = asyncio.create_task(autopilot.ensure_origin())
        await eventually(lambda: len(peer.commands(ASK_ORIGIN)) >= before + 2, "the question, twice")
        peer.acks[ASK_ORIGIN] = mavlink.MAV_RESULT_ACCEPTED
        assert await asking


async def test_a_question_that_px4_never_answers_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(questions, "ASKS", 2)

    async with linked() as (peer, autopilot):
        peer.acks[ASK_ORIGIN] = None
        with pytest.raises(DeviceError, match=r"global origin, found no answer within 1 s; check the link$"):
            await autopilot.ensure_origin()


class _SlowLoop(asyncio.SelectorEventLoop):
    """Its clock runs at a fiftieth of the computer's, as simulated time does on a computer that is very busy."""

    def time(self) -> float:
        return time.monotonic() / 50.0


def test_on_a_slow_clock_a_late_answer_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(questions, "ASKS", 1)

    async def fly() -> None:
        async with linked() as (peer, autopilot):
            peer.acks[ASK_ORIGIN] = None
            before = len(peer.commands(ASK_ORIGIN))
            asking = asyncio.create_task(autopilot.ensure_origin())
            await eventually(lambda: len(peer.commands(ASK_ORIGIN)) > before, "the question")
            await asyncio.to_thread(time.sleep, 2 * questions.REPEAT_S)
            peer.say(mavlink.MAVLink_command_ack_message(ASK_ORIGIN, mavlink.MAV_RESULT_ACCEPTED))
            assert await asking

    with asyncio.Runner(loop_factory=_SlowLoop) as runner:
        runner.run(fly())
