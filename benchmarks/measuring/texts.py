"""What the page says of how things were measured."""

from __future__ import annotations


def _paragraphs(text: str) -> tuple[str, ...]:
    return tuple(" ".join(part.split()) for part in text.strip().split("\n\n"))


TICKS = _paragraphs("""
Hover over real wires in the simulated world, with guardian, recorder, a broker, and the monitor with a viewer, all on this
computer. Two empty loops ran for the same minutes, each in a process of its own: the same ticker, rate and priority, and nothing to
do. The empty asyncio loop is what `asyncio.run` gives anybody: it waits in epoll, in whole milliseconds. The other one has the
flight's own event loop, which waits in select; that one the flight cannot beat, it is what a flight is with nothing in it.

A tick is late by what it begins after the moment that it was due at. Ticks of the flight ride on the frames of motion
capture: there it is the moment at which the kernel received the frame.
""")

LATE = _paragraphs("""
A moment at which the whole computer stands still meets the two loops at different places of their periods. So a tick of the
flight that is later than two periods counts as its own only if no tick of the empty loop within 0.1 s was later than one.
""")

SETPOINT = _paragraphs("""
From the arrival of a motion-capture datagram (the kernel's time stamp) to the return of the call that sends
SET_ATTITUDE_TARGET, at 200 Hz. Of the flight all that lies between counts: joints, mission, governor, law, supervisor, gate.
The bare loops only receive and send, each in a process of its own with the flight's priority, against a process that sends the
datagrams and takes the setpoints. One of them ran during the hover, on the same computer; the others ran one after the other
without a flight.

Wire to wire is by the clock of the process at the other end: datagram sent to SET_ATTITUDE_TARGET received. Over gRPC (MAVSDK
3, its server at the same priority) the call returns before the setpoint leaves, so what counts against the flight is wire to
wire. Of the flight itself there is no such figure: its other end is the simulated world, which is left as it is. Native MAVSDK
sends by a thread of its own; what that adds is what the edge's two rows differ by. pymavlink echo: packed and sent by hand, no
link behind it; the floor.
""")

BUS = _paragraphs("""
From the moment that the joint read is begun to the currents, computed from it, being written: two servos at 3 Mbaud on an
emulated bus (a pseudo-terminal, answers held back for their time on the wire). The bare cycle is a sync read and a sync write
of dynamixel-sdk at 200 Hz with nothing between them, and no flight beside it; once on the simulated world's bus, which a flight
meets, and once on a bus with a process of its own.
""")

CORE = _paragraphs("""
The core's whole tick (mission, governor, controller, supervisor, gate) on the recorded inputs of the catch mission, flown in
the fast closed loop; every step by itself, by the wall clock. Raw MuJoCo: `mj_step` of the same model, as many as one tick
takes, in batches; CPU time, a median of repeats, and so are the law and the whole tick. In the flight the core runs once in 5
ms, after everything else that uses the caches.
""")

COST = _paragraphs("""
Of the same hover, from the kernel's books, once a second. % of one core.
""")
