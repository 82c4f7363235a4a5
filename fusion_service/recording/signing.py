"""Signatures of seals: by whom, and whether an authority vouches for them.

A recorder signs by the key of its certificate (`fusion-service keys`), or by a key alone. The certificate, or the
public key, stands in the recording as PEM text, which is called the identity here. Keys: Ed25519, elliptic curves, RSA.
It needs the package `cryptography` (extra `keys`), imported when first needed.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fusion_service.bus.roles import ROLES
from fusion_service.bus.security import HUB, check_private
from fusion_service.errors import UsageError
from fusion_service.escape import escaped
from fusion_service.extras import install_hint
from fusion_service.recording.chain import signed_bytes

__all__ = ["Authority", "Identity", "Signer", "fingerprint", "import_cryptography", "load_signer", "read_authority"]

RECORDER = "recorder"
LONGEST = 64 * 1024
"""Letters of an identity."""


def import_cryptography() -> None:
    """`ImportError` says how to get it."""
    try:
        import cryptography  # noqa: F401
    except ImportError as error:
        raise ImportError(f"signatures need a package more: {install_hint('keys')} ({error})") from None


def fingerprint(identity: str) -> str:
    """Which identity it is: what a statement names as its signer."""
    return hashlib.sha256(identity.encode()).hexdigest()


@dataclass(frozen=True)
class Signer:
    """Signs statements. identity: its certificate or public key, PEM."""

    identity: str
    _key: Any

    @property
    def fingerprint(self) -> str:
        """Of the identity."""
        return fingerprint(self.identity)

    def sign(self, text: str) -> bytes:
        """The signature of a statement."""
        from cryptography.hazmat.primitives import hashes
        from cryptography.hazmat.primitives.asymmetric import ec, ed25519, padding

        data = signed_bytes(text)
        if isinstance(self._key, ed25519.Ed25519PrivateKey):
            return self._key.sign(data)
        if isinstance(self._key, ec.EllipticCurvePrivateKey):
            return self._key.sign(data, ec.ECDSA(hashes.SHA256()))
        return bytes(self._key.sign(data, padding.PKCS1v15(), hashes.SHA256()))


def load_signer(key: Path, certificate: Path | None = None) -> Signer:
    """From PEM files: a private key without a password, and its certificate, if it has one. Raises `UsageError` for
    what is no good, ImportError."""
    import_cryptography()
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
    from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_private_key

    try:
        check_private(key)
    except OSError as error:
        raise UsageError(f"{key}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise UsageError(str(error)) from None
    try:
        private = load_pem_private_key(key.read_bytes(), None)
        pem = certificate.read_text("ascii") if certificate else ""
    except OSError as error:
        raise UsageError(f"{error.filename}: cannot be read: {error.strerror}") from None
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise UsageError(f"{key}: not a private key without password, in PEM: make one with `fusion-service keys`, "
                         "or with `openssl genpkey -algorithm ed25519`") from None  # fmt: skip
    if not isinstance(private, ed25519.Ed25519PrivateKey | ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey):
        raise UsageError(f"{key}: signs neither by Ed25519, nor by an elliptic curve or RSA: name another key")
    if certificate is not None:
        identity = Identity.read(pem)
        if identity is None or identity.key != private.public_key():
            raise UsageError(f"{certificate}: not the certificate of {key}")
        return Signer(pem, private)
    public = private.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    return Signer(public.decode("ascii"), private)


@dataclass(frozen=True)
class Identity:
    """Who signed: the name, from the certificate or of the public key; certificates, the signer's first."""

    name: str
    key: Any
    certificates: tuple[Any, ...] = ()

    @classmethod
    def read(cls, pem: str) -> Identity | None:
        """From the text in a recording, None for what is none."""
        from cryptography.exceptions import UnsupportedAlgorithm

        try:
            return cls._read(pem) if len(pem) <= LONGEST else None
        except (ValueError, TypeError, UnsupportedAlgorithm):
            return None

    @classmethod
    def _read(cls, pem: str) -> Identity:
        from cryptography import x509
        from cryptography.hazmat.primitives.serialization import load_pem_public_key

        if "BEGIN CERTIFICATE" not in pem:
            return cls(f"key {fingerprint(pem)[:16]}", load_pem_public_key(pem.encode()))
        certificates = tuple(x509.load_pem_x509_certificates(pem.encode()))
        names = certificates[0].subject.get_attributes_for_oid(x509.NameOID.COMMON_NAME)
        name = str(names[0].value) if names else certificates[0].subject.rfc4514_string()
        name = " ".join(escaped(name).split())
        return cls(name, certificates[0].public_key(), certificates)

    def signed(self, text: str, signature: bytes) -> bool:
        """Whether this is its signature of a statement."""
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives import hashes
        from cryptography.hazmat.primitives.asymmetric import ec, ed25519, padding, rsa

        data = signed_bytes(text)
        try:
            if isinstance(self.key, ed25519.Ed25519PublicKey):
                self.key.verify(signature, data)
            elif isinstance(self.key, ec.EllipticCurvePublicKey):
                self.key.verify(signature, data, ec.ECDSA(hashes.SHA256()))
            elif isinstance(self.key, rsa.RSAPublicKey):
                self.key.verify(signature, data, padding.PKCS1v15(), hashes.SHA256())
            else:
                return False
        except (InvalidSignature, ValueError):
            return False
        return True


@dataclass(frozen=True)
class Authority:
    """Whom a reviewer believes: certificates of authorities, and public keys."""

    certificates: tuple[Any, ...]
    keys: tuple[Any, ...]

    def doubts(self, identity: Identity, time: int) -> str:
        """Why it does not vouch for who signed at `time`, ns UTC, 0 if that is not known; empty if it does."""
        if not identity.certificates:
            return "" if identity.key in self.keys else "signed by a key that is not the one given (--ca FILE)"
        if identity.key in self.keys:
            return ""
        try:
            return self._doubts(identity, datetime.fromtimestamp(time / 1e9, UTC) if time else None)
        except (ValueError, TypeError, OverflowError, OSError):
            return "signed by a certificate that cannot be read"

    def _doubts(self, identity: Identity, when: datetime | None) -> str:
        role = identity.name.partition(":")[0]
        if role != RECORDER and role in (*ROLES, HUB):  # by the beginning of the common name
            return f"signed by the certificate of a {role}, and not of a recorder"
        chain = identity.certificates
        for k, one in enumerate(chain):
            if when is not None and not one.not_valid_before_utc <= when <= one.not_valid_after_utc:
                return f"signed by a certificate that did not hold at {when:%Y-%m-%d %H:%M} UTC"
            if any(_issued(one, authority) for authority in self.certificates):
                return ""
            if k + 1 < len(chain) and not (_is_authority(chain[k + 1]) and _issued(one, chain[k + 1])):
                break
        return "signed by a certificate that is not of the authority given (--ca FILE)"


def _issued(one: Any, by: Any) -> bool:
    from cryptography.exceptions import InvalidSignature

    try:
        one.verify_directly_issued_by(by)
    except (InvalidSignature, ValueError, TypeError):
        return False
    return True


def _is_authority(certificate: Any) -> bool:
    from cryptography import x509

    try:
        return certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca is True
    except x509.ExtensionNotFound:
        return False


def read_authority(path: Path) -> Authority:
    """From a PEM file with certificates, or a public key. Raises `UsageError`, ImportError."""
    import_cryptography()
    from cryptography import x509
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.serialization import load_pem_public_key

    try:
        data = path.read_bytes()
        if b"BEGIN CERTIFICATE" in data:
            return Authority(tuple(x509.load_pem_x509_certificates(data)), ())
        return Authority((), (load_pem_public_key(data),))
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise UsageError(f"{path}: holds no certificate of an authority and no public key, in PEM") from None
