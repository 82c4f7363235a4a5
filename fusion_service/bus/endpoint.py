"""Where a hub is, as `protocol/host:port`: a word of Zenoh's, checked without loading it."""

from __future__ import annotations

import re

__all__ = ["DEFAULT_ENDPOINT", "check_endpoint"]

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
_ENDPOINT = re.compile(r"(?:tcp|tls|udp|quic|ws)/(?:[^\s:/?#\[\]]+|\[[0-9A-Fa-f:.%\w]+\]):(\d{1,5})(?:[?#]\S*)?")
_OTHER = re.compile(r"(?:unixsock-stream|unixpipe|serial|vsock)/\S+")


def check_endpoint(text: str) -> str:
    """Return `text` if it is an endpoint. Raises ValueError if not."""
    found = _ENDPOINT.fullmatch(text)
    if not (found and int(found[1]) < 65536) and not _OTHER.fullmatch(text):
        raise ValueError(f"{text!r} is not an endpoint: write protocol/host:port, as in {DEFAULT_ENDPOINT}")
    return text
