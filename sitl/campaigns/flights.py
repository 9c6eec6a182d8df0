"""`python -m sitl.campaigns.flights`: flies a grid of fast flights over cores or over machines. Started by `companion compare`.

Standard input: one line of JSON, then nothing; when it ends, so does the campaign.
    configs       effective configurations (`SitlConfig`), one per variant
    flights       {variant, controller, preset, payload_kg, seed, series}: `variant` counts in `configs`
    jobs          processes; null: one per core
    scheduler     address of a Dask scheduler instead; null: this machine
Standard output: JSON lines {"type": "flight", "index", "row", "series", "wall_s"} as flights end;
{"type": "error", "text", "bad_input"} and exit code 1 if the campaign cannot go on.

A flight is a pure function of its configuration: the same row wherever and beside whatever it is flown.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from companion.analysis import metrics
from companion.analysis.log import Array, FlightLog
from companion.config.loader import FlightConfig
from companion.model.types import Event, Inputs, Outcome, Outputs, SafetyAction, Sent, Severity
from companion.sitl_config.loader import SitlConfig
from sitl.fast.loop import FastFlight, FastResult

SCHEDULER_TIMEOUT_S = 10.0
WORKERS_TIMEOUT_S = 30.0
SERIES_EVERY = 4
"""Ticks per point of a series: 50 Hz."""

Data = dict[str, Any]
Fly = Callable[[str, Data], Data]
"""One flight, from its effective configuration and what else is wanted of it: a function of a module, for other processes."""


class CampaignError(Exception):
    """The campaign cannot go on; one line."""

    def __init__(self, text: str, *, bad_input: bool = False) -> None:
        super().__init__(text)
        self.bad_input = bad_input
        """What was asked for cannot be had; nothing was flown."""


def fly(config_json: str, flight: Data) -> Data:
    """One flight: {row, series, wall_s}.

    Args:
        config_json: the variant's effective configuration.
        flight: as on standard input.
    """
    start_s = time.perf_counter()
    data = json.loads(config_json)
    data["world"].update(payload_kg=flight["payload_kg"], seed=flight["seed"])
    config = SitlConfig.model_validate_json(json.dumps(data))
    result, caught_t_s, error = FastResult(), None, None
    try:
        fast = FastFlight(config)
        result = fast.run()
        config, caught_t_s = fast.config, fast.plant.world.caught_t_s
    # A law that cannot go on ends its flight process: that flight is lost, and the others are flown all the same.
    except Exception as failure:
        error = f"{type(failure).__name__}: {failure}"
    row, log = row_of(config.flight, result, caught_t_s, error)
    head = {key: flight[key] for key in ("controller", "preset", "payload_kg", "seed")}
    series = series_of(log) if flight["series"] and log.inputs else None
    return {"row": {**head, **row}, "series": series, "wall_s": time.perf_counter() - start_s}


def row_of(
    config: FlightConfig, result: FastResult, caught_t_s: float | None, error: str | None = None
) -> tuple[Data, FlightLog]:
    """What a flight came to, without the head that names it (see `companion.campaigns.compare`), and its log.

    Args:
        config: of the flight.
        result: of the flight.
        caught_t_s: world time at which the payload truly was caught.
        error: what ended the flight from within.
    """
    log = log_of(config, result, caught_t_s)
    ended = result.outputs[-1].outcome if result.outputs else None
    outcome = Outcome.CRASHED if result.crashed else ended or Outcome.LOST
    completed = outcome is Outcome.COMPLETED
    index = metrics.catch_index(log)
    caught = index is not None
    pre, post = metrics.flight_masks(log) if log.inputs else (np.zeros(0, np.bool_), np.zeros(0, np.bool_))
    # What was not flown to its end is not graded.
    nothing = metrics.TrackingRms(None, None, None)
    before = metrics.tracking_rms(log, pre) if completed or caught else nothing
    after = metrics.tracking_rms(log, post) if completed and caught else nothing
    position_n, arm_nm = metrics.impedance_error(log) if completed else (None, None)
    return {
        "outcome": outcome.value,
        "error": error,
        "catch_t_s": log.outputs[index].mission_t_s if index is not None else None,
        "rms": {"pre": dataclasses.asdict(before), "post": dataclasses.asdict(after)},
        "impedance_error": {"position_n": position_n, "arm_nm": arm_nm},
        "final_e_z_m": metrics.final_e_z_m(log) if completed else None,
        "peak_e_p_m": _peak(metrics.position_error_m(log)[pre | post]) if completed else None,
        "torque_activity_nm": torque_activity_nm(log, pre | post) if completed else None,
    }, log


def torque_activity_nm(log: FlightLog, mask: metrics.Mask) -> float | None:
    """RMS of the change of the commanded joint torques (both, as a norm) from one tick to the next, over the ticks of the mask."""
    torque = log.column(lambda i, o, s: o.arm_torque_nm, 2)
    return metrics.rms_norm(np.diff(torque, axis=0)[mask[1:] & mask[:-1]])


def _peak(rows: Array) -> float | None:
    known = rows[np.isfinite(rows).all(axis=1)]
    return float(np.sqrt((known * known).sum(axis=1)).max()) if len(known) else None


def log_of(config: FlightConfig, result: FastResult, caught_t_s: float | None) -> FlightLog:
    """A fast flight as the log that metrics and plots are made of; no file."""
    outputs = _with_catch(result, caught_t_s)
    return FlightLog(
        path=Path("fast"),
        inputs=tuple(result.inputs),
        outputs=outputs,
        sent=tuple(_sent(i, o) for i, o in zip(result.inputs, outputs, strict=True)),
        metadata={"config": {"json": config.model_dump_json()}},
        closed=True,
    )


def _with_catch(result: FastResult, caught_t_s: float | None) -> tuple[Outputs, ...]:
    """The outputs; a catch that the companion did not notice is marked where it truly was, or before and after would be mixed."""
    outputs = list(result.outputs)
    seen = any(event.id == "catch" for output in outputs for event in output.events)
    if caught_t_s is not None and not seen:
        at = next((k for k, output in enumerate(outputs) if output.t_s >= caught_t_s), None)
        if at is not None:
            event = Event(outputs[at].t_s, "catch", Severity.INFO, SafetyAction.NOMINAL, "caught, by the world's truth")
            outputs[at] = dataclasses.replace(outputs[at], events=(*outputs[at].events, event))
    return tuple(outputs)


def _sent(i: Inputs, o: Outputs) -> Sent:
    return Sent(i.tick, o.attitude is not None, o.arm_torque_nm, i.t_s, 0.0, i.t_s, i.t_s, i.t_s, i.t_s)


def series_of(log: FlightLog) -> Data:
    """Errors and arm angles over the mission clock while in flight, for plots; None where a value is not known."""
    pre, post = metrics.flight_masks(log)
    used = np.flatnonzero(pre | post)[::SERIES_EVERY]
    columns = log.columns
    angles, wanted = np.degrees(columns.arm_rad), np.degrees(columns.arm_reference_rad)
    caught = metrics.catch_index(log)
    return {
        "t_s": _points(columns.mission_t_s[used]),
        "e_p_m": _points(np.sqrt((metrics.position_error_m(log)[used] ** 2).sum(axis=1))),
        "e_q_deg": _points(np.degrees(np.sqrt((metrics.attitude_error_rad(log)[used] ** 2).sum(axis=1)))),
        "alpha_deg": [_points(angles[used, j]) for j in range(2)],
        "alpha_reference_deg": [_points(wanted[used, j]) for j in range(2)],
        "catch_t_s": log.outputs[caught].mission_t_s if caught is not None else None,
    }


def _points(values: Array) -> list[float | None]:
    return [round(value, 6) if math.isfinite(value) else None for value in values.tolist()]


def fly_all(
    configs: Sequence[str], flights: Sequence[Data], jobs: int | None, scheduler: str | None, fly_one: Fly = fly
) -> Generator[Data, None, None]:
    """Fly the grid; results with their `index` in the order in which they end.

    Raises:
        CampaignError: no scheduler, no workers, or a worker that died.
    """
    if scheduler is not None:
        return _over_machines(configs, flights, scheduler, fly_one)
    return _over_cores(configs, flights, jobs or os.cpu_count() or 1, fly_one)


def _indexed(fly_one: Fly, index: int, config_json: str, flight: Data) -> Data:
    return {"index": index, **fly_one(config_json, flight)}


def _over_cores(
    configs: Sequence[str], flights: Sequence[Data], jobs: int, fly_one: Fly
) -> Generator[Data, None, None]:
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    tasks = [(fly_one, index, configs[flight["variant"]], flight) for index, flight in enumerate(flights)]
    if min(jobs, len(tasks)) <= 1:
        yield from (_indexed(*task) for task in tasks)
        return
    with parallel_config(backend="loky", n_jobs=min(jobs, len(tasks)), inner_max_num_threads=1):
        results = Parallel(return_as="generator_unordered", batch_size=1)(delayed(_indexed)(*task) for task in tasks)
        try:
            yield from results
        except TerminatedWorkerError:
            raise CampaignError(
                "a worker process died (killed, or out of memory?); fewer --jobs need less memory"
            ) from None


def _over_machines(
    configs: Sequence[str], flights: Sequence[Data], scheduler: str, fly_one: Fly
) -> Generator[Data, None, None]:
    try:
        from distributed import Client, as_completed
        from distributed.scheduler import KilledWorker
    except ImportError:
        raise CampaignError("--scheduler needs Dask: pip install 'companion[cluster]'", bad_input=True) from None
    try:
        client = Client(scheduler, timeout=SCHEDULER_TIMEOUT_S)
    except (OSError, ValueError) as error:
        raise CampaignError(
            f"--scheduler {scheduler}: no Dask scheduler answers there ({_line(error)})", bad_input=True
        ) from None
    with closing(client):
        try:
            client.wait_for_workers(1, timeout=WORKERS_TIMEOUT_S)
        except TimeoutError:
            raise CampaignError(
                f"--scheduler {scheduler}: no worker has joined it; start some: dask worker {scheduler}", bad_input=True
            ) from None
        futures = [
            client.submit(_indexed, fly_one, index, configs[flight["variant"]], flight, pure=False)
            for index, flight in enumerate(flights)
        ]
        try:
            for _, result in as_completed(futures, with_results=True):
                yield result
        except KilledWorker:
            raise CampaignError(f"--scheduler {scheduler}: workers died over and over; see their logs") from None
        except ImportError as error:
            raise CampaignError(
                f"--scheduler {scheduler}: a worker lacks the program ({error}); install companion[sitl,cluster] there"
            ) from None


def _line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def _say(message: Data) -> None:
    sys.stdout.write(json.dumps(message, allow_nan=False) + "\n")
    sys.stdout.flush()


def _leave_with_parent() -> None:
    """Whoever started us holds our standard input open; when it is gone, our workers and we have nothing left to do."""
    while os.read(sys.stdin.fileno(), 4096):
        pass
    if os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGTERM)
    os._exit(1)


def serve(grid: Callable[[Data], tuple[Sequence[str], Sequence[Data]]], fly_one: Fly = fly) -> int:
    """Fly what standard input asks for; the exit code.

    Args:
        grid: configurations and flights of a job.
        fly_one: flies one of them.
    """
    job = json.loads(sys.stdin.buffer.readline())
    threading.Thread(target=_leave_with_parent, name="parent", daemon=True).start()
    try:
        configs, flights = grid(job)
        with closing(fly_all(configs, flights, job["jobs"], job["scheduler"], fly_one)) as results:
            for result in results:
                _say({"type": "flight", **result})
    except CampaignError as error:
        _say({"type": "error", "text": str(error), "bad_input": error.bad_input})
        return 1
    return 0


def main() -> int:
    """Fly what standard input asks for."""
    return serve(lambda job: ([json.dumps(config) for config in job["configs"]], job["flights"]))


if __name__ == "__main__":
    # Workers find the functions by the module's name, which is not __main__ for them.
    from sitl.campaigns import flights as campaign

    sys.exit(campaign.main())
