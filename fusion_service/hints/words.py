"""Words that are nearly right: components, keys, realms, and what else has names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from fusion_service.hints.finding import Finding, cut
from schemas import parse_key

__all__ = ["COMPONENT_WORDS", "component_hint", "did_you_mean", "key_finding", "near"]

LONGEST = 64
MOST_WORDS = 300

COMPONENT_WORDS = {
    "x": ("east", "easting", "e", "posx", "xpos", "px", "positionx", "xm", "x0", "xeast"),
    "y": ("north", "northing", "n", "posy", "ypos", "py", "positiony", "ym", "y0", "ynorth"),
    "z": ("up", "height", "altitude", "alt", "posz", "zpos", "pz", "positionz", "u"),
    "vx": ("velx", "xvel", "xdot", "dx", "velocityx", "speedx", "xspeed", "veast", "ve", "vxms"),
    "vy": ("vely", "yvel", "ydot", "dy", "velocityy", "speedy", "yspeed", "vnorth", "vn", "vyms"),
    "vz": ("velz", "zvel", "zdot", "dz", "velocityz", "speedz", "zspeed", "vup", "vu"),
    "ax": ("accx", "xacc", "xddot", "accelerationx", "accelx"),
    "ay": ("accy", "yacc", "yddot", "accelerationy", "accely"),
    "az": ("accz", "zacc", "zddot", "accelerationz", "accelz"),
    "turn_rate": ("turnrate", "omega", "yawrate", "w", "rateofturn", "rot", "turn", "headingrate"),
}
"""Component -> how others call it, in small letters without anything between them."""
PLACES = ("lat", "latitude", "lon", "lng", "long", "longitude")
POLAR = ("speed", "sog", "course", "cog", "heading", "range", "bearing", "azimuth")


def near(word: object, known: Iterable[str]) -> str:
    """The one of `known` that was meant by `word`; "" where none is near."""
    if not isinstance(word, str) or not 0 < len(word) <= LONGEST:
        return ""
    some = [one for _, one in zip(range(MOST_WORDS), known, strict=False)]
    plain = {_plain(one): one for one in reversed(some)}
    if _plain(word) in plain:
        return plain[_plain(word)]
    found = difflib.get_close_matches(_plain(word), plain, 1, 0.7)
    return plain[found[0]] if found else ""


def did_you_mean(word: object, known: Iterable[str]) -> str:
    """`: did you mean "x"?`, or nothing."""
    meant = near(word, known)
    return f': did you mean "{meant}"?' if meant and meant != word else ""


def component_hint(word: object) -> str:
    """What was meant by an unknown component of a state space; "" where that is not known."""
    if not isinstance(word, str):
        return "components are texts"
    plain = _plain(word[:LONGEST])
    for component, others in COMPONENT_WORDS.items():
        if plain == _plain(component) or plain in others:
            return f'did you mean "{component}"?'
    if plain in PLACES:
        return "places are x and y in metres, in a frame about an origin whose lat and lon are in degrees"
    if plain in POLAR:
        return "states are Cartesian: make x, y (m) and vx, vy (m/s) of it"
    return ""


def key_finding(key: str, realm: str = "fusion") -> Finding | None:
    """What is wrong with the key that somebody publishes on, for who listens in `realm`; None if nothing is."""
    try:
        parsed = parse_key(key)
    except ValueError:
        return _odd_key(key, realm)
    if parsed.realm == realm:
        return None
    meant = f"did you mean {realm!r}?" if near(parsed.realm, [realm]) else f"the centre listens in {realm!r}"
    return Finding("realm", "realm", cut(parsed.realm), f"it publishes in the realm {cut(parsed.realm)!r}: {meant}")


def _odd_key(key: str, realm: str) -> Finding:
    chunks = key.split("/")
    shown = cut(key)
    form = f"{realm}/v1/local/NAME/tracks"
    at = next((place for place, one in enumerate(chunks) if one in ("local", "global", "truth")), None)
    if at is None:
        meant = next((one for one in chunks if near(one, ("local", "global"))), "")
        why = f"{meant!r} is no part of a key" if meant else "it names no source"
        return Finding("key", "key", shown, f"the key {shown!r} is none of this version, {why}: publish on {form}")
    if at == 0 or chunks[at - 1] != "v1":
        had = chunks[at - 1] if at else "nothing"
        return Finding("key", "key", shown, f"the key {shown!r} has {had!r} where v1 belongs: publish on {form}")
    if chunks[at] == "local" and len(chunks) > at + 2:
        what = chunks[at + 2]
        meant = near(what, ("tracks", "intensity", "info", "alive"))
        more = f'did you mean "{meant}"?' if meant and meant != what else "it is tracks, intensity, info or alive"
        return Finding("key", "key", shown, f"the key {shown!r} ends in {cut(what)!r}: {more}")
    return Finding("key", "key", shown, f"the key {shown!r} is none of this version: publish on {form}")


def _plain(word: str) -> str:
    return "".join(letter for letter in word.lower() if letter.isalnum())
