"""Key expressions: what is built is parsed again, and nothing else is."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

import schemas

NAMES = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_.:-]{0,63}", fullmatch=True)
REALMS = st.lists(NAMES.filter(lambda name: name != "v1"), min_size=1, max_size=3).map("/".join)
LOCAL = ("tracks", "intensity", "info", "alive")
GLOBAL = ("tracks", "log", "status", "alive", "picture", "orders", "state")
HOSTILE = (
    "",
    " ",
    "a b",
    "a/b",
    "*",
    "**",
    "a*",
    "$*",
    "@adv",
    "a#b",
    "a?b",
    "é",
    "а",  # Cyrillic
    "１",  # a full-width digit
    "a\n",
    "a\x00",
    ".",
    "..",
    "-a",
    "_a",
    ":a",
    "x" * 65,
    "{a}",
)


@given(NAMES, st.sampled_from(LOCAL), REALMS)
def test_local_round_trip(name: str, what: str, realm: str) -> None:
    key = schemas.local_key(name, what, realm)
    assert key == f"{realm}/v1/local/{name}/{what}"
    assert schemas.parse_key(key) == schemas.Key(realm, "local", name, what)


@given(NAMES, st.sampled_from(GLOBAL), REALMS)
def test_global_round_trip(name: str, what: str, realm: str) -> None:
    key = schemas.global_key(name, what, realm)
    assert key == f"{realm}/v1/global/{name}/{what}"
    assert schemas.parse_key(key) == schemas.Key(realm, "global", name, what)


@given(NAMES, REALMS)
def test_truth_round_trip(name: str, realm: str) -> None:
    key = schemas.truth_key(name, realm)
    assert key == f"{realm}/v1/truth/{name}"
    assert schemas.parse_key(key) == schemas.Key(realm, "truth", name, "")


@given(st.text() | st.lists(st.sampled_from(["v1", "local", "global", "truth", "tracks", "a", "", "*"])).map("/".join))
def test_a_key_that_parses_is_one_that_is_built(key: str) -> None:
    try:
        parsed = schemas.parse_key(key)
    except ValueError:
        return
    build = {"local": schemas.local_key, "global": schemas.global_key}
    if parsed.scope == "truth":
        assert schemas.truth_key(parsed.name, parsed.realm) == key
    else:
        assert build[parsed.scope](parsed.name, parsed.what, parsed.realm) == key


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_names(name: str) -> None:
    with pytest.raises(ValueError, match="bad name"):
        schemas.check_name(name)
    if name != "a/b":
        with pytest.raises(ValueError, match="bad"):
            schemas.local_key("s", "tracks", name)
    if name != "*":
        for build in (schemas.local_key, schemas.global_key):
            with pytest.raises(ValueError, match="bad"):
                build(name, "alive")
        with pytest.raises(ValueError, match="bad"):
            schemas.truth_key(name)
    for key in (f"fusion/v1/local/{name}/tracks", f"fusion/v1/truth/{name}"):
        with pytest.raises(ValueError):
            schemas.parse_key(key)


@pytest.mark.parametrize(
    "key",
    [
        "",
        "/",
        "fusion",
        "fusion/v1",
        "fusion/v1/local",
        "fusion/v1/local/a",
        "fusion/v1/local/a/orders",
        "fusion/v1/local/a/tracks/",
        "fusion/v1/local//tracks",
        "/fusion/v1/local/a/tracks",
        "fusion//v1/local/a/tracks",
        "fusion/v2/local/a/tracks",
        "fusion/v1/v1/local/a/tracks",
        "v1/local/a/tracks",
        "v1/truth/a",
        "fusion/v1/global/a/intensity",
        "fusion/v1/truth/a/tracks",
        "fusion/v1/truth/",
        "fusion/v1/LOCAL/a/tracks",
        "fusion/v1/local/*/tracks",
        "fusion/v1/**",
        "fusion/v1/local/a/tracks/@adv/pub/1",
        "fusion/v1/local/a/tracks\n",
    ],
)
def test_what_is_not_a_key(key: str) -> None:
    with pytest.raises(ValueError):
        schemas.parse_key(key)


def test_any_name() -> None:
    assert schemas.local_key("*", "tracks") == "fusion/v1/local/*/tracks"
    assert schemas.global_key("*", "log") == "fusion/v1/global/*/log"
    assert schemas.truth_key("*", "a/b") == "a/b/v1/truth/*"


def test_unknown_kinds() -> None:
    for build, what in ((schemas.local_key, "status"), (schemas.global_key, "info"), (schemas.local_key, "*")):
        with pytest.raises(ValueError, match=re.escape(f"key {what!r}")):
            build("a", what)


def test_a_scope_is_no_name_of_trouble() -> None:
    """Names that are words of the key itself are told apart by their place."""
    key = schemas.local_key("truth", "tracks", "local/global")
    assert schemas.parse_key(key) == schemas.Key("local/global", "local", "truth", "tracks")
    assert schemas.parse_key("a/v1/truth/v1").name == "v1"
