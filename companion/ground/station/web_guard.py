"""Access control of the monitor's web server. Pure; no data from a browser is trusted.

Listening only on loopback does not protect the server: any web page in the user's browser can reach http://127.0.0.1, through its
own host name (DNS rebinding) or across origins (WebSockets have no same-origin policy). So the Host header must name this computer,
the Origin of a WebSocket must be this server, and commands need a token that only the user who started the monitor has seen.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
import socket
from urllib.parse import urlsplit

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
MESSAGE_MAX_BYTES = 1024
MESSAGES_PER_S, MESSAGES_BURST = 10.0, 20
_HOST = re.compile(r"(?P<name>\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(:\d{1,5})?")


def new_token() -> str:
    """Return a new token: 128 random bits as text."""
    return secrets.token_urlsafe(16)


def same_token(given: object, token: str) -> bool:
    """Return whether the given value equals the token; the comparison takes constant time."""
    return isinstance(given, str) and hmac.compare_digest(given.encode("utf-8", "replace"), token.encode())


def is_loopback(host: str) -> bool:
    """Return whether only this computer can reach the name or address."""
    if host.lower() == "localhost":
        return True
    address = _address(host)
    return address is not None and address.is_loopback


def host_allowed(host_header: str | None, listens_on: str) -> bool:
    """Return whether a Host header names this server; a loopback name or address always does.

    Args:
        listens_on: value of --host. With 0.0.0.0 or ::, any IP address and this computer's own name are also allowed. This still stops
            DNS rebinding, because the browser then sends the host name of the attacker's page.
    """
    match = None if host_header is None else _HOST.fullmatch(host_header)
    if match is None:
        return False
    name = match["name"].strip("[]").lower()
    if is_loopback(name) or name == listens_on.lower():
        return True
    everywhere = _address(listens_on)
    if everywhere is None or not everywhere.is_unspecified:
        return False
    return _address(name) is not None or name in {socket.gethostname().lower(), socket.getfqdn().lower()}


def origin_allowed(origin: str | None, host_header: str | None, *, tls: bool) -> bool:
    """Return whether a WebSocket request comes from a page of this server. Programs other than browsers must send the same header."""
    if origin is None or host_header is None:
        return False
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    return (parts.scheme, parts.netloc.lower()) == ("https" if tls else "http", host_header.lower())


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None
