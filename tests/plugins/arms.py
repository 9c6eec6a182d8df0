"""Arms of other packages, for tests: scripted ones, by class name, and ODrives at the other end of a CAN interface."""

from __future__ import annotations

import socket
import struct
import threading
import time

SCRIPTED = '''
import math, time
from companion.config.base import Model
from companion.io.arm.motors import MotorState

class Options(Model):
    """For tests."""
    after: int = 10**9
    angles: list[float] = [0.5, -0.25]

class Steady:
    options, product_name, watchdog, watchdog_ms = Options, "Steady 1.0", "a relay", 100
    made = []
    def __init__(self, options, device, joints):
        self.left, self.angles, self.calls, self.written = options.after, options.angles, [], []
        Steady.made.append(self)
    def open(self): self.calls.append("open")
    def read(self):
        self.left -= 1
        return self.later() if self.left < 0 else self.states()
    def states(self): return [MotorState(angle, 2.0, 0.75, 40.0) for angle in self.angles]
    later = states
    def write_torque(self, torque_nm): self.written.append(tuple(torque_nm))
    def torque_off(self): self.calls.append("torque_off")
    def close(self): self.calls.append("close")
class Raising(Steady):
    def later(self): raise OSError("bus off\\nsince today")
class Unwritable(Steady):
    def write_torque(self, torque_nm):
        self.left -= 1
        if self.left < 0: raise OSError("buffer full")
class Nan(Steady):
    def later(self): return [MotorState(0.5, math.nan, 0.0), MotorState(0.0, 0.0, 0.0)]
class Short(Steady):
    def later(self): return self.states()[:1]
class Wrong(Steady):
    def later(self): return (0.5, -0.25)
class Slow(Steady):
    def read(self):
        time.sleep(0.006)
        return self.states()
class Faulty(Steady):
    def later(self): return [MotorState(0.5, 0.0, 0.0, None, "over\\ncurrent"), MotorState(-0.25, 0.0, 0.0)]
class Unwatched(Steady):
    watchdog = " "
class Patient(Steady):
    watchdog_ms = 101.0
class Timeless(Steady):
    watchdog_ms = math.nan
class Absent(Steady):
    def open(self): raise ConnectionError("no motor\\nanswers")
class Unmade(Steady):
    def __init__(self, options): pass
class NoOff:
    options, product_name, watchdog = Options, "Half 1.0", "none"
    open = read = write_torque = close = lambda self: None
class NoOptions(Steady):
    options = None
class Stays(Steady):
    def close(self): time.sleep(3.0)
'''
NAMES = ("Steady", "Raising", "Unwritable", "Nan", "Short", "Wrong", "Slow", "Faulty", "Unwatched", "Patient", "Timeless", "Absent",
         "Unmade", "NoOff", "NoOptions", "Stays")  # fmt: skip


class ODrives:
    """ODrives with some node ids at the other end of a CAN interface; each shaft follows its torque without inertia."""

    def __init__(self, *nodes: int) -> None:
        self.torques_nm = dict.fromkeys(nodes, 0.0)
        self.states = dict.fromkeys(nodes, 1)
        self.errors = dict.fromkeys(nodes, 0)
        self.silent = False
        self.answers = 0
        """Number of answers sent."""
        self.go_on = threading.Event()
        """Requests are not answered while it is clear."""
        self.go_on.set()
        self.ours, self._theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> ODrives:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._theirs.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._theirs.close()
        self.ours.close()

    def _run(self) -> None:
        frame = struct.Struct("<IB3x8s")
        beat_s = 0.0
        while received := self._theirs.recv(64):
            if time.monotonic() >= beat_s and not self.silent:
                beat_s = time.monotonic() + 0.01
                for number, state in self.states.items():
                    self._theirs.send(frame.pack(number << 5 | 0x01, 8, struct.pack("<IB3x", 0, state)))
            identity, size, data = frame.unpack(received)
            node, command = (identity & 0x7FF) >> 5, identity & 0x1F
            if node not in self.torques_nm or self.silent:
                continue
            if not identity & 0x40000000:
                if command == 0x0E:
                    assert size == 4
                    self.torques_nm[node] = struct.unpack("<f", data[:4])[0]
                if command == 0x07:
                    self.states[node] = struct.unpack("<I", data[:4])[0]
                continue
            answer = {
                0x00: bytes((2, 4, 4, 58, 0, 6, 10, 0)),
                0x03: struct.pack("<II", self.errors[node], 0),
                0x09: struct.pack("<ff", 0.25 * node, 0.5),
                0x15: struct.pack("<ff", 35.0, 42.0),
                0x1C: struct.pack("<ff", 0.0, self.torques_nm[node]),
            }[command]
            self.go_on.wait()
            self._theirs.send(frame.pack(identity & 0x7FF, 8, answer))
            self.answers += 1
