"""`companion fly --wait-for-start` without a way to send START: exit 2, one line, nothing is started."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from companion.config.loader import load_flight
from companion.model.exit_codes import EXIT_BAD_INPUT
from tests.support import HOVER, run_here, sandbox_in, set_options


@pytest.mark.parametrize(
    ("mqtt", "why"),
    [
        ({"vehicle.ground.mqtt": None}, r"vehicle\.ground\.mqtt is null$"),
        ({"vehicle.ground.mqtt.commands": False}, r"vehicle\.ground\.mqtt\.commands is false$"),
        ({"vehicle.ground.mqtt.url": "mqtt://192.0.2.7:1883"}, r"mqtt://192\.0\.2\.7:1883, .* unencrypted connection"),
    ],
    ids=["no broker", "no commands", "plain and remote"],
)
@pytest.mark.parametrize("by_key", [False, True], ids=["by the option", "by the key"])
def test_a_flight_that_would_wait_for_ever_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mqtt: dict[str, object], why: str, by_key: bool
) -> None:
    key = set_options(**{"mission.start.takeoff": "by_operator"}) if by_key else ["--wait-for-start"]
    with sandbox_in(tmp_path) as sandbox:
        monkeypatch.chdir(sandbox.cwd)
        for name, value in sandbox.environment.items():
            monkeypatch.setenv(name, value)
        ended = run_here("fly", HOVER, "--sitl", "--out", "out", *key, *set_options(**mqtt))
        sandbox.assert_nobody_left()
        assert not (sandbox.cwd / "out").exists()
    assert ended.code == EXIT_BAD_INPUT
    [line] = ended.err_lines
    assert re.search(why, line), line


def test_a_mission_takes_off_by_itself_unless_it_says_otherwise() -> None:
    assert load_flight(HOVER).mission.start.takeoff == "at_once"
