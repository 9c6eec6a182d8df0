"""What `companion export` writes, read back by pandas, and a LeRobot dataset by its published layout (version 2.1)."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest

from companion.analysis.log import FlightLog
from companion.cli.main import main
from tests.analysis.synthetic_flight import record_flight


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("A") / "flight.mcap"
    record_flight(path, end_s=3.0)
    return path


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_table_holds_the_log_with_units_and_rate(path: Path, tmp_path: Path, suffix: str) -> None:
    assert main(["export", str(path), "--format", suffix, "--out", str(tmp_path)]) == 0
    about = json.loads((tmp_path / "columns.json").read_text(encoding="utf-8"))["tables"]
    for topic, wanted in FlightLog.read(path).to_pandas().items():
        name = f"{topic.removeprefix('/')}.{suffix}"
        if suffix == "csv":  # which has no empty text
            table = pandas.read_csv(tmp_path / name, index_col="t_s")
            wanted = wanted.replace("", np.nan)
        else:
            table = pandas.read_parquet(tmp_path / name)
        pandas.testing.assert_frame_equal(table, wanted, check_dtype=False, check_exact=True)
        assert list(about[name]["columns"]) == list(wanted.columns)
    inputs = about[f"inputs.{suffix}"]
    assert inputs["rate_hz"] == 200.0
    assert inputs["columns"]["vehicle.velocity_world_m_s[2]"] == {"unit": "m/s", "frame": "world"}
    assert about[f"outputs.{suffix}"]["columns"]["arm_torque_nm[0]"] == {"unit": "N m", "frame": None}


def lines_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def test_a_dataset_has_the_layout_of_lerobot_and_the_values_of_the_logs(path: Path, tmp_path: Path) -> None:
    second = tmp_path / "B" / "flight.mcap"
    second.parent.mkdir()
    shutil.copy(path, second)
    out = tmp_path / "set"
    assert main(["export", str(path), str(second), "--format", "lerobot", "--out", str(out)]) == 0
    info = json.loads((out / "meta/info.json").read_text(encoding="utf-8"))
    assert (info["codebase_version"], info["fps"], info["total_episodes"]) == ("v2.1", 200, 2)
    episodes, tasks = lines_of(out / "meta/episodes.jsonl"), lines_of(out / "meta/tasks.jsonl")
    log = FlightLog.read(path)
    flown = [(i, o) for i, o, _ in log.rows() if o.control is not None and o.attitude is not None]
    assert [episode["length"] for episode in episodes] == [len(flown)] * 2 == [info["total_frames"] // 2] * 2
    assert episodes[0]["tasks"] == [tasks[0]["task"]]
    for number in range(2):
        frames = pandas.read_parquet(out / info["data_path"].format(episode_chunk=0, episode_index=number))
        assert set(frames.columns) == set(info["features"])
        assert frames["index"].tolist() == list(range(number * len(flown), (number + 1) * len(flown)))
        assert frames["t_s"].tolist() == [i.t_s for i, _ in flown]
        np.testing.assert_allclose(frames["timestamp"], np.arange(len(flown)) / 200.0, atol=1e-4)
        for key, name, wanted in (
            (
                "observation.state",
                "vehicle.position_world_m[2]",
                [i.vehicle.position_world_m[2] for i, _ in flown if i.vehicle],
            ),
            ("action", "attitude.thrust", [o.attitude.thrust for _, o in flown if o.attitude]),
            ("action", "arm_torque_nm[1]", [o.arm_torque_nm[1] for _, o in flown if o.arm_torque_nm]),
        ):
            feature = info["features"][key]
            stacked = np.stack(frames[key].tolist())
            assert stacked.shape == (len(flown), *feature["shape"])
            column = stacked[:, feature["names"].index(name)]
            assert column.tolist() == np.array(wanted, np.float32).tolist()
            stats = lines_of(out / "meta/episodes_stats.jsonl")[number]["stats"][key]
            assert stats["max"][feature["names"].index(name)] == column.max()


def test_what_cannot_be_exported_is_refused_in_one_line(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    (tmp_path / "text").write_text("hello")
    for words, reason in (
        ([str(tmp_path / "text"), "--format", "csv"], "text: "),
        ([str(path), "--format", "lerobot"], "needs --out"),
        ([str(path), "--format", "lerobot", "--out", str(tmp_path / "full")], "is not empty"),
        ([str(path), "--format", "csv", "--out", str(tmp_path / "text")], "cannot be written"),
    ):
        assert main(["export", *words]) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        assert reason in err
