"""`companion monitor`: watch and command vehicles from the ground, in a browser or in a terminal; or view flight logs."""

from __future__ import annotations

import argparse
import asyncio
import signal
import ssl
import sys
import threading
import webbrowser
from collections.abc import Coroutine, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion import DISTRIBUTION
from companion.analysis.log import LogError
from companion.config.document import ConfigError
from companion.config.ground import VEHICLE_NAME, Mqtt
from companion.ground.protocol.access import BrokerAccess, broker_access
from companion.ground.protocol.proof import Signer
from companion.ground.station.command_sender import signer_of
from companion.ground.station.link import BrokerRefused
from companion.model.exit_codes import EXIT_OK, EXIT_REFUSED
from companion.runtime.console import print_error
from companion.runtime.tasks import until_first

if TYPE_CHECKING:
    from companion.ground.station.replay_log import ReplayLog

PORT = 8642


def add_parser(commands: Any) -> None:
    monitor = commands.add_parser(
        "monitor",
        help="watch and command from the ground: a page in the browser, or --text in the terminal",
        description="Serve a page that shows the vehicles' telemetry over MQTT and accepts commands; with LOG, "
        "a page that replays logs.",
    )
    monitor.add_argument("logs", nargs="*", type=Path, metavar="LOG", help="flight.mcap to view; needs no broker")
    add_broker_options(monitor)
    monitor.add_argument("--view-only", action="store_true", help="do not allow commands from this monitor")
    monitor.add_argument("--text", action="store_true", help="show the vehicle in this terminal instead of a page")
    monitor.add_argument("--port", type=int, default=PORT, help="port of the page (default: %(default)s; 0: any)")
    monitor.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="address on which the page is served (default: %(default)s)",
    )
    monitor.add_argument("--cert", metavar="FILE", help="certificate (PEM) to serve the page with TLS")
    monitor.add_argument("--key", metavar="FILE", help="private key of --cert (PEM)")
    monitor.add_argument("--open", action="store_true", help="open the page in this user's browser")
    monitor.set_defaults(run=run)


def add_broker_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for broker and operator that all ground commands share."""
    parser.add_argument(
        "--broker", metavar="URL", default=Mqtt().url, help="mqtt[s]://HOST:PORT (default: %(default)s)"
    )
    parser.add_argument("--login", metavar="FILE", help="YAML file with username and password")
    parser.add_argument("--ca", metavar="FILE", help="CA certificates (PEM) to verify the broker's certificate")
    parser.add_argument(
        "--operator", metavar="NAME", help="operator who signs commands (default: the only one in the file)"
    )
    parser.add_argument("--operators", metavar="FILE", help="file of operator keys (default: this user's own)")
    parser.add_argument("--vehicle", metavar="NAME", help="use only this vehicle")


def vehicle_option(arguments: argparse.Namespace) -> str | None:
    """Return the vehicle's name.

    Raises:
        ConfigError: the name is invalid.
    """
    name: str | None = arguments.vehicle
    if name is not None and VEHICLE_NAME.fullmatch(name) is None:
        raise ConfigError(
            f"--vehicle {name!r:.60}: expected a vehicle name as used in topics: letters, digits, '_', '-' or '.'"
        )
    return name


def run(arguments: argparse.Namespace) -> int:
    _check(arguments)
    try:
        if arguments.text:
            from companion.ground.station.text_monitor import watch_in_terminal

            asyncio.run(until_signal(watch_in_terminal(*_station_settings(arguments))))
        else:
            _serve(arguments)
    except (_Refusal, BrokerRefused) as error:
        print_error(f"companion monitor: {error}")
        return EXIT_REFUSED
    return EXIT_OK


class _Refusal(Exception):
    """A required package, port or file is not available. The text is one line for the user."""


async def until_signal(work: Coroutine[Any, Any, Any]) -> None:
    """Run a coroutine until SIGINT, SIGTERM or SIGHUP, then cancel it."""
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, stop.set)
    await until_first(work, stop.wait())


def _check(arguments: argparse.Namespace) -> None:
    """Check that the options are in range and compatible; raises ConfigError, one line."""
    if arguments.text and arguments.logs:
        raise ConfigError(
            "companion monitor: --text shows only live flights; to view logs, leave out --text or use companion report"
        )
    if not 0 <= arguments.port <= 65535:
        raise ConfigError(f"companion monitor: --port {arguments.port}: expected 0 to 65535")
    if (arguments.cert is None) != (arguments.key is None):
        raise ConfigError("companion monitor: --cert and --key must be given together")


def _station_settings(arguments: argparse.Namespace) -> tuple[BrokerAccess, Signer | str, str | None]:
    only = vehicle_option(arguments)
    access = broker_access(arguments.broker, arguments.login, arguments.ca)
    return access, signer_of(access, arguments.operators, arguments.operator, view_only=arguments.view_only), only


def _serve(arguments: argparse.Namespace) -> None:
    try:
        from companion.ground.station import web
    except ModuleNotFoundError as error:
        if error.name != "aiohttp":
            raise
        raise _Refusal(
            f"the page needs aiohttp: pip install '{DISTRIBUTION}[ground]'; --text works without it"
        ) from None
    serving = web.ServerSettings(arguments.host, arguments.port, _tls(arguments.cert, arguments.key))

    def listening(monitor: web.Monitor) -> None:
        print(f"companion monitor: {monitor.url}  (Ctrl-C ends)", flush=True)
        if monitor.view_only_reason is not None and not arguments.logs:
            print(f"companion monitor: view only: {monitor.view_only_reason}", flush=True)
        if arguments.open:
            threading.Thread(
                target=_open, args=(monitor.url,), daemon=True
            ).start()  # text browsers stay in the terminal

    try:
        if arguments.logs:
            work = web.serve_logs(serving, _read(arguments.logs), listening)
        else:
            work = web.serve_live(serving, *_station_settings(arguments), listening)
        asyncio.run(until_signal(work))
    except web.WebError as error:
        raise _Refusal(str(error)) from None
    except LogError as error:
        raise ConfigError(str(error)) from None


def _read(paths: Sequence[Path]) -> list[ReplayLog]:
    """Read the logs before the page is served. An hour of log takes one to two minutes to read; Ctrl-C cancels the reading."""
    from companion.ground.station.replay_log import read_for_page

    logs = []
    for number, path in enumerate(paths):
        if sys.stderr.isatty():
            print_error(f"companion monitor: reading {path} ...")
        logs.append(read_for_page(path, number))
    return logs


def _open(url: str) -> None:
    if not webbrowser.open(url):
        print_error("companion monitor: --open: no browser found; open the address above")


def _tls(cert: str | None, key: str | None) -> ssl.SSLContext | None:
    if cert is None or key is None:
        return None
    for option, file in (("--cert", cert), ("--key", key)):
        try:
            Path(file).read_bytes()
        except OSError as error:
            raise ConfigError(f"companion monitor: {option} {file}: cannot be read: {error.strerror}") from None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(cert, key, password=_no_password)
    except (ssl.SSLError, ValueError) as error:
        raise ConfigError(
            f"companion monitor: --cert {cert}, --key {key}: expected a certificate and its private key without password, "
            f"both PEM: {error}"
        ) from None
    return context


def _no_password() -> str:
    raise ValueError("the key has a password")
