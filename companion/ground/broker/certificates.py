"""A private certificate authority, and the broker's certificate by which clients identify the broker."""

from __future__ import annotations

import datetime
import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

AUTHORITY_DAYS = 3650
_EARLY = datetime.timedelta(days=1)
"""Time by which a certificate's validity begins before it is issued: the clock of a computer without an RTC may be behind."""


class CertificateError(Exception):
    """A certificate or key cannot be used. The exception's text is one line."""


@dataclass(frozen=True, slots=True, repr=False)
class Pair:
    """A certificate and its private key, both PEM."""

    certificate: bytes
    key: bytes


def make_authority(now: datetime.datetime) -> Pair:
    """Return a new authority, ECDSA P-256, valid for `AUTHORITY_DAYS`.

    Args:
        now: current time with time zone.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name("companion broker authority")
    builder = (
        _builder(name, name, key, now, now + datetime.timedelta(days=AUTHORITY_DAYS))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs_certificates=True), critical=True)
    )
    return _pair(builder.sign(key, hashes.SHA256()), key)


def make_server(authority: Pair, hosts: Sequence[str], days: int, now: datetime.datetime) -> Pair:
    """Return a certificate for the broker, with a new key, signed by the authority.

    Args:
        days: validity, at most that of the authority.
        now: current time with time zone.

    Raises:
        CertificateError: the authority is invalid, its key does not match, or it expires before the new certificate would.
    """
    issuer, signer = _opened(authority)
    until = now + datetime.timedelta(days=days)
    if until > issuer.not_valid_after_utc:
        ends = f"{issuer.not_valid_after_utc:%Y-%m-%d}"
        raise CertificateError(
            f"the authority expires on {ends}, in less than {days} days; create a new folder, or choose fewer days"
        )
    key = ec.generate_private_key(ec.SECP256R1())
    builder = (
        _builder(_name("companion broker"), issuer.subject, key, now, until)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .add_extension(x509.SubjectAlternativeName([_general_name(host) for host in hosts]), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False)
    )
    return _pair(builder.sign(signer, hashes.SHA256()), key)


def certificate_hosts(certificate: bytes) -> list[str]:
    """Return the names and addresses in a certificate (PEM).

    Raises:
        CertificateError: `certificate` is not a certificate with host names.
    """
    try:
        parsed = x509.load_pem_x509_certificate(certificate)
        names = parsed.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (ValueError, x509.ExtensionNotFound):
        raise CertificateError("expected a certificate (PEM) with host names") from None
    addresses = [str(address) for address in names.get_values_for_type(x509.IPAddress)]
    return [*names.get_values_for_type(x509.DNSName), *addresses]


def expiry_date(certificate: bytes) -> datetime.date:
    """Return the last valid day of a certificate (PEM)."""
    return x509.load_pem_x509_certificate(certificate).not_valid_after_utc.date()


def _opened(authority: Pair) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    try:
        issuer = x509.load_pem_x509_certificate(authority.certificate)
        signer = serialization.load_pem_private_key(authority.key, password=None)
    except (ValueError, TypeError):
        raise CertificateError("expected a certificate and a key in PEM form") from None
    if not isinstance(signer, ec.EllipticCurvePrivateKey) or signer.public_key() != issuer.public_key():
        raise CertificateError("the key does not belong to the certificate")
    return issuer, signer


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    now: datetime.datetime,
    until: datetime.datetime,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _EARLY)
        .not_valid_after(until)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _pair(certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> Pair:
    pem = serialization.Encoding.PEM
    private = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    return Pair(certificate.public_bytes(pem), private)
