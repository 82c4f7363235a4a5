"""Why a link is refused. Zenoh says no more than that it could not: here the same certificates go through a handshake
of the standard library's TLS, in memory for our own, over a connection of its own for the hub, and what that finds is
told in one line.
"""

from __future__ import annotations

import logging
import re
import socket
import ssl
import time
from collections.abc import Sequence
from typing import NamedTuple

from fusion_service.bus.security import HUB, Security, SecurityError

__all__ = ["Own", "own_certificate", "refused"]

PATIENCE = 1.0
"""Seconds for each answer of who is asked."""
SOON = 30.0
"""Days before its end from which it is told that a certificate ends."""
log = logging.getLogger(__name__)
_ADDRESS = re.compile(r"(\w+)/(?:\[([^\]]+)\]|([^\s:/?#]+)):(\d+)")
_EXPIRED, _NOT_YET, _PURPOSE, _NAMES = (10,), (9,), (26,), (62, 64)
_FOREIGN = (2, 7, 18, 19, 20, 21, 24, 79)


class Own(NamedTuple):
    """Our certificate: its common name, and its end in seconds since 1970."""

    common_name: str
    end: float


def own_certificate(security: Security) -> Own:
    """Our certificate, shown to ourselves as to a hub or a client. Raises `SecurityError` if nobody of our authority
    would take it."""
    server, client = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname = False
    shown, asks = (server, client) if security.role == HUB else (client, server)
    for context in (server, client):
        context.verify_mode = ssl.CERT_REQUIRED if context is asks else ssl.CERT_NONE
        try:
            context.load_verify_locations(security.ca)
        except (ssl.SSLError, OSError):
            raise SecurityError(f"{security.path}: ca: {security.ca} holds no certificate") from None
    for context in {server, shown}:
        _show(context, security)
    ways = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = server.wrap_bio(ways[0], ways[1], server_side=True), client.wrap_bio(ways[1], ways[0])
    one = ends[1] if asks is client else ends[0]
    try:
        for _ in range(4):
            for end in reversed(ends):
                try:
                    end.do_handshake()
                except ssl.SSLWantReadError:
                    continue
    except ssl.SSLCertVerificationError as error:
        raise SecurityError(f"{security.path}: certificate: {security.certificate} {_fault(error, 'the ca')}") from None
    except ssl.SSLError as error:
        raise SecurityError(f"{security.path}: certificate: {security.certificate}: {_words(error)}") from None
    found = one.getpeercert() or {}
    subject = {str(part[0]): str(part[1]) for group in found.get("subject", ()) for part in group}
    own = Own(subject.get("commonName", ""), ssl.cert_time_to_seconds(str(found["notAfter"])))
    if (days := (own.end - time.time()) / 86400) < SOON:
        log.warning("the certificate %s of %s ends in %.0f days", security.certificate, security, days)
    return own


def refused(endpoints: Sequence[str], security: Security | None) -> str:
    """Why none of these hubs lets us in, in one line; empty where nobody is there, or nothing is found."""
    for endpoint in endpoints:
        found = _ADDRESS.match(endpoint)
        if found and (why := _refused(found[2] or found[3], int(found[4]), security)):
            return f"the hub at {endpoint} {why}"
    return ""


def _refused(host: str, port: int, security: Security | None) -> str:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    if security is None:
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    else:
        context.load_verify_locations(security.ca)
        _show(context, security)
    try:
        plain = socket.create_connection((host, port), PATIENCE)
    except OSError:
        return ""
    with plain:
        plain.settimeout(PATIENCE)
        try:
            link = context.wrap_socket(plain, server_hostname=host)
        except ssl.SSLCertVerificationError as error:
            if error.verify_code in _NAMES:
                return f"shows a certificate that is not for the name {host}: connect by a name that is in it"
            return f"shows a certificate that {_fault(error, 'our ca')}: it is not to be trusted"
        except OSError as error:
            return "" if security is None else _alert(error, "answers, but not by TLS: it runs without --security")
        with link:
            if security is None:
                return "asks for certificates (TLS): give --security FILE, which `fusion-service keys` writes"
            try:
                link.recv(1)  # in TLS 1.3 a refusal of our certificate comes after the handshake
            except OSError as error:
                return _alert(error, "")
    return ""


def _show(context: ssl.SSLContext, security: Security) -> None:
    """Let a context show our certificate."""
    try:
        context.load_cert_chain(security.certificate, security.key, password=lambda: b"")
    except (ssl.SSLError, OSError) as error:
        which = f"{security.certificate} and {security.key} are no certificate and its key, in PEM, without a password"
        raise SecurityError(f"{security.path}: {which}: {_words(error)}") from None


def _fault(error: ssl.SSLCertVerificationError, authority: str) -> str:
    """What is wrong with a certificate."""
    if error.verify_code in _EXPIRED:
        return "has expired"
    if error.verify_code in _NOT_YET:
        return "does not hold yet (is a clock wrong?)"
    if error.verify_code in _PURPOSE:
        return "was made for another purpose"
    if error.verify_code in _FOREIGN:
        return f"is foreign: {authority} has not signed it"
    return f"is not accepted: {error.verify_message}"


def _alert(error: OSError, other: str) -> str:
    """What the other end says of our certificate; `other` where it says nothing of it."""
    said = str(getattr(error, "reason", "") or "").lower()
    for word, meaning in {
        "certificate_expired": "refuses our certificate: it has expired, or does not hold yet (is a clock wrong?)",
        "unknown_ca": "refuses our certificate: it is foreign, another authority has signed it",
        "decrypt_error": "refuses our certificate: its authority has not signed it, or the key is another's",
        "certificate_required": "asks for a certificate, and was shown none",
        "certificate_revoked": "refuses our certificate: it has been revoked",
        "bad_certificate": "refuses our certificate: it is damaged, or foreign",
        "unsupported_certificate": "refuses our certificate: it was made for another purpose",
        "certificate_unknown": "refuses our certificate",
        "access_denied": "refuses our certificate",
    }.items():
        if word in said:
            return meaning
    return other


def _words(error: OSError) -> str:
    return str(getattr(error, "reason", None) or error.strerror or error).lower().replace("_", " ")
