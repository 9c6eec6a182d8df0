"""The code of motion-capture systems of another package, for tests: most of them fail."""

from __future__ import annotations

FAILING = '''
import socket
from companion.config.base import Model
from companion.io.mocap.system import ExtendedClient
from companion.model.markers import Marker, MarkerFrame
from companion.model.types import MocapPose
class Options(Model):
    """Fails."""
class Failing:
    options, server_name, problem = Options, "Failing 1.0", None
    def __init__(self, settings): pass
    def keep_connected(self, now_s): raise OSError("network\\nis down")
    def poses(self, now_s): raise RuntimeError("no pose")
    def close(self): raise RuntimeError("no close")
class Absent(Failing):
    def __init__(self, settings): raise OSError("no licence")
class NoOptions(Failing):
    options = None
class Nonsense(Failing):
    def keep_connected(self, now_s): pass
    def poses(self, now_s): return ["a pose"]
class Nameless(Failing):
    closed = 0
    @property
    def server_name(self): raise ValueError("no name")
    def close(self): Nameless.closed += 1
class NoProblem(Failing):
    def keep_connected(self, now_s): pass
    def poses(self, now_s): return []
    @property
    def problem(self): raise ValueError("not connected")
class Scripted(Failing):
    number = 0
    def __init__(self, settings):
        self.given = {"stamped_after_now_s": 0.0, "x_m": 0.0, "w": 1.0, "tracking_valid": True}
        for key, value in settings.options.items():
            self.given[key] = float(value) if isinstance(value, str) else value  # settings have no NaN
    def keep_connected(self, now_s): pass
    def close(self): pass
    def poses(self, now_s):
        self.number += 1
        return [MocapPose(
            stamp_s=now_s + self.given["stamped_after_now_s"], frame_number=self.number,
            position_world_m=(self.given["x_m"], 0.0, 1.0), attitude_wxyz=(self.given["w"], 0.0, 0.0, 0.0),
            tracking_valid=self.given["tracking_valid"], marker_error_m=0.0)]
class WithMarkers(Scripted, ExtendedClient):
    """Sees the markers that its options give."""
    sees_markers = True
    def markers(self):
        at = tuple(float(value) for value in self.given["at"])
        count, late_s = int(self.given.get("count", 1)), self.given.get("late_s", 0.0)
        stamp_s = self.clock() + late_s
        markers = (Marker(position_world_m=at),) * count if count else "none"
        return MarkerFrame(stamp_s=stamp_s, exposed_s=stamp_s, frame_number=self.number, markers=markers)
class Stuck(Scripted):
    """Repeats its frame number."""
    def poses(self, now_s):
        self.number = 6
        return super().poses(now_s)
class Reconnecting(Scripted):
    """Replaces its socket whenever it is called, and raises now and then."""
    def __init__(self, settings):
        super().__init__(settings)
        self.sockets = ()
        self.connect()
    def connect(self):
        before, pair = self.sockets, socket.socketpair()
        pair[1].send(b"unread")
        self.sockets = pair[:1]
        self.peer = pair[1]
        for old in before:
            old.close()
    def keep_connected(self, now_s): self.reconnect()
    def poses(self, now_s):
        self.reconnect()
        if self.number % 3 == 1:
            self.number += 1
            raise OSError("connection reset")
        return super().poses(now_s)
    def reconnect(self):
        peer = self.peer
        self.connect()
        peer.close()
    def close(self):
        self.sockets[0].close()
        self.peer.close()
'''
