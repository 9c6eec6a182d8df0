"""The estimate for a Raspberry Pi: its arithmetic against numbers worked by hand."""

from __future__ import annotations

import math
import os
import threading

import pytest

from benchmarks.measuring.figures import MET, NOT_MET
from benchmarks.measuring.hover import of_threads
from benchmarks.measuring.pi import PI4_PER_PI5, PI5_S, slower
from benchmarks.measuring.rows import sections
from benchmarks.soaking.processes import threads
from companion.runtime.native_threads import name_thread


def test_each_pi_beside_a_computer_as_fast_as_a_pi_5() -> None:
    found = slower(PI5_S)
    assert (found["Pi 5, 2.4 GHz"].low, found["Pi 5, 2.4 GHz"].high) == pytest.approx((1.0, 1.0))
    geometric = math.exp(sum(map(math.log, PI4_PER_PI5)) / len(PI4_PER_PI5))
    assert 2.15 < geometric < 2.16, "worked from the published table"
    assert found["Pi 4, 1.8 GHz"].mean == pytest.approx(geometric)
    assert found["Pi 4, 1.5 GHz"].mean == pytest.approx(geometric * 1.2)


def test_cpu_time_of_threads_between_two_samples() -> None:
    rows = [
        (10.0, {"main": (1.0, 0.5)}),
        (12.0, {"main": (9.0, 9.0)}),
        (14.0, {"main": (2.0, 0.7), "arm-bus": (0.4, 0.0)}),
    ]
    found = of_threads(rows)
    assert found == {
        "main": {"user": pytest.approx(25.0), "system": pytest.approx(5.0)},
        "arm-bus": {"user": pytest.approx(10.0), "system": 0.0},
    }
    assert of_threads(rows[:1]) is None


def test_the_table_of_a_flight() -> None:
    """10 % of a core here is 20 % on a Pi 5 that is twice as slow; a main thread with 10 % takes 0.5 ms of every 5 ms, there 1 ms."""
    here_s = {name: time_s / 2.0 for name, time_s in PI5_S.items()}
    by_thread = {"main": {"user": 8.0, "system": 2.0}, "native": {"user": 4.0, "system": 1.0}}
    table = sections({"pi": {"here_s": here_s}, "hover": {"threads": by_thread}})[-1]
    rows = {row.what: row for row in table.rows}
    whole, tick = (
        rows["Pi 5, 2.4 GHz: flight process, % of a core"],
        rows["Pi 5, 2.4 GHz: main thread's CPU time in a tick, ms"],
    )
    assert whole.figures == pytest.approx({"estimate": 30.0, "from": 30.0, "to": 30.0})
    assert (whole.beside_figures, whole.verdict) == ({"estimate": 15.0}, MET)
    assert rows["Pi 5, 2.4 GHz: its native threads (MAVSDK), %"].figures["estimate"] == pytest.approx(10.0)
    assert tick.figures["estimate"] == pytest.approx(1.0)
    assert tick.verdict == NOT_MET
    wide = rows["Pi 4, 1.8 GHz: flight process, % of a core"].figures
    assert wide["from"] < wide["estimate"] / 1.3 and wide["to"] > wide["estimate"] * 1.3


def test_threads_of_a_process_are_named() -> None:
    named, end = threading.Event(), threading.Event()

    def run() -> None:
        name_thread("arm-bus-with-a-long-name")
        named.set()
        end.wait()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        named.wait()
        found = threads(os.getpid())
    finally:
        end.set()
        thread.join()
    assert {"main", "arm-bus-with-a-"} <= set(found)
    assert all(user_s >= 0.0 and system_s >= 0.0 for user_s, system_s in found.values())
    assert threads(2**22 + 1) == {}
