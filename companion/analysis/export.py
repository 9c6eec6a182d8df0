"""Writes flights as tables (CSV, Parquet) and as a LeRobot dataset, with names, units and rates."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from companion.analysis.log import FlightLog, LogError
from companion.analysis.tables import TOPICS, cells_of, pieces_of, tables_of
from companion.model.constants import TICK_PERIOD_S
from companion.model.units import unit_of
from companion.runtime.files import whole_file, write_whole

ABOUT = "columns.json"
"""File beside the tables: for each table its rate, and for each column its unit and frame."""
_FRAMES: Final = ("world", "body", "sensor", "ned")
_CODEBASE, _CHUNK = "v3.0", 1000
"""Version of the LeRobot dataset's layout, and the number of files in one of its folders; each file holds an episode."""
_FILE = "{chunk_index:03d}/file-{file_index:03d}.parquet"
_DATA, _EPISODES = f"data/chunk-{_FILE}", f"meta/episodes/chunk-{_FILE}"
_INDICES = ("frame_index", "episode_index", "index", "task_index")


def about_column(name: str) -> dict[str, str | None]:
    """Return unit and frame of a column, which its name states; None where it has none."""
    field = re.sub(r"\[\d+\]", "", name).rpartition(".")[2]
    frame = next((frame for frame in _FRAMES if f"_{frame}" in field), None)
    return {"unit": unit_of(field), "frame": frame}


def write_tables(log: FlightLog, out: Path, suffix: str) -> list[Path]:
    """Write the tables of `FlightLog.to_pandas`, with every tick, and `ABOUT`; return the paths.

    Args:
        out: folder, which is made.
        suffix: `csv` or `parquet`.

    Raises:
        ImportError: pandas is not installed, or pyarrow for the suffix `parquet`.
        OSError: a file cannot be written.
    """
    tables = tables_of(log.every_tick)
    out.mkdir(parents=True, exist_ok=True)
    about: dict[str, Any] = {
        "log": log.path.name,
        "index": {"name": "t_s", "unit": "s", "clock": "flight"},
        "tables": {},
    }
    written = []
    for topic, table in tables.items():
        path = out / f"{topic.removeprefix('/')}.{suffix}"
        with whole_file(path) as file:
            table.write(file, suffix)
        about["tables"][path.name] = {
            "rate_hz": None if topic == "/events" else round(1.0 / TICK_PERIOD_S),
            "columns": {name: about_column(name) for name in table.columns},
        }
        written.append(path)
    _write_json(out / ABOUT, about)
    return [*written, out / ABOUT]


_VECTORS = {
    "observation.state": (
        ("/inputs", "vehicle.position_world_m"),
        ("/inputs", "vehicle.velocity_world_m_s"),
        ("/inputs", "vehicle.attitude_wxyz"),
        ("/inputs", "vehicle.angular_rate_body_rad_s"),
        ("/inputs", "arm.angle_rad"),
        ("/inputs", "arm.velocity_rad_s"),
        ("/outputs", "control.force_ext_world_n"),
        ("/outputs", "reference.position_world_m"),
        ("/outputs", "reference.arm_rad"),
    ),
    "action": (("/outputs", "attitude.attitude_wxyz"), ("/outputs", "attitude.thrust"), ("/outputs", "arm_torque_nm")),
}
"""Features of a dataset, and the fields of the log that they hold."""
_PLACES = {place for places in _VECTORS.values() for place in places}


def write_lerobot(logs: Sequence[FlightLog], out: Path) -> int:
    """Write flights as a LeRobot dataset of version 3.0, one episode each; return the number of frames.

    A frame is a tick in which everything is known: the law flew, and its command was sent. `timestamp` counts them at the nominal
    rate; `t_s` is the flight clock.

    Args:
        logs: flights of vehicles with the same number of joints.
        out: folder, which must not exist or be empty.

    Raises:
        ImportError: pandas or pyarrow is not installed.
        LogError: a flight has no such tick, or the flights do not belong into one dataset.
        OSError: a file cannot be written.
    """
    episodes = [_episode(log) for log in logs]
    names = {key: list(table.columns) for key, table in episodes[0].items()}
    for log, episode in zip(logs, episodes, strict=True):
        if any(list(episode[key].columns) != wanted for key, wanted in names.items()):
            raise LogError(
                f"{log.path}: has other fields than {logs[0].path}, as those of another arm: export it by itself"
            )
    if out.exists() and any(out.iterdir()):
        raise LogError(f"{out}: is not empty; a dataset needs a folder of its own")
    tasks = list(dict.fromkeys(_named(log, "mission") for log in logs))
    features: dict[str, Any] = {
        key: {"dtype": "float32", "shape": [len(value)], "names": value} for key, value in names.items()
    }
    features |= {
        "timestamp": _scalar("float32"),
        "t_s": _scalar("float64"),
        **{key: _scalar("int64") for key in _INDICES},
    }
    described, every, begun = [], [], 0
    for number, (log, episode) in enumerate(zip(logs, episodes, strict=True)):
        vectors = {key: table.to_numpy(np.float32) for key, table in episode.items()}
        count = len(vectors["action"])
        frames = np.arange(count)
        task = tasks.index(_named(log, "mission"))
        scalars = {
            "timestamp": (frames * TICK_PERIOD_S).astype(np.float32),
            "t_s": episode["action"].index.to_numpy(),
            **dict(zip(_INDICES, (frames, frames * 0 + number, frames + begun, frames * 0 + task), strict=True)),
        }
        place = {"chunk_index": number // _CHUNK, "file_index": number % _CHUNK}
        _write_frames(out / _DATA.format(**place), {**vectors, **scalars})
        every.append({**vectors, **{key: value[:, None] for key, value in scalars.items()}})
        described.append(
            {
                "episode_index": number,
                "tasks": [tasks[task]],
                "length": count,
                "dataset_from_index": begun,
                "dataset_to_index": begun + count,
                **{f"data/{key}": value for key, value in place.items()},
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
                **{
                    f"stats/{key}/{name}": found
                    for key, value in every[-1].items()
                    for name, found in _statistics(value).items()
                },
            }
        )
        begun += count
    _write_parquet(
        out / _EPISODES.format(chunk_index=0, file_index=0),
        {key: [row[key] for row in described] for key in described[0]},
    )
    _write_parquet(out / "meta/tasks.parquet", {"task_index": range(len(tasks))}, index=tasks)
    statistics = {key: _statistics(np.concatenate([columns[key] for columns in every])) for key in every[0]}
    info = {
        "codebase_version": _CODEBASE,
        "robot_type": _named(logs[0], "vehicle"),
        "total_episodes": len(logs),
        "total_frames": begun,
        "total_tasks": len(tasks),
        "chunks_size": _CHUNK,
        "fps": round(1.0 / TICK_PERIOD_S),
        "splits": {"train": f"0:{len(logs)}"},
        "data_path": _DATA,
        "video_path": None,
        "features": features,
    }
    units = {key: {column: about_column(column) for column in columns} for key, columns in names.items()}
    about = {"rate_hz": info["fps"], "columns": units}
    for path, content in (("meta/info.json", info), ("meta/stats.json", statistics), (ABOUT, about)):
        _write_json(out / path, content)
    return begun


def _write_json(path: Path, content: Any) -> None:
    write_whole(path, f"{json.dumps(content, indent=1)}\n".encode())


def _write_frames(path: Path, columns: dict[str, Any]) -> None:
    import pyarrow
    from pyarrow import parquet

    def column(values: Any) -> Any:
        if values.ndim == 1:
            return pyarrow.array(values)
        offsets = np.arange(len(values) + 1, dtype=np.int32) * values.shape[1]
        return pyarrow.ListArray.from_arrays(pyarrow.array(offsets), pyarrow.array(values.ravel()))

    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as file:
        parquet.write_table(pyarrow.table({key: column(values) for key, values in columns.items()}), file)


def _write_parquet(path: Path, columns: dict[str, Any], index: Sequence[str] | None = None) -> None:
    import pandas

    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, pandas.DataFrame(columns, index=index).to_parquet(index=index is not None))


def _episode(log: FlightLog) -> dict[str, Any]:
    """Return a table for each feature, with the ticks in which every field is known."""
    import pandas

    fields = [(key, topic, field) for key, places in _VECTORS.items() for topic, field in places]
    pieces = []
    for rows in pieces_of(log.every_tick()):
        ticks = [
            {
                (topic, name): value
                for topic, record in zip(TOPICS, row, strict=True)
                for name, value in cells_of(record).items()
                if (topic, name.partition("[")[0]) in _PLACES and value is not None
            }
            for row in rows
        ]
        index = pandas.Index([row[0].t_s for row in rows], name="t_s", dtype=float)
        pieces.append(pandas.DataFrame(ticks, index=index, dtype=np.float32))
    table = pandas.concat(pieces) if pieces else pandas.DataFrame()
    found = {
        (key, name): table[(of, name)]
        for key, topic, field in fields
        for of, name in table.columns
        if (of, name.partition("[")[0]) == (topic, field)
    }
    frames = pandas.DataFrame(found).dropna()
    if frames.empty or {key for key, _ in found} != set(_VECTORS):
        raise LogError(f"{log.path}: its vehicle did not fly: it has no frames")
    return {key: frames[key] for key in _VECTORS}


def _scalar(dtype: str) -> dict[str, Any]:
    return {"dtype": dtype, "shape": [1], "names": None}


def _statistics(values: Any) -> dict[str, list[float]]:
    found = {name: getattr(values, name)(axis=0).tolist() for name in ("min", "max", "mean", "std")}
    return {**found, "count": [len(values)]}


def _named(log: FlightLog, part: str) -> str:
    return str(log.config.get(part, {}).get("name", "unknown"))
