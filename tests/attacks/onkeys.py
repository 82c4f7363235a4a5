"""Attacks by an insider: a session that the hub lets in, as a party that may not do this. Each begins one attack and
returns how to see whether it has worked."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import NamedTuple

import msgpack
import numpy as np
import zenoh
from zenoh import ext

import schemas
from tests.attacks.lab import SITE, Check, Lab

__all__ = ["ON_KEYS", "KeyAttack"]

V1 = "fusion/v1"
LARGE = 6 * 2**20


class KeyAttack(NamedTuple):
    """What an insider tries, as which party; `refused`: what the hub's log must name where it is
    refused, the act and a part of the key; empty where that is not logged."""

    name: str
    party: str
    begin: Callable[[Lab, zenoh.Session, str], Check]
    refused: str
    mode: str = "client"


def put(key: str) -> Callable[[Lab, zenoh.Session, str], Check]:
    """Publish on another's key: the recorder hears it."""

    def begin(lab: Lab, session: zenoh.Session, name: str) -> Check:
        mark = name.encode()
        session.put(f"{V1}/{key}", mark)
        return lambda: lab.heard(f"{V1}/{key}", mark)

    return begin


def put_cached(key: str) -> Callable[[Lab, zenoh.Session, str], Check]:
    """The same with numbered samples, kept for late joiners: who joins later gets them."""

    def begin(lab: Lab, session: zenoh.Session, name: str) -> Check:
        mark = name.encode()
        late: list[bytes] = []
        publisher = ext.declare_advanced_publisher(
            session,
            f"{V1}/{key}",
            cache=ext.CacheConfig(1),
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=0.5, sporadic_heartbeat=None),
            publisher_detection=True,
        )
        publisher.put(mark)
        lab.stack.callback(publisher.undeclare)
        declared: list[object] = []

        def look() -> bool:
            if not declared:
                declared.append(lab.recorder.subscribe(f"{V1}/{key}", lambda key, data: late.append(data)))
            return mark in late

        return look

    return begin


def forger(key: str, mark: bytes, overheard: list[str] | None = None) -> Callable[[zenoh.Query], None]:
    """Answers with `mark` on `key` whatever is asked."""

    def forge(query: zenoh.Query) -> None:
        if overheard is not None:
            overheard.append(str(query.key_expr))
        with contextlib.suppress(zenoh.ZError):  # the question was for another answer
            query.reply(key, mark)

    return forge


def poison(key: str) -> Callable[[Lab, zenoh.Session, str], Check]:
    """Answer who asks another's cache for what was missed."""

    def begin(lab: Lab, session: zenoh.Session, name: str) -> Check:
        mark = name.encode()
        late: list[bytes] = []
        cache = f"{V1}/{key}/@adv/pub/{'7' * 32}/1/x"
        session.declare_queryable(cache, forger(f"{V1}/{key}", mark), complete=True)
        declared: list[object] = []

        def look() -> bool:
            if not declared:
                declared.append(lab.recorder.subscribe(f"{V1}/{key}", lambda key, data: late.append(data)))
            return mark in late

        return look

    return begin


def tracks_as_r1(lab: Lab, *, later: int, ids: list[int], source: str = "r1") -> bytes:
    """A sound message of a radar."""
    count = len(ids)
    message = schemas.LocalTracks(
        source=source,
        epoch=lab.radar.epoch + later,
        seq=0,
        sent=time.time_ns(),
        origin="live",
        time=time.time_ns(),
        complete=True,
        space=("x", "y"),
        frame=SITE,
        ids=np.array(ids, dtype=np.uint64),
        means=np.full((count, 2), 5000.0) + 500 * np.arange(count)[:, None],
        covariances=np.tile(25 * np.eye(2), (count, 1, 1)),
    )
    return bytes(schemas.encode(message))


def ghosts(source: str) -> Callable[[Lab, zenoh.Session, str], Check]:
    """Targets of a source that is not there: they come into the centre's picture."""

    def begin(lab: Lab, session: zenoh.Session, name: str) -> Check:
        def look() -> bool:
            session.put(f"{V1}/local/{source}/tracks", tracks_as_r1(lab, later=0, ids=[1, 2, 3], source=source))
            return lab.heard(f"{V1}/global/main/tracks", source.encode())

        return look

    return begin


def lock_out(lab: Lab, session: zenoh.Session, name: str) -> Check:
    """Tracks of the radar under a newer epoch: the centre refuses the real one from then on."""

    def look() -> bool:
        session.put(f"{V1}/local/r1/tracks", tracks_as_r1(lab, later=10**9, ids=[]))
        time.sleep(0.3)
        lab.report()
        statuses = [data for key, data in list(lab.recorded) if key == f"{V1}/global/main/status"]
        return any(b"old-epoch" in data for data in statuses)

    return look


def answer(key: str, asked: str, party: str) -> Callable[[Lab, zenoh.Session, str], Check]:
    """Answer in another's place: who asks gets the forged answer, or is overheard."""

    def begin(lab: Lab, session: zenoh.Session, name: str) -> Check:
        mark = name.encode()
        overheard: list[str] = []
        session.declare_queryable(f"{V1}/{key}", forger(f"{V1}/{asked}", mark, overheard), complete=True)
        honest = lab.bus(party)

        def look() -> bool:
            answers = honest.ask(f"{V1}/{asked}", msgpack.packb({"what": "list"}), timeout=0.5)
            return bool(overheard) or any(data == mark for _, data in answers)

        return look

    return begin


def ask(key: str, payload: bytes | None = None) -> Callable[[Lab, zenoh.Session, str], Check]:
    """Ask what is not for us: an answer comes."""

    def begin(lab: Lab, session: zenoh.Session, name: str) -> Check:
        replies: list[zenoh.Reply] = []
        session.get(
            f"{V1}/{key}",
            replies.append,
            payload=payload,
            timeout=2.0,
            target=zenoh.QueryTarget.ALL,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
        )
        return lambda: any(reply.ok for reply in replies)

    return begin


def order(key: str) -> Callable[[Lab, zenoh.Session, str], Check]:
    """Mute the radar by an order in another's name."""
    return ask(key, msgpack.packb({"what": "mute", "source": "r9", "who": "alice", "until": 1}))


def listen(key: str) -> Callable[[Lab, zenoh.Session, str], Check]:
    """Read what is not for us."""

    def begin(lab: Lab, session: zenoh.Session, name: str) -> Check:
        heard: list[zenoh.Sample] = []
        lab.stack.callback(session.declare_subscriber(key, heard.append).undeclare)

        def look() -> bool:
            lab.report()
            return bool(heard)

        return look

    return begin


def look_for_tokens(lab: Lab, session: zenoh.Session, name: str) -> Check:
    """See who is there."""
    seen: list[zenoh.Sample] = []
    token = session.liveliness().declare_subscriber(f"{V1}/**", seen.append, history=True)
    lab.stack.callback(token.undeclare)
    return lambda: bool(seen)


def token(key: str) -> Callable[[Lab, zenoh.Session, str], Check]:
    """Say that somebody is there, and then gone."""

    def begin(lab: Lab, session: zenoh.Session, name: str) -> Check:
        there = session.liveliness().declare_token(f"{V1}/{key}")
        lab.stack.callback(there.undeclare)
        return lambda: (f"{V1}/{key}", True) in list(lab.tokens)

    return begin


def heartbeat(lab: Lab, session: zenoh.Session, name: str) -> Check:
    """Tell readers that they have missed samples of the radar, on its cache's own key."""
    heard: list[bytes] = []
    key = f"{V1}/local/r1/tracks/@adv/pub/{'7' * 32}/1/x"
    listener = lab.raw("recorder-rec").declare_subscriber(key, lambda sample: heard.append(bytes(sample.payload)))
    lab.stack.callback(listener.undeclare)

    def look() -> bool:
        session.put(key, name.encode())
        return name.encode() in heard

    return look


def flood(lab: Lab, session: zenoh.Session, name: str) -> Check:
    """A message beyond what a source may send, on a key of its own."""
    mark = name.encode()
    key = f"{V1}/local/evil/tracks"

    def look() -> bool:
        session.put(key, mark + bytes(LARGE), congestion_control=zenoh.CongestionControl.BLOCK)
        time.sleep(0.1)
        return lab.heard(key, mark)

    return look


ORDER = "global/main/orders"
ON_KEYS = (
    KeyAttack("become a source", "source-evil", put("local/r1/tracks"), "Put local/r1/tracks"),
    KeyAttack("say what a source is", "source-evil", put("local/r1/info"), "Put local/r1/info"),
    KeyAttack("lock the real one out", "source-evil", lock_out, "Put local/r1/tracks"),
    KeyAttack("ghosts", "source-evil", ghosts("ghost-9"), "Put local/ghost-9/tracks"),
    KeyAttack("a centre's ghosts", "centre-other", ghosts("spook-9"), "Put local/spook-9/tracks"),
    KeyAttack("forged picture", "source-evil", put("global/main/tracks"), "Put global/main/tracks"),
    KeyAttack("another centre's picture", "centre-other", put("global/main/tracks"), "Put global/main/tracks"),
    KeyAttack("forged log", "source-evil", put("global/main/log"), "Put global/main/log"),
    KeyAttack("forged status", "viewer-wall", put("global/main/status"), "Put global/main/status"),
    KeyAttack("a recorder that speaks", "recorder-rec", put("local/r1/intensity"), "Put local/r1/intensity"),
    KeyAttack("an operator that speaks", "operator-bob", put("global/main/picture"), "Put global/main/picture"),
    KeyAttack("forged truth", "source-evil", put("truth/three-radars"), "Put truth/three-radars"),
    KeyAttack(
        "forged answer",
        "source-evil",
        answer("global/main/picture", "global/main/picture", "viewer-wall"),
        "Declare Queryable global/main/picture",
    ),
    KeyAttack(
        "forged answer of all",
        "viewer-wall",
        answer("**", "global/main/picture", "viewer-wall"),
        "Declare Queryable **",
    ),
    KeyAttack(
        "overheard order",
        "operator-bob",
        answer(f"{ORDER}/*", f"{ORDER}/alice", "operator-alice"),
        f"Declare Queryable {ORDER}",
    ),
    KeyAttack("forged order", "source-evil", order(f"{ORDER}/alice"), f"Query {ORDER}/alice"),
    KeyAttack("order in another's name", "operator-bob", order(f"{ORDER}/alice"), f"Query {ORDER}/alice"),
    KeyAttack("order in all names", "operator-bob", order(f"{ORDER}/*"), f"Query {ORDER}/*"),
    KeyAttack("order in nobody's name", "operator-bob", order(ORDER), f"Query {ORDER}"),
    KeyAttack("a viewer's order", "viewer-wall", order(f"{ORDER}/wall"), f"Query {ORDER}/wall"),
    KeyAttack("token of another", "source-evil", token("local/late/alive"), "Liveliness Token local/late/alive"),
    KeyAttack("token of a centre", "source-evil", token("global/other/alive"), "Liveliness Token global/other/alive"),
    KeyAttack("token of nobody", "gateway-gate", token("local/nobody/alive"), "Liveliness Token local/nobody/alive"),
    KeyAttack("forged heartbeat", "source-evil", heartbeat, "Put local/r1/tracks/@adv"),
    KeyAttack("forged cached info", "source-evil", put_cached("local/late/info"), "Put local/late/info"),
    KeyAttack("poisoned cache", "source-evil", poison("local/late/tracks"), "Declare Queryable local/late/tracks/@adv"),
    KeyAttack(
        "poisoned cache of a centre",
        "centre-other",
        poison("global/main/log"),
        "Declare Queryable global/main/log/@adv",
    ),
    KeyAttack("reading all", "source-evil", listen("**"), "Declare Subscriber **"),
    KeyAttack("reading all sources", "source-evil", listen(f"{V1}/local/**"), "Declare Subscriber local/**"),
    KeyAttack("reading the picture", "source-evil", listen(f"{V1}/global/**"), "Declare Subscriber global/**"),
    KeyAttack(
        "a viewer reading sources", "viewer-wall", listen(f"{V1}/local/*/tracks"), "Declare Subscriber local/*/tracks"
    ),
    KeyAttack("a viewer reading all of a source", "viewer-wall", listen(f"{V1}/local/r1/**"), "Declare Subscriber r1"),
    KeyAttack(
        "a gateway reading infos", "gateway-gate", listen(f"{V1}/local/*/info"), "Declare Subscriber local/*/info"
    ),
    KeyAttack("a viewer placing a sensor", "viewer-wall", put("local/r1/info"), "Put local/r1/info"),
    KeyAttack("asking the caches", "source-evil", ask("**/@adv/**"), "Query @adv"),
    KeyAttack("a viewer asking the caches", "viewer-wall", ask("local/**/@adv/**"), "Query @adv"),
    KeyAttack("a viewer asking caches of tracks", "viewer-wall", ask("local/*/tracks/@adv/**"), "Query tracks/@adv"),
    KeyAttack("asking for the picture", "source-evil", ask("global/*/picture"), "Query global/*/picture"),
    KeyAttack("seeing who is there", "source-evil", look_for_tokens, "Declare Liveliness Subscriber **"),
    KeyAttack("too large", "source-evil", flood, ""),
    KeyAttack("rogue router", "source-evil", put("local/r1/tracks"), "Put local/r1/tracks", "router"),
    KeyAttack("rogue router reading", "source-evil", listen(f"{V1}/**"), "Declare Subscriber **", "router"),
    KeyAttack(
        "rogue router answering",
        "source-evil",
        answer("**", "global/main/picture", "viewer-wall"),
        "Declare Queryable **",
        "router",
    ),
    KeyAttack("rogue peer", "source-evil", put("local/r1/tracks"), "Put local/r1/tracks", "peer"),
)
