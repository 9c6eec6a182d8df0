"""Every wire survives some thousand damaged inputs, and every input on which it once failed. `make explore` feeds many more."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzz.channels import ChannelsTarget
from tests.fuzz.config import YamlTarget
from tests.fuzz.dynamixel import DynamixelTarget
from tests.fuzz.force import ForceTarget
from tests.fuzz.mavlink import MavlinkTarget, MavlinkWireTarget
from tests.fuzz.natnet import NatNetTarget
from tests.fuzz.target import Target, feed_watched

TARGETS: dict[str, type[Target]] = {
    target.name: target
    for target in (
        *(NatNetTarget, DynamixelTarget, ForceTarget, MavlinkTarget, MavlinkWireTarget, ChannelsTarget, YamlTarget),
    )
}
REGRESSIONS = Path(__file__).parents[1] / "regressions" / "fuzz"
FOUND = sorted(REGRESSIONS.glob("*.bin"))
"""Inputs on which a wire once failed, as TARGET-PLACE-DAMAGE.bin."""


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """Silence the drivers, which log every rejected input."""
    logger = logging.getLogger("companion")
    before = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    yield
    logger.setLevel(before)


@pytest.mark.hypothesis
@pytest.mark.parametrize("name", TARGETS)
def test_damaged_input_is_borne(name: str) -> None:
    with TARGETS[name]() as target:

        @given(seed=st.integers(0, 2**32 - 1))
        def feed(seed: int) -> None:
            rng = Random(seed)
            for _ in range(target.inputs):
                data = target.make(rng)
                found = feed_watched(target, data)
                assert found is None, f"{found}; keep the input as {REGRESSIONS}/{name}-PLACE-DAMAGE.bin: {data!r}"

        files = len(os.listdir("/proc/self/fd"))
        feed()
        assert len(os.listdir("/proc/self/fd")) <= files, "open files pile up"


@pytest.mark.parametrize("name", TARGETS)
def test_the_same_seed_makes_the_same_inputs(name: str) -> None:
    one, other, third = Random(3), Random(3), Random(4)
    inputs = [TARGETS[name]().make(one) for _ in range(3)]
    assert [TARGETS[name]().make(other) for _ in range(3)] == inputs
    assert [TARGETS[name]().make(third) for _ in range(3)] != inputs


@pytest.mark.parametrize("stem", [path.stem for path in FOUND])
def test_what_was_found_once_is_borne(stem: str) -> None:
    with TARGETS[stem.rsplit("-", 2)[0]]() as target:
        assert feed_watched(target, (REGRESSIONS / f"{stem}.bin").read_bytes()) is None
