"""An authority of one's own, and certificates by it, for a laboratory or a small installation. It needs the package
`cryptography`, which comes with the extra `keys`; who only uses certificates does not.

Elliptic-curve keys (P-256), X.509 version 3. A party's certificate serves to connect, not to listen; the hub's to
listen, at the names that are in it.
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

__all__ = ["Authority", "expiry", "hosts_of", "make_authority", "open_authority", "write_private"]

_SKEW = timedelta(hours=1)
"""Certificates hold from so long before they are made: clocks differ."""


class Authority(NamedTuple):
    """Who vouches for certificates."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    def issue(
        self,
        certificate: Path,
        key: Path,
        common_name: str,
        *,
        hosts: Sequence[str] = (),
        days: float = 365.0,
        now: datetime | None = None,
    ) -> None:
        """Write a new key and its certificate; hosts: of a hub, the names and addresses that it is reached by. It ends
        with the authority's own at the latest."""
        now = now or datetime.now(UTC)
        private = ec.generate_private_key(ec.SECP256R1())
        usage = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] * bool(hosts))]
        builder = (
            _builder(common_name, self.certificate.subject, private.public_key(), now, days, self.certificate)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs=True), critical=True)
            .add_extension(x509.ExtendedKeyUsage(usage), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key()), critical=False)
        )
        # a name beside the common one is what TLS libraries ask for, of clients too
        names = [_host(host) for host in hosts] or [x509.UniformResourceIdentifier(f"urn:fusion:{common_name}")]
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
        write_private(key, _pem(private))
        certificate.write_bytes(builder.sign(self.key, hashes.SHA256()).public_bytes(Encoding.PEM))


def make_authority(certificate: Path, key: Path, name: str, days: float = 3650.0) -> Authority:
    """Write a new authority's key and its certificate, which vouches for itself."""
    private = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    signed = (
        _builder(name, subject, private.public_key(), datetime.now(UTC), days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs=False), critical=True)
        .sign(private, hashes.SHA256())
    )
    write_private(key, _pem(private))
    certificate.write_bytes(signed.public_bytes(Encoding.PEM))
    return Authority(signed, private)


def open_authority(certificate: Path, key: Path) -> Authority:
    """The authority of these files. Raises ValueError if they are not one, OSError."""
    private = load_pem_private_key(key.read_bytes(), None)
    authority = x509.load_pem_x509_certificate(certificate.read_bytes())
    if not isinstance(private, ec.EllipticCurvePrivateKey) or private.public_key() != authority.public_key():
        raise ValueError(f"{key} is not the key of {certificate}")
    return Authority(authority, private)


def expiry(certificate: Path) -> tuple[str, datetime]:
    """Common name and end of a certificate. Raises ValueError if it is none, OSError."""
    found = x509.load_pem_x509_certificate(certificate.read_bytes())
    names = found.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else "?", found.not_valid_after_utc


def hosts_of(certificate: Path) -> list[str]:
    """The names and addresses in a hub's certificate. Raises ValueError if it is none, OSError."""
    found = x509.load_pem_x509_certificate(certificate.read_bytes())
    try:
        names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return []
    return [str(name.value) for name in names if isinstance(name, x509.DNSName | x509.IPAddress)]


def write_private(path: Path, data: bytes) -> None:
    """Write a new file that only its owner may read, replacing one that is there."""
    path.unlink(missing_ok=True)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(data)


def _builder(
    common_name: str,
    issuer: x509.Name,
    public: ec.EllipticCurvePublicKey,
    now: datetime,
    days: float,
    authority: x509.Certificate | None = None,
) -> x509.CertificateBuilder:
    end = now + timedelta(days=days)
    return (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)]))
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(now, end) - _SKEW)
        .not_valid_after(min(end, authority.not_valid_after_utc) if authority else end)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
    )


def _usage(*, signs: bool) -> x509.KeyUsage:
    """signs: a party's, which signs the opening of a link; else an authority's, which signs certificates."""
    rest = dict.fromkeys(
        ("content_commitment", "key_encipherment", "data_encipherment", "key_agreement", "encipher_only"), False
    )
    return x509.KeyUsage(
        digital_signature=signs, key_cert_sign=not signs, crl_sign=not signs, decipher_only=False, **rest
    )


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
