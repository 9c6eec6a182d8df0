"""Explanations on the page of results: what each table measures."""

from __future__ import annotations


def _paragraphs(text: str) -> tuple[str, ...]:
    return tuple(" ".join(part.split()) for part in text.strip().split("\n\n"))


TICKS = _paragraphs("""
Hover over real wires in the simulated world, with guardian, recorder, broker, monitor and a viewer on this computer. Two empty
loops ran at the same time, each in its own process: the same ticker, rate and priority, without work. The empty asyncio loop is
plain `asyncio.run`, which waits in epoll, in whole milliseconds. The other one uses the flight's event loop, which waits in select;
it is the lower bound for the flight.

Lateness is the time from the due time of a tick to its start. In flight, ticks follow the frames of motion capture: there it
counts from the time at which the kernel received the frame.
""")

LATE = _paragraphs("""
A stall of the whole computer meets the two loops at different points of their periods. So a tick of the flight that is later than
two periods counts only if no tick of the empty loop within 0.1 s was later than one.
""")

SETPOINT = _paragraphs("""
From the arrival of a motion-capture datagram (kernel time stamp) to the return of the call that sends SET_ATTITUDE_TARGET, at
200 Hz. For the flight this includes joints, mission, governor, law, supervisor and gate. The bare loops only receive and send,
each in its own process with the flight's priority, against a process that sends the datagrams and receives the setpoints. One of
them ran during the hover; the others ran one after the other without a flight.

Wire to wire is on the clock of the process at the other end: datagram sent to SET_ATTITUDE_TARGET received. The flight has no such
figure, because its other end is the unmodified simulated world. Native MAVSDK sends from its own thread; the difference of the
driver's two rows is what that adds. pymavlink echo packs and sends without a link: the lower bound.
""")

BUS = _paragraphs("""
From the start of the joint read to the end of writing the currents computed from it: two servos at 3 Mbaud on an emulated bus (a
pseudo-terminal with answers delayed by their time on the wire). The bare cycle is a sync read and a sync write of dynamixel-sdk at
200 Hz with nothing between them and no flight; once on the simulated world's bus, which the flight uses, and once on a bus with
its own process.
""")

CORE = _paragraphs("""
The core's whole tick (mission, governor, controller, supervisor, gate) on the recorded inputs of the catch mission, flown in the
fast closed loop; wall time of each step. Raw MuJoCo: `mj_step` of the same model, as many steps as in one tick, in batches; CPU
time, median of repeats, as for the law and the whole tick. In flight the core runs once in 5 ms, after other code that uses the
caches, and its row includes collecting the inputs from the drivers.
""")

PI = _paragraphs("""
Nothing was measured on a Raspberry Pi. The CPU time of the flight's threads here, during the hover above, is multiplied by how much
slower the Pi runs other programs: nine programs of pyperformance in pure Python, run here with the Python of the flight, beside their
published times on a Pi 5; for the Pi 4 also the published times of 25 C++ programs on both. The estimate takes the geometric mean; from
and to are two standard deviations of the programs away, which holds 19 programs of 20. Sources: `benchmarks/measuring/pi.py`.

This was preferred to counting instructions, because no measured instructions per cycle of CPython on these cores were found. Time in
the kernel and in native code is multiplied by the same factor. Drivers of USB serial ports and of the card are not included. The
check applies the same factors to a program whose time on a Pi 4 is published.
""")

COST = _paragraphs("""
During the same hover, from the kernel's accounting, once a second. % of one core.
""")
