"""What every test starts from, whoever starts it: the same examples of property tests, and default signal handling.

`make test` draws the same examples everywhere. `make explore` (`--hypothesis-profile=explore`) draws many, at random.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import gc
import importlib
import inspect
import itertools
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis.internal.conjecture import providers
from hypothesis.internal.constants_ast import Constants

from tests.support import DEADLINE_S, Sandbox, sandbox_in

_LOADED_COMPUTER = [HealthCheck.too_slow]
"""Neither this check nor a deadline may fail a test: both measure the computer."""
settings.register_profile(
    "test", derandomize=True, database=None, max_examples=50, deadline=None, suppress_health_check=_LOADED_COMPUTER
)
settings.register_profile(
    "explore",
    derandomize=False,
    database=None,
    max_examples=1000,
    deadline=None,
    print_blob=True,
    suppress_health_check=_LOADED_COMPUTER,
)
settings.load_profile("test")

# Collections took an eighth of the time of the imports and a fiftieth of that of the tests: the heap is large, and little of it cyclic.
gc.set_threshold(100_000, 20, 20)

# Threads of OpenBLAS for matrices of this size only cost: starting and waiting, 0.05 to 0.1 s of CPU time in each process with numpy.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

# The tests' children run the source, also where `make compile` has installed the compiled build.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH"))))

# A process that a shell without job control starts in the background ignores SIGINT, and so do its children. The tests' children
# are started as a terminal would start them.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.pthread_sigmask(signal.SIG_SETMASK, ())


def pytest_configure() -> None:
    """Draw no constants from the modules that happen to be imported: which these are depends on the tests run before."""
    if settings.get_current_profile_name() == "test":
        nothing = Constants()
        providers._get_local_constants = lambda: nothing


def pytest_unconfigure() -> None:
    """Spare a worker pytest's last garbage collections, some seconds over its heap: what they find, a worker reports to nobody."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        gc.freeze()


def pytest_xdist_auto_num_workers() -> int:
    """Return the number of workers of `pytest -n auto`: two on each processor, because many tests wait for other processes. Each more
    takes ten seconds of CPU time to collect the tests and to import what they need.
    """
    return 2 * len(os.sched_getaffinity(0))


@pytest.fixture
def sandbox(tmp_path: Path) -> Iterator[Sandbox]:
    """A place to run `companion` in."""
    with sandbox_in(tmp_path) as sandbox:
        yield sandbox


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are composed and not drawn, which takes most of the time of a report: for tests that judge something else."""
    monkeypatch.setattr("matplotlib.backends.backend_agg.FigureCanvasAgg.print_png", _not_drawn)
    monkeypatch.setattr("matplotlib.backends.backend_svg.FigureCanvasSVG.print_svg", _not_drawn)


def _not_drawn(_: object, path: Path, **__: object) -> None:
    path.write_bytes(b"drawn")


@pytest.fixture(scope="module")
def short_wait() -> Iterator[None]:
    """The wait of a flight before its take-off is short: nothing but noise happens meanwhile."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("companion.model.flight_stage.TARE_S", 0.1)
        patched.setattr("companion.mission.settled.SETTLED_S", 0.1)
        yield


@pytest.fixture(scope="module")
def short_start(short_wait: None) -> Iterator[None]:
    """The wait of a flight before its take-off is short, and so is the stream of setpoints before OFFBOARD: a second less."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("companion.model.flight_stage.STREAM_BEFORE_OFFBOARD_S", 0.1)
        yield


@pytest.fixture(scope="module", autouse=True)
def _nothing_is_hoarded(request: pytest.FixtureRequest) -> Iterator[None]:
    """What a file's tests share by `@cache`, whole flights mostly, goes with its last test: it would weigh on every test after them."""
    yield
    for shared in vars(request.module).values():
        if isinstance(shared, functools._lru_cache_wrapper) and shared.__module__ == request.module.__name__:
            shared.cache_clear()


_TESTS = Path(__file__).parent


@pytest.hookimpl(tryfirst=True)
def pytest_collection(session: pytest.Session) -> None:
    """Import all test files, each worker from another one on: on a fresh clone each compiles another part of what all of them import,
    where otherwise each compiled everything. An import that fails is reported by the collection.
    """
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if workers == 1 or session.config.args_source is not pytest.Config.ArgsSource.TESTPATHS:
        return
    files = sorted(_TESTS.rglob("test_*.py"))
    first = len(files) * int(os.environ["PYTEST_XDIST_WORKER"].removeprefix("gw")) // workers
    for path in files[first:] + files[:first]:
        with contextlib.suppress(Exception, pytest.skip.Exception):
            importlib.import_module(".".join(path.relative_to(_TESTS.parent).with_suffix("").parts))


_LONG = ("project", "launcher", "flights", "sitl", "plugins", "gym", "core", "preflight", "commissioning", "recorder")
"""Folders whose files take longest, in the order in which they begin: whole flights, and the checks of all files."""


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is a coroutine in an event loop of its own, for at most `DEADLINE_S`."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}

    async def test() -> None:
        async with asyncio.timeout(DEADLINE_S):
            await pyfuncitem.obj(**arguments)

    asyncio.run(test())
    return True


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let one worker run the tests of a file, so that what they share is made once. Begin long files early, each beside a quick one: at
    the end no worker waits for another.
    """
    files: dict[Path, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    long = [of for folder in _LONG for path, of in files.items() if path.is_relative_to(_TESTS / folder)]
    quick = [of for of in files.values() if of not in long]
    nothing: list[pytest.Item] = []
    items[:] = [item for both in itertools.zip_longest(long, quick, fillvalue=nothing) for of in both for item in of]
    for item in items:
        fixtures = item._fixtureinfo.name2fixturedefs.values() if isinstance(item, pytest.Function) else ()
        if any(fixture.scope == "module" for (*_, fixture) in fixtures) and not item.get_closest_marker("xdist_group"):
            item.add_marker(pytest.mark.xdist_group(item.path.stem))
