"""Runs the client of a motion-capture system for the flight process and the guardian: no exception leaves it, and no invalid pose."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from typing import Final, TypeVar

from companion.io.mocap.system import ExtendedClient, MocapSettings, PoseClient, markers_problem, valid_poses
from companion.model.markers import MarkerFrame
from companion.model.team import BarPose
from companion.model.types import MocapPose
from companion.plugins import one_line
from companion.runtime.clock import Clock

_LOG: Final = logging.getLogger(__name__)
_T = TypeVar("_T")
_CALL_MAX_S: Final = 0.01
"""Longest permitted time of one call of the client."""


class ContainedClient:
    """A client whose calls never raise.

    An exception and an invalid pose are each counted as a malformed datagram, and the first exception is logged. A call that takes long
    is reported, unless the client names the sockets that it reads: then it has nothing to wait for, and the computer was busy.
    """

    def __init__(self, client: PoseClient, settings: MocapSettings, clock: Clock) -> None:
        self._client = client
        self._clock = clock
        self.extended = client if isinstance(client, ExtendedClient) else ExtendedClient()
        self.where = self.extended.where or f"mocap {settings.type} {settings.server}"
        self.extended.clock = clock
        self._markers: MarkerFrame | None = None
        self._rejected = 0
        self.problem: str | None = None
        """The newest problem: an exception, or why a pose or datagram was rejected; None if there was none."""
        self._failure_logged = False

    @property
    def server_name(self) -> str:
        """Return the server's program and protocol; empty before an `ExtendedClient` has an answer."""
        return str(self._client.server_name)

    @property
    def malformed(self) -> int:
        """Return the number of malformed datagrams, invalid poses and exceptions."""
        return self.extended.counts().malformed + self._rejected

    def keep_connected(self) -> None:
        """Send what the server needs to go on streaming; call every 10 to 50 ms."""
        self._call("keep_connected()", self._client.keep_connected, None)

    def poses(self) -> list[MocapPose]:
        """Return the valid poses that have arrived, in order."""
        return self._call("poses()", self._receive, [])

    def markers(self) -> MarkerFrame | None:
        """Return the valid single markers of the newest frame, or None; call it after `poses`."""
        return self._call("markers()", self._valid_markers, None)

    def bar(self) -> BarPose | None:
        """Return the bar's rigid body in the newest frame that had it, or None; call it after `poses`."""
        return self._call("bar()", lambda _: self.extended.bar(), None)

    def _valid_markers(self, now_s: float) -> MarkerFrame | None:
        frame = self.extended.markers()
        if frame is None or frame is self._markers:
            return self._markers
        problem = markers_problem(frame, self._clock())
        if problem is None:
            self._markers = frame
        else:
            self._rejected += 1
            self.problem = problem
        return self._markers

    def close(self) -> None:
        """Close the client."""
        with suppress(Exception):
            self._client.close()

    def _receive(self, now_s: float) -> list[MocapPose]:
        poses, rejected = valid_poses(self._client.poses(now_s), self._clock())
        self.problem = str(self._client.problem or "") or self.problem
        if rejected:
            self._rejected += len(rejected)
            self.problem = rejected[-1]
        return poses

    def _call(self, what: str, call: Callable[[float], _T], otherwise: _T) -> _T:
        """Call the client with the present time; return `otherwise` if it raises. Report an exception or a call that has waited."""
        now_s = self._clock()
        try:
            return call(now_s)
        except Exception as error:
            self._rejected += 1
            if not self._failure_logged:
                self._failure_logged = True
                _LOG.error("%s: the client failed; further failures are not logged", self.where, exc_info=error)
            self.problem = one_line(error)
            return otherwise
        finally:
            took_s = self._clock() - now_s
            if took_s > _CALL_MAX_S and self.problem is None and not self.extended.sockets:
                self.problem = (
                    f"{what} took {took_s * 1e3:.0f} ms, limit {_CALL_MAX_S * 1e3:g} ms; no call of a client may wait"
                )
