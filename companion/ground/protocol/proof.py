"""Proofs that a vehicle adds to its messages for each operator whose key it holds: HMAC-SHA256 (RFC 2104), truncated to 128 bits.

The stream carries one proof per operator, an ack only the proof of the operator who sent the command. A ground station with a key
uses only proven messages to date its commands, so no other sender at the broker can make it sign a command for a future time.
"""

from __future__ import annotations

import hashlib
import hmac
import json
from collections.abc import Iterable
from dataclasses import dataclass, field

from msgspec.structs import replace

from companion.ground.protocol.messages import Ack, Stream
from companion.model.codec import to_jsonable

_STREAM_DOMAIN = "companion stream 2"
_ACK_DOMAIN = "companion ack 2"
"""First line of every proven text, which makes a proof invalid for anything else, and invalid as a command's signature."""
_PROOF_BYTES = 16


@dataclass(frozen=True, slots=True)
class Signer:
    """The operator who signs commands at this ground station."""

    operator: str
    key: bytes = field(repr=False)


def with_proofs(stream: Stream, vehicle: str, keys: Iterable[bytes]) -> Stream:
    """Return the stream message with one proof per key, in the order of the keys."""
    text = _text(_STREAM_DOMAIN, vehicle, replace(stream, proofs=()))
    return replace(stream, proofs=tuple(_proof(text, key) for key in keys))


def stream_proven(stream: Stream, vehicle: str, key: bytes) -> bool:
    """Whether one of the proofs was made with this key for this vehicle and exactly this message."""
    if not stream.proofs:
        return False
    wanted = _proof(_text(_STREAM_DOMAIN, vehicle, replace(stream, proofs=())), key)
    return wanted.encode() in [proof.encode(errors="replace") for proof in stream.proofs]


def with_proof(ack: Ack, vehicle: str, key: bytes) -> Ack:
    """Return the ack with the proof for the operator who holds this key."""
    return replace(ack, proof=_proof(_text(_ACK_DOMAIN, vehicle, replace(ack, proof="")), key))


def ack_proven(ack: Ack, vehicle: str, key: bytes) -> bool:
    """Whether the ack was made by a vehicle that holds this key."""
    return with_proof(ack, vehicle, key).proof == ack.proof


def _text(domain: str, vehicle: str, record: Stream | Ack) -> bytes:
    """Return the proven text: the protocol fixes its JSON form, that of `json.dumps`, whatever codec encodes the message."""
    message = json.dumps(to_jsonable(record), allow_nan=False, separators=(",", ":"))
    return f"{domain}\n{vehicle}\n{message}\n".encode()


def _proof(text: bytes, key: bytes) -> str:
    return hmac.digest(key, text, hashlib.sha256)[:_PROOF_BYTES].hex()
