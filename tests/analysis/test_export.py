"""What `companion export` writes, read back by pandas, and a LeRobot dataset by its published layout (version 3.0)."""

from __future__ import annotations

import dataclasses
import importlib
import json
import os
import resource
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from companion.analysis.export import write_tables
from companion.analysis.log import FlightLog
from companion.cli.main import main
from tests.analysis.synthetic_flight import record_flight


@pytest.fixture(scope="module")
def pandas() -> Any:
    """The library. Not at the top: every worker reads this file, and one needs it."""
    return importlib.import_module("pandas")


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("A") / "flight.mcap"
    record_flight(path, end_s=3.0)
    return path


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_table_holds_the_log_with_units_and_rate(pandas: Any, path: Path, tmp_path: Path, suffix: str) -> None:
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
    assert (inputs["rate_hz"], about[f"events.{suffix}"]["rate_hz"]) == (200, None)
    assert inputs["columns"]["vehicle.velocity_world_m_s[2]"] == {"unit": "m/s", "frame": "world"}
    assert about[f"outputs.{suffix}"]["columns"]["arm_torque_nm[0]"] == {"unit": "N m", "frame": None}


def test_the_rate_of_a_flight_in_simulated_time_is_that_of_the_loop(pandas: Any, path: Path, tmp_path: Path) -> None:
    """Its ticks are 4 and 6 ms apart in turn."""
    log = FlightLog.read(path)
    inputs = tuple(replace(i, t_s=i.t_s + 0.001 * (i.tick % 2)) for i in log.inputs)
    for first in (0, 1):
        part = dataclasses.replace(log, inputs=inputs[first:], outputs=log.outputs[first:], sent=log.sent[first:])
        write_tables(part, tmp_path, "csv")
        about = json.loads((tmp_path / "columns.json").read_text(encoding="utf-8"))["tables"]
        assert {about[f"{table}.csv"]["rate_hz"] for table in ("inputs", "outputs", "sent")} == {200}


def test_a_dataset_has_the_layout_of_lerobot_and_the_values_of_the_logs(
    pandas: Any, path: Path, tmp_path: Path
) -> None:
    second = tmp_path / "B" / "flight.mcap"
    second.parent.mkdir()
    shutil.copy(path, second)
    out = tmp_path / "set"
    assert main(["export", str(path), str(second), "--format", "lerobot", "--out", str(out)]) == 0
    info = json.loads((out / "meta/info.json").read_text(encoding="utf-8"))
    assert (info["codebase_version"], info["fps"], info["total_episodes"]) == ("v3.0", 200, 2)
    episodes = pandas.read_parquet(out / "meta/episodes/chunk-000/file-000.parquet").to_dict("records")
    tasks = pandas.read_parquet(out / "meta/tasks.parquet")
    statistics = json.loads((out / "meta/stats.json").read_text(encoding="utf-8"))
    log = FlightLog.read(path)
    flown = [(i, o) for i, o, _ in log.rows() if o.control is not None and o.attitude is not None]
    assert [episode["length"] for episode in episodes] == [len(flown)] * 2 == [info["total_frames"] // 2] * 2
    assert list(episodes[0]["tasks"]) == list(tasks.index[[0]])
    assert [(e["dataset_from_index"], e["dataset_to_index"]) for e in episodes] == [
        (0, len(flown)),
        (len(flown), 2 * len(flown)),
    ]
    for number, episode in enumerate(episodes):
        place = {key: episode[f"data/{key}"] for key in ("chunk_index", "file_index")}
        frames = pandas.read_parquet(out / info["data_path"].format(**place))
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
            at = feature["names"].index(name)
            assert episode[f"stats/{key}/max"][at] == statistics[key]["max"][at] == column.max()
            assert statistics[key]["count"] == [2 * len(flown)]


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


@pytest.mark.parametrize(
    ("form", "out", "lost"),
    [
        ("csv", ".", "inputs.csv"),
        ("parquet", ".", "inputs.parquet"),
        ("lerobot", "set", "set/data/chunk-000/file-000.parquet"),
        ("foxglove", "both.mcap", "both.mcap"),
    ],
)
def test_a_full_disk_is_one_line_and_no_file_is_cut_short(
    pandas: Any, path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], form: str, out: str, lost: str
) -> None:
    """A file of the same name keeps what an earlier export wrote."""
    earlier = tmp_path / "inputs.csv"
    earlier.write_text("of an earlier export")
    size, limit = resource.getrlimit(resource.RLIMIT_FSIZE), 10_000
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, size[1]))  # Python gets EFBIG: it ignores the signal
    try:
        assert main(["export", str(path), "--format", form, "--out", str(tmp_path / out)]) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, size)
    assert capsys.readouterr().err == f"companion export: {tmp_path / lost}: cannot be written: File too large\n"
    assert [one for one in tmp_path.rglob("*") if one.is_file()] == [earlier]
    assert earlier.read_text() == "of an earlier export"


def test_a_folder_whose_name_is_no_text_is_shown_with_a_question_mark(path: Path, tmp_path: Path) -> None:
    odd = tmp_path / os.fsdecode(b"odd\xff") / "flight.mcap"
    odd.parent.mkdir()
    shutil.copy(path, odd)
    both = [str(odd), str(path)]
    assert main(["export", *both, "--format", "foxglove", "--out", str(tmp_path / "both.mcap")]) == 0
    assert main(["report", *both, "--out", str(tmp_path / "page")]) == 0
    assert "odd?" in (tmp_path / "page" / "side_by_side.html").read_text(encoding="utf-8")


def test_lerobot_reads_the_dataset(pandas: Any, path: Path, tmp_path: Path) -> None:
    """Where LeRobot's package is installed, which needs PyTorch."""
    datasets = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="LeRobot is not installed")
    assert main(["export", str(path), str(path), "--format", "lerobot", "--out", str(tmp_path / "set")]) == 0
    read = datasets.LeRobotDataset("laboratory/flights", root=tmp_path / "set", episodes=[1])
    written = pandas.read_parquet(tmp_path / "set/data/chunk-000/file-001.parquet")
    assert (read.num_episodes, len(read), read.fps) == (1, len(written), 200)
    for number in range(0, len(written), 50):
        for key in ("observation.state", "action"):
            assert read[number][key].tolist() == written[key][number].tolist()
        assert read[number]["task"] == read.meta.tasks.index[0]
