"""`companion monitor` with the page: what is served, put together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from companion.ground.access import BrokerAccess
from companion.ground.proof import Signer
from companion.ground.station.hub import Hub
from companion.ground.station.replayed import Replayed
from companion.ground.station.station import Station
from companion.ground.station.tasks import until_first
from companion.ground.station.web import Monitor, Serving, WebError

__all__ = ["Listening", "Monitor", "Serving", "WebError", "serve_live", "serve_logs"]

Listening = Callable[[Monitor], None]
"""Called once, when the page can be opened."""


async def serve_live(
    serving: Serving, access: BrokerAccess, signer: Signer | str, only: str | None, listening: Listening
) -> None:
    """Serve what vehicles send, until cancelled.

    Raises:
        WebError: cannot listen.
        BrokerRefused: the broker does not want us.
    """
    hub: Hub
    station = Station(
        access, signer, only, lambda heard: hub.relay(heard), lambda connected, text: hub.broker(connected, text)
    )
    hub = Hub(station.watch, station.link.text)
    monitor = Monitor(serving, hub, station.orders)
    await until_first(monitor.serve(lambda: listening(monitor)), station.run())


async def serve_logs(serving: Serving, logs: Sequence[Replayed], listening: Listening) -> None:
    """Serve logs, until cancelled.

    Raises:
        WebError: cannot listen.
    """
    monitor = Monitor(serving, None, None, logs)
    await monitor.serve(lambda: listening(monitor))
