"""Writes flights as tables (CSV, Parquet) and as a LeRobot dataset, with names, units and rates."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from companion import DISTRIBUTION
from companion.analysis.log import FlightLog, LogError
from companion.model.constants import TICK_PERIOD_S
from companion.model.types import Inputs, Outputs

ABOUT = "columns.json"
"""File beside the tables: for each table its rate, and for each column its unit and frame."""
_UNITS: Final = {
    "_m_s3": "m/s^3", "_m_s2": "m/s^2", "_m_s": "m/s", "_deg_s": "deg/s", "_rad_s2": "rad/s^2", "_rad_s": "rad/s", "_n_m": "N/m",
    "_nm": "N m", "_kg": "kg", "_deg": "deg", "_rad": "rad", "_hz": "Hz", "_ms": "ms", "_m": "m", "_s": "s", "_n": "N", "_v": "V",
    "_c": "deg C", "_wxyz": "unit quaternion w, x, y, z",
}  # fmt: skip
_FRAMES: Final = ("world", "body", "sensor", "ned")
_CODEBASE, _CHUNK = "v2.1", 1000
"""Version of the LeRobot dataset's layout, and the number of episodes in one of its folders."""
_DATA = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
_INDICES = ("frame_index", "episode_index", "index", "task_index")


def about_column(name: str) -> dict[str, str | None]:
    """Return unit and frame of a column, which its name states; None where it has none."""
    field = re.sub(r"\[\d+\]", "", name).rpartition(".")[2]
    unit = next((unit for suffix, unit in _UNITS.items() if field.endswith(suffix)), None)
    frame = next((frame for frame in _FRAMES if f"_{frame}" in field), None)
    return {"unit": unit, "frame": frame}


def write_tables(log: FlightLog, out: Path, suffix: str) -> list[Path]:
    """Write the tables of `FlightLog.to_pandas` and `ABOUT`; return the paths.

    Args:
        log: the flight.
        out: folder, which is made.
        suffix: `csv` or `parquet`.

    Raises:
        LogError: pandas or pyarrow is not installed.
        OSError: a file cannot be written.
    """
    tables = log.to_pandas()
    if suffix == "parquet":
        _arrow()
    out.mkdir(parents=True, exist_ok=True)
    about: dict[str, Any] = {
        "log": log.path.name,
        "index": {"name": "t_s", "unit": "s", "clock": "flight"},
        "tables": {},
    }
    written = []
    for topic, table in tables.items():
        path = out / f"{topic.removeprefix('/')}.{suffix}"
        table.to_csv(path) if suffix == "csv" else table.to_parquet(path)
        periods_s = np.diff(table.index.to_numpy())
        rate_hz = round(1.0 / float(np.median(periods_s)), 3) if len(periods_s) and topic != "/events" else None
        about["tables"][path.name] = {
            "rate_hz": rate_hz,
            "columns": {name: about_column(name) for name in table.columns},
        }
        written.append(path)
    (out / ABOUT).write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    return [*written, out / ABOUT]


Frame = tuple[Inputs, Outputs]
_STATE: dict[str, Callable[[Inputs, Outputs], Sequence[float] | None]] = {
    "position_world_m": lambda i, o: i.vehicle.position_world_m if i.vehicle else None,
    "velocity_world_m_s": lambda i, o: i.vehicle.velocity_world_m_s if i.vehicle else None,
    "attitude_wxyz": lambda i, o: i.vehicle.attitude_wxyz if i.vehicle else None,
    "angular_rate_body_rad_s": lambda i, o: i.vehicle.angular_rate_body_rad_s if i.vehicle else None,
    "arm_rad": lambda i, o: i.arm.angle_rad if i.arm else (),
    "arm_rate_rad_s": lambda i, o: i.arm.velocity_rad_s if i.arm else (),
    "force_ext_world_n": lambda i, o: o.control.force_ext_world_n if o.control else None,
    "reference_position_world_m": lambda i, o: o.reference.position_world_m if o.reference else None,
    "reference_arm_rad": lambda i, o: o.reference.arm_rad if o.reference else None,
}
_ACTION: dict[str, Callable[[Inputs, Outputs], Sequence[float] | None]] = {
    "attitude_wxyz": lambda i, o: o.attitude.attitude_wxyz if o.attitude else None,
    "thrust": lambda i, o: (o.attitude.thrust,) if o.attitude else None,
    "arm_torque_nm": lambda i, o: o.arm_torque_nm if i.arm else (),
}


def write_lerobot(logs: Sequence[FlightLog], out: Path) -> int:
    """Write flights as a LeRobot dataset of version 2.1, one episode each; return the number of frames.

    A frame is a tick in which the law flew and its command was sent. `timestamp` counts them at the nominal rate; `t_s` is the
    flight clock.

    Args:
        logs: flights of vehicles with the same number of joints.
        out: folder, which must not exist or be empty.

    Raises:
        LogError: pyarrow is not installed, a flight has no such tick, or the flights do not belong into one dataset.
        OSError: a file cannot be written.
    """
    arrow, parquet = _arrow()
    episodes = [_episode(log) for log in logs]
    names = {key: [column for column, _ in episodes[0][key]] for key in ("observation.state", "action")}
    for log, episode in zip(logs, episodes, strict=True):
        if any([column for column, _ in episode[key]] != wanted for key, wanted in names.items()):
            raise LogError(
                f"{log.path}: its arm has another number of joints than that of {logs[0].path}: export it by itself"
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
    described, statistics, begun = [], [], 0
    for number, (log, episode) in enumerate(zip(logs, episodes, strict=True)):
        vectors = {key: np.array([value for _, value in episode[key]], np.float32).T for key in names}
        count = len(vectors["action"])
        frames = np.arange(count)
        task = tasks.index(_named(log, "mission"))
        scalars = {
            "timestamp": (frames * TICK_PERIOD_S).astype(np.float32),
            "t_s": np.array(episode["t_s"]),
            **dict(zip(_INDICES, (frames, frames * 0 + number, frames + begun, frames * 0 + task), strict=True)),
        }
        lists = {
            key: arrow.FixedSizeListArray.from_arrays(arrow.array(value.ravel()), value.shape[1])
            for key, value in vectors.items()
        }
        path = out / _DATA.format(episode_chunk=number // _CHUNK, episode_index=number)
        path.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(arrow.table({**lists, **scalars}), path)
        described.append({"episode_index": number, "tasks": [tasks[task]], "length": count})
        columns = {**vectors, **{key: value[:, None] for key, value in scalars.items()}}
        statistics.append(
            {"episode_index": number, "stats": {key: _statistics(value) for key, value in columns.items()}}
        )
        begun += count
    info = {
        "codebase_version": _CODEBASE,
        "robot_type": _named(logs[0], "vehicle"),
        "total_episodes": len(logs),
        "total_frames": begun,
        "total_tasks": len(tasks),
        "total_videos": 0,
        "total_chunks": -(-len(logs) // _CHUNK),
        "chunks_size": _CHUNK,
        "fps": round(1.0 / TICK_PERIOD_S),
        "splits": {"train": f"0:{len(logs)}"},
        "data_path": _DATA,
        "video_path": None,
        "features": features,
    }
    meta = out / "meta"
    meta.mkdir()
    (meta / "info.json").write_text(json.dumps(info, indent=4) + "\n", encoding="utf-8")
    units = {key: {column: about_column(column) for column in columns} for key, columns in names.items()}
    (out / ABOUT).write_text(json.dumps({"rate_hz": info["fps"], "columns": units}, indent=1) + "\n", encoding="utf-8")
    listed = [{"task_index": index, "task": task} for index, task in enumerate(tasks)]
    for name, rows in (("tasks", listed), ("episodes", described), ("episodes_stats", statistics)):
        (meta / f"{name}.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows), encoding="utf-8")
    return begun


def _episode(log: FlightLog) -> dict[str, Any]:
    """Return the flight clock of the frames, and for state and action each column's name and values."""
    frames = [
        (i, o)
        for i, o, _ in log.rows()
        if i.vehicle and o.control and o.reference and o.attitude and o.arm_torque_nm is not None
    ]
    if not frames:
        raise LogError(f"{log.path}: its vehicle did not fly: it has no frames")
    groups = {"observation.state": _STATE, "action": _ACTION}
    return {
        "t_s": [i.t_s for i, _ in frames],
        **{key: list(_columns(frames, fields)) for key, fields in groups.items()},
    }


def _columns(frames: Sequence[Frame], fields: dict[str, Any]) -> Iterator[tuple[str, list[float]]]:
    for name, value in fields.items():
        rows = [value(*frame) for frame in frames]
        for index, column in enumerate(zip(*rows, strict=True)):
            yield name if len(rows[0]) == 1 else f"{name}[{index}]", list(column)


def _scalar(dtype: str) -> dict[str, Any]:
    return {"dtype": dtype, "shape": [1], "names": None}


def _statistics(values: Any) -> dict[str, list[float]]:
    found = {name: getattr(values, name)(axis=0).tolist() for name in ("min", "max", "mean", "std")}
    return {**found, "count": [len(values)]}


def _named(log: FlightLog, part: str) -> str:
    return str(log.config.get(part, {}).get("name", "unknown"))


def _arrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise LogError(f"export: needs pyarrow: pip install '{DISTRIBUTION}[pandas]'") from None
    return pyarrow, pyarrow.parquet
