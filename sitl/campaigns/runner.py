"""Flies the flights of a campaign on the cores of this computer (joblib) or on the workers of a Dask cluster."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from typing import Any

from companion import DISTRIBUTION
from companion.campaigns.process import CampaignError
from companion.sitl_config.loader import SitlConfig

SCHEDULER_TIMEOUT_S = 10.0
WORKERS_TIMEOUT_S = 30.0

Data = dict[str, Any]
Fly = Callable[[SitlConfig, Data], Data]
"""Flies one flight of a job and returns its `row`; must be a module-level function, so that workers can import it."""


def fly_all(
    fly: Fly,
    configs: Sequence[SitlConfig],
    flights: Sequence[Data],
    jobs: int | None,
    scheduler: str | None,
    *,
    batch: bool = False,
) -> Generator[Data, None, None]:
    """Fly all flights; yield results in the order in which the flights end.

    With `batch` there are as many processes as `jobs` even for fewer flights, so that the next batch finds them.

    Each has also its `index`, `wall_s`, `cpu_s` (processor time), and `at_once`, the number of simultaneous flights.

    Raises:
        CampaignError: there is no scheduler or no worker, or a worker died.
    """
    texts = [config.model_dump_json() for config in configs]
    tasks = [(fly, index, texts[flight["variant"]], flight) for index, flight in enumerate(flights)]
    if scheduler is not None:
        return _over_machines(tasks, scheduler)
    jobs = jobs or os.cpu_count() or 1
    return _over_cores(tasks, jobs, jobs if batch else min(jobs, len(tasks)))


def _fly(fly: Fly, index: int, config_json: str, flight: Data) -> Data:
    begin_s, begin_cpu_s = time.perf_counter(), time.thread_time()
    result = fly(SitlConfig.model_validate_json(config_json), flight)
    cpu_s, wall_s = time.thread_time() - begin_cpu_s, time.perf_counter() - begin_s
    return {"index": index, **result, "wall_s": wall_s, "cpu_s": cpu_s}


def _over_cores(
    tasks: Sequence[tuple[Fly, int, str, Data]], at_once: int, processes: int
) -> Generator[Data, None, None]:
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    if processes <= 1:
        yield from ({**_fly(*task), "at_once": at_once} for task in tasks)
        return
    with parallel_config(backend="loky", n_jobs=processes, inner_max_num_threads=1):
        try:
            results = Parallel(return_as="generator_unordered", batch_size=1)(delayed(_fly)(*task) for task in tasks)
            yield from ({**result, "at_once": at_once} for result in results)
        except TerminatedWorkerError:
            raise CampaignError(
                "a worker process died (killed, or out of memory?); fewer --jobs use less memory"
            ) from None


def _over_machines(tasks: Sequence[tuple[Fly, int, str, Data]], scheduler: str) -> Generator[Data, None, None]:
    try:
        from distributed import Client, as_completed
        from distributed.scheduler import KilledWorker
    except ImportError:
        raise CampaignError(f"--scheduler needs Dask: pip install '{DISTRIBUTION}[cluster]'", bad_input=True) from None
    try:
        client = Client(scheduler, timeout=SCHEDULER_TIMEOUT_S)
    except (OSError, ValueError) as error:
        raise CampaignError(
            f"--scheduler {scheduler}: no Dask scheduler answers there ({_first_line(error)})", bad_input=True
        ) from None
    with closing(client):
        try:
            client.wait_for_workers(1, timeout=WORKERS_TIMEOUT_S)
        except TimeoutError:
            raise CampaignError(
                f"--scheduler {scheduler}: no worker has joined it; start one with: dask worker {scheduler}",
                bad_input=True,
            ) from None
        at_once = sum(client.nthreads().values())
        futures = [client.submit(_fly, *task, pure=False) for task in tasks]
        try:
            for _, result in as_completed(futures, with_results=True):
                yield {**result, "at_once": at_once}
        except KilledWorker:
            raise CampaignError(f"--scheduler {scheduler}: its workers keep dying; see their logs") from None
        except ImportError as error:
            raise CampaignError(
                f"--scheduler {scheduler}: a worker cannot import the program ({error}); install {DISTRIBUTION}[sitl,cluster] there"
            ) from None


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
