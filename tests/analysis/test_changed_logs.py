"""Logs with changed metadata or with infinity in a tick: every command refuses them in one line, or evaluates them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from companion.analysis.log import FlightLog, LogError
from companion.cli.main import main
from companion.config.loader import load_flight
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_OK
from tests.analysis.synthetic_flight import record_flight
from tests.support import ROOT

COMMANDS = {
    "report": (),
    "replay": (),
    "identify": (),
    "hover": (),
    "export": ("--format", "csv"),
    "export foxglove": ("--format", "foxglove"),
    "export lerobot": ("--format", "lerobot"),
}
Metadata = dict[str, dict[str, str]]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "flight.mcap"
    config = load_flight(ROOT / "configs/missions/catch.yaml").model_dump(mode="json")
    record_flight(path, config=config, rate_hz=50.0, end_s=7.0)
    return path


def changed(
    log: Path,
    path: Path,
    metadata: Callable[[Metadata], object] = lambda found: None,
    inputs: Callable[[dict[str, Any]], object] = lambda tick: None,
) -> Path:
    """Write the log again with other metadata and other inputs."""
    with log.open("rb") as file, path.open("wb") as out:
        reader, writer = make_reader(file), Writer(out)
        writer.start()
        found = {record.name: dict(record.metadata) for record in reader.iter_metadata()}
        metadata(found)
        for name, values in found.items():
            writer.add_metadata(name, values)
        channels: dict[str, int] = {}
        for _, channel, message in reader.iter_messages(log_time_order=False):
            if channel.topic not in ("/inputs", "/outputs", "/sent"):
                continue
            if channel.topic not in channels:
                channels[channel.topic] = writer.register_channel(channel.topic, "json", 0)
            data = message.data
            if channel.topic == "/inputs":
                tick = json.loads(data)
                inputs(tick)
                data = json.dumps(tick).encode()
            writer.add_message(channels[channel.topic], 0, data, 0)
        writer.finish()
    return path


def ran(command: str, log: Path, folder: Path) -> int:
    name = command.partition(" ")[0]
    if name == "hover":
        return main([name, "fit", str(log)])
    out = () if name == "replay" else ("--out", str(folder / f"{command}.out"))
    return main([name, str(log), *COMMANDS[command], *out])


def config_with(key: str, value: object) -> Callable[[Metadata], object]:
    """Set a key of the configuration, such as `vehicle.room`; `...` deletes it."""

    def change(metadata: Metadata) -> None:
        config = json.loads(metadata["config"]["json"])
        *parents, last = key.split(".")
        section = config
        for parent in parents:
            section = section[parent]
        section[last] = value
        if value is ...:
            del section[last]
        metadata["config"]["json"] = json.dumps(config)

    return change


def text_of(record: str, key: str, text: str) -> Callable[[Metadata], object]:
    return lambda metadata: metadata.setdefault(record, {}).update({key: text})


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (config_with("vehicle", "none"), "vehicle"),
        (config_with("vehicle.name", 5), "vehicle.name"),
        (config_with("vehicle.airframe", None), "vehicle.airframe"),
        (config_with("vehicle.airframe.mass_kg", 0), "vehicle.airframe.mass_kg"),
        (config_with("vehicle.airframe.mass_kg", float("nan")), "'config'"),
        (config_with("vehicle.airframe.radius_m", 1e308), "1e+308"),
        (config_with("vehicle.airframe.ground_clearance_m", "0.2"), "vehicle.airframe.ground_clearance_m"),
        (config_with("vehicle.arm.joints", 2), "vehicle.arm.joints"),
        (config_with("vehicle.tool.net_radius_m", "wide"), "vehicle.tool.net_radius_m"),
        (config_with("vehicle.room", {"x_m": [0]}), "vehicle.room"),
        (config_with("mission", "catch"), "mission"),
        (config_with("sources", {"overrides": 3}), "sources.overrides"),
        (config_with("world", {"throw_velocity_m_s": "fast"}), "world.throw_velocity_m_s"),
        (text_of("config", "json", "[]"), "'config'"),
        (text_of("config", "json", "{"), "'config'"),
        (text_of("config", "json", '{"vehicle":' * 9000), "'config'"),
        (text_of("plan", "json", '[[1, "x", 2]]'), "'plan'"),
        (text_of("companion", "epoch_offset_ns", "yesterday"), "epoch_offset_ns"),
        (text_of("companion", "epoch_offset_ns", "9" * 5000), "epoch_offset_ns"),
    ],
)
def test_metadata_of_the_wrong_type_is_refused_in_one_line(
    flown: Path, tmp_path: Path, change: Callable[[Metadata], object], key: str
) -> None:
    log = changed(flown, tmp_path / "changed.mcap", change)
    with pytest.raises(LogError) as refused:
        FlightLog.read(log)
    assert str(refused.value).startswith(f"{log}: metadata '") and key in str(refused.value)
    assert "\n" not in str(refused.value) and len(str(refused.value)) < 300


@pytest.mark.parametrize("time_s", [float("inf"), float("nan"), 1e300])
def test_a_tick_without_a_time_is_damage(flown: Path, tmp_path: Path, time_s: float) -> None:
    log = changed(flown, tmp_path / "changed.mcap", inputs=lambda tick: tick.update(t_s=str(time_s)))
    with pytest.raises(LogError, match=r"damaged: tick 0 has the time"):
        FlightLog.read(log)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_refuses_a_log_whose_configuration_is_invalid(
    command: str, flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if command.startswith("export"):
        pytest.importorskip("pandas")
    log = changed(flown, tmp_path / "changed.mcap", config_with("vehicle.airframe", []))
    assert ran(command, log, tmp_path) == EXIT_BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert "vehicle.airframe" in line


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    "without", [["vehicle"], ["vehicle.arm"], ["vehicle.airframe", "vehicle.room", "mission", "sources"]], ids=str
)
def test_a_log_without_parts_of_its_configuration_is_evaluated_without_them(
    without: list[str], flown: Path, tmp_path: Path
) -> None:
    log = changed(flown, tmp_path / "changed.mcap", lambda found: [config_with(key, ...)(found) for key in without])
    assert ran("report", log, tmp_path) == EXIT_OK
    assert ran("export foxglove", log, tmp_path) == EXIT_OK
    assert ran("replay", log, tmp_path) == ran("identify", log, tmp_path) == EXIT_BAD_INPUT


def test_a_log_with_infinity_in_its_inputs_is_evaluated(flown: Path, tmp_path: Path) -> None:
    def endless(tick: dict[str, Any]) -> None:
        if "mocap" in tick and tick["tick"] > 300:
            tick["mocap"]["position_world_m"][0] = "inf"
            tick["mocap"]["stamp_s"] = 1e308
        if "vehicle" in tick:
            tick["vehicle"]["velocity_world_m_s"][2] = "-inf"

    log = changed(flown, tmp_path / "changed.mcap", inputs=endless)
    assert ran("report", log, tmp_path) == EXIT_OK
    assert ran("export foxglove", log, tmp_path) == EXIT_OK
    assert ran("replay", log, tmp_path) in (1, EXIT_BAD_INPUT)
