"""Who publishes where no centre of a realm listens: another realm, a key with a slip of the pen."""

from __future__ import annotations

from collections.abc import Collection, Container, Iterable

from fusion_service.hints.words import key_finding, near
from schemas import parse_key

__all__ = ["beside", "no_centre", "realm_of"]

MOST = 5
"""Names that are told."""


def realm_of(key: str) -> str:
    """The realm of a key of this version; "" of any other."""
    try:
        return parse_key(key).realm
    except ValueError:
        return ""


def no_centre(name: str, there: Collection[str]) -> str:
    """That no centre of this name answers, and which are there."""
    others = sorted(set(there) - {name})
    if not others:
        return f"no centre named {name} answers: is `fusion-service run` there, under this name?"
    names = ", ".join(others[:MOST]) + (f" and {len(others) - MOST} more" if len(others) > MOST else "")
    return f"no centre named {name} answers, but {names}: give --centre {others[0]}"


def beside(keys: Iterable[str], realm: str, served: Container[str] = (), sure: bool = False) -> list[str]:
    """A sentence for each of `keys` on which no centre of `realm` listens. served: realms that have a centre of their
    own, whose sources are where they belong; sure: only of what is nearly right, and so hardly meant otherwise."""
    found: dict[str, None] = {}
    for key in sorted(keys):
        odd = key_finding(key, realm)
        at = realm_of(key)
        if odd is None or at in served or (sure and not (at and near(at, [realm]))):
            continue
        found[odd.said if odd.reason == "key" else f"{key}: {odd.said}"] = None
    return list(found)
