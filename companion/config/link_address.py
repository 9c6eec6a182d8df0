"""Types of the addresses in the vehicle file, judged when it is loaded: of the link to PX4, and of networks."""

from __future__ import annotations

import ipaddress
from typing import Annotated

from pydantic import AfterValidator

from companion.model.link_address import parse_address


def _of_px4(address: str) -> str:
    parse_address(address)
    return address


def _ipv4(address: str) -> str:
    try:
        return str(ipaddress.IPv4Address(address))
    except ValueError:
        raise ValueError(f"expected an IPv4 address such as 192.168.1.20, got {address!r:.60}") from None


def _multicast(address: str) -> str:
    if not ipaddress.IPv4Address(_ipv4(address)).is_multicast:
        raise ValueError(f"expected a multicast group, from 224.0.0.0 to 239.255.255.255, got {address}")
    return address


Px4Address = Annotated[str, AfterValidator(_of_px4)]
Ipv4Address = Annotated[str, AfterValidator(_ipv4)]
MulticastGroup = Annotated[str, AfterValidator(_multicast)]
