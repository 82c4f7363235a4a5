"""Late data: whatever the order of arrival within `lateness`, the result is that of the ordered run."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import Centre, Order, SourceFound, make_centre
from fusion_service.config import centre_config
from schemas import GlobalTracks, LocalIntensity, LocalTracks

SECOND = 10**9
START = 1_700_000_000 * SECOND
FRAME = schemas.Enu(59.0, -55.0)
SPACE = ("x", "y", "vx", "vy")
PERIOD = 0.5
SCANS = 14
TARGETS = 5
QUICK: dict[str, Any] = {"rule": "ci", "memory": "restart", "supervision": "off", "registration": "off"}
Scan = LocalTracks | LocalIntensity
Arrival = tuple[float, bytes]


def world(seed: int, *, parts: int = 1, intensity: bool = False) -> list[Scan]:
    """Scans of three sources, each its own time apart: targets that fly straight, one of which begins late."""
    rng = np.random.default_rng(seed)
    place, velocity = rng.uniform(-3000, 3000, (TARGETS, 2)), rng.normal(0, 20, (TARGETS, 2))
    found: list[Scan] = []
    for k in range(SCANS):
        for number in range(3):
            t = PERIOD * (k + 1) - 0.1 * number
            ids = np.flatnonzero(np.arange(TARGETS) < (TARGETS if k > 4 + number else TARGETS - 1)).astype(np.uint64)
            mean = np.concatenate([place + velocity * t, velocity], axis=1)[ids]
            covariance = np.diag([25.0, 25.0, 1.0, 1.0]) * (1 + number)
            mean = mean + rng.normal(size=mean.shape) @ np.sqrt(covariance)
            header: dict[str, Any] = {"source": f"r{number}", "epoch": 1, "seq": k, "sent": START + round(t * SECOND)}
            where: dict[str, Any] = {"time": header["sent"], "space": SPACE, "frame": FRAME}
            means = np.repeat(mean, parts, axis=0) + np.tile(np.arange(parts), len(mean))[:, None]
            density: dict[str, Any] = {"means": means, "covariances": np.tile(covariance, (len(means), 1, 1))}
            if intensity:
                found.append(LocalIntensity(**header, **where, **density, weights=np.full(len(means), 1.0 / parts)))
                continue
            mixed: dict[str, Any] = {
                "counts": np.full(len(mean), parts, np.uint16),
                "weights": np.full(len(means), 1.0 / parts),
            }
            found.append(
                LocalTracks(
                    **header, **where, **density, **(mixed if parts > 1 else {}), complete=True, ids=ids + 100 * number
                )
            )
    return found


def ordered(scans: Sequence[Scan]) -> list[Arrival]:
    """Each as soon as it holds."""
    return [((one.time - START) / SECOND, schemas.encode(one)) for one in scans]


def disordered(scans: Sequence[Scan], rng: np.random.Generator, delay: float, repeated: float = 0.2) -> list[Arrival]:
    """Each up to `delay` seconds late, but that all are there at the end; some again, later or sooner."""
    end = PERIOD * SCANS
    found = []
    for one in scans:
        t, data = (one.time - START) / SECOND, schemas.encode(one)
        found.append((min(t + rng.uniform(0, delay), max(end, t)), data))
        if rng.random() < repeated:
            found.append((min(t + rng.uniform(0, delay), max(end, t)), data))
    return [found[k] for k in np.argsort([at for at, _ in found], kind="stable").tolist()]


def fly(
    arrivals: Sequence[Arrival], config: dict[str, Any], events: Sequence[tuple[float, Any]] = (), stop: int = SCANS
) -> tuple[Centre, list[GlobalTracks], list[schemas.StepLog]]:
    """A centre that is given them, and steps every PERIOD: what it said."""
    settings = {"period": PERIOD, "lateness": 5.0, "revise": 1e4, "frame": {"kind": "enu", "lat": 59.0, "lon": -55.0}}
    centre, _ = make_centre(centre_config({**settings, **config}))
    pictures, logs, given = [], [], 0
    for k in range(1, stop + 1):
        for at, event in events:
            if PERIOD * (k - 1) < at <= PERIOD * k:
                centre.handle(event, START + round(at * SECOND))
        while given < len(arrivals) and arrivals[given][0] <= PERIOD * k + 1e-9:
            centre.handle(schemas.decode(arrivals[given][1]), START + round(arrivals[given][0] * SECOND))
            given += 1
        result = centre.step(START + round(PERIOD * k * SECOND))
        for message in (result.tracks, result.log, result.status):
            assert schemas.encode(schemas.decode(schemas.encode(message))) == schemas.encode(message)
        pictures.append(result.tracks)
        logs.append(result.log)
    return centre, pictures, logs


def rows(picture: GlobalTracks) -> list[bytes]:
    """All that is said of each track, but its id, sorted."""
    counts = np.ones(len(picture.ids), np.intp) if picture.counts is None else picture.counts.astype(np.intp)
    parts, whose = (
        np.repeat(np.arange(len(counts)), counts),
        np.repeat(np.arange(len(counts)), picture.contributor_counts),
    )
    said = []
    for k in range(len(picture.ids)):
        columns = [picture.status[k], picture.existence[k], picture.updated[k]]
        columns += [picture.means[parts == k], picture.covariances[parts == k], picture.contributor_id[whose == k]]
        columns += [picture.contributor_influence[whose == k]]
        said.append(b"".join(np.asarray(one).tobytes() for one in columns))
    return sorted(said)


def check_ids(pictures: Sequence[GlobalTracks], logs: Sequence[schemas.StepLog], scans: Sequence[Scan]) -> None:
    """Births go up, ids in a picture once, and what has ended never returns; an id stays with its target, which is that
    of the local tracks in it."""
    newest, over, whose = 0, set[int](), dict[int, set[int]]()
    for picture, log in zip(pictures, logs, strict=True):
        ids = picture.ids.tolist()
        assert ids == sorted(set(ids))
        born = log.decisions.track[log.decisions.kind == schemas.messages.BORN].tolist()
        assert all(one > newest for one in born)
        assert born == sorted(set(born))
        newest = max([newest, *born])
        assert max(ids, default=0) <= newest
        over |= {old for old, _, _ in picture.ended}
        assert not over & set(ids)
        owner = np.repeat(picture.ids, picture.contributor_counts)
        for track, local in zip(owner.tolist(), picture.contributor_id.tolist(), strict=True):
            whose.setdefault(track, set()).add(local % 100)
    if isinstance(scans[0], LocalTracks):
        assert all(len(targets) == 1 for targets in whose.values())


CONFIGS: dict[str, dict[str, Any]] = {
    "restart": {"rule": "ci", "memory": "restart"},
    "recursive": {"rule": "hmd-ga", "memory": "recursive", "supervision": "off", "registration": "off"},
    "tracklet": {"rule": "bci", "memory": "tracklet", "supervision": "off", "registration": "off"},
    "auto": {},
}


@pytest.mark.parametrize("name", CONFIGS)
def test_what_came_late_changes_the_result_as_if_it_had_come_in_time(name: str) -> None:
    seed = 11
    print("seed", seed)
    scans = world(seed)
    _, said, _ = fly(ordered(scans), CONFIGS[name])
    assert len(said[-1].ids) == TARGETS
    centre, late, logs = fly(disordered(scans, np.random.default_rng(seed), 5.0), CONFIGS[name])
    assert rows(late[-1]) == rows(said[-1])
    assert rows(late[SCANS // 2]) != rows(said[SCANS // 2])  # what had not come was not known
    assert any(one.revised is not None for one in late)
    assert all(one.revised is None or one.revised < one.time for one in late)
    assert set(centre.refusals()) <= {"repeat"}
    check_ids(late, logs, scans)


@pytest.mark.parametrize("kind", ["mixture", "intensity"])
def test_late_mixtures_and_intensities(kind: str) -> None:
    seed = 3
    print("seed", seed)
    scans = world(seed, parts=2, intensity=kind == "intensity")
    config = {"kind": "intensity"} if kind == "intensity" else {"rule": "ci", "mixture_rule": "aa"}
    config |= {"supervision": "off", "registration": "off"}
    _, said, _ = fly(ordered(scans), config)
    _, late, logs = fly(disordered(scans, np.random.default_rng(seed), 2.0), config)
    assert len(said[-1].ids) >= TARGETS
    assert rows(late[-1]) == rows(said[-1])
    assert any(one.revised is not None for one in late)
    check_ids(late, logs, scans)


def test_what_was_lost_is_missing_and_nothing_else() -> None:
    seed = 7
    print("seed", seed)
    rng = np.random.default_rng(seed)
    scans = [one for one in world(seed) if rng.random() > 0.2]
    assert len(scans) < 3 * SCANS - 3
    _, said, _ = fly(ordered(scans), QUICK)
    _, late, _ = fly(disordered(scans, rng, 3.0, repeated=0.5), QUICK)
    assert len(said[-1].ids) >= TARGETS - 1
    assert rows(late[-1]) == rows(said[-1])


def test_orders_and_presence_are_made_again_in_their_steps() -> None:
    """The order names a track by the id that it was published under."""
    seed = 5
    print("seed", seed)
    scans, rng = world(seed), np.random.default_rng(seed)
    found = [(0.2, SourceFound("r1"))]

    def named(arrivals: Sequence[Arrival]) -> tuple[Any, list[GlobalTracks], list[schemas.StepLog]]:
        _, pictures, _ = fly(arrivals, QUICK, found, stop=6)
        picture = pictures[-1]
        first = np.cumsum(picture.contributor_counts) - picture.contributor_counts
        track = next(
            t for t, k in zip(picture.ids.tolist(), first.tolist(), strict=True) if picture.contributor_id[k] % 100 == 2
        )
        orders = [(6 * PERIOD + 0.1, Order("rename", track=track, name="Bravo", shown=7))]
        return fly(arrivals, QUICK, [*found, *orders])

    _, said, _ = named(ordered(scans))
    _, late, _ = named(disordered(scans, rng, 2.0))
    assert rows(late[-1]) == rows(said[-1])
    for picture in (said[-1], late[-1]):
        assert picture.callsign is not None
        at = picture.callsign.index("Bravo")
        begin = int(picture.contributor_counts[:at].sum())
        assert picture.contributor_id[begin] % 100 == 2


def test_the_logs_make_the_same_again_to_the_bit() -> None:
    """Under a bound that leaves most of it for later."""
    seed = 13
    print("seed", seed)
    scans = world(seed)
    config = {**QUICK, "revise": 2.0}
    _, late, logs = fly(disordered(scans, np.random.default_rng(seed), 3.0), config)
    known = {schemas.digest(one): one for one in scans}
    settings = {"period": PERIOD, "lateness": 5.0, "frame": {"kind": "enu", "lat": 59.0, "lon": -55.0}}
    centre, _ = make_centre(centre_config({**settings, **config}))
    for picture, log in zip(late, logs, strict=True):
        for entry in reversed(log.taken):
            centre.handle(known[entry.hash], 2**62)
        result = centre.step(log.time)
        assert schemas.encode(result.tracks) == schemas.encode(picture)
        assert [one for one in result.log.events if one["kind"] == "revised"] == [
            one for one in log.events if one["kind"] == "revised"
        ]
    assert sum(one.revised is not None for one in late) > 2


def test_the_cost_is_bounded_and_the_rest_is_made_good_later() -> None:
    """Every message is late by four steps; two steps may be made again for each."""
    seed = 2
    print("seed", seed)
    scans = world(seed)
    arrivals = [(at + 4 * PERIOD, data) for at, data in ordered(scans)]
    centre, late, _ = fly(arrivals, {**QUICK, "revise": 2.0})
    again = [len([one for one in late if one.revised is not None])]
    assert 0 < again[0] < SCANS // 2
    assert centre.step(late[-1].time + SECOND).status.queue["revised"] <= 2.0 * SCANS + 4
    plain, said, _ = fly(arrivals, {**QUICK, "revise": 0.0})
    assert all(one.revised is None for one in said)
    assert "late" not in plain.step(late[-1].time + SECOND).status.queue


def test_what_is_late_beyond_measure_or_of_a_step_of_before_a_restart() -> None:
    """Older than lateness: refused. Of a step that an earlier process has made: taken as it comes."""
    scans = ordered(world(4))
    held, rest = scans[6], [*scans[:6], *scans[7:]]
    centre, _, _ = fly([*rest, (11 * PERIOD, held[1])], {**QUICK, "lateness": 2.0})
    assert centre.refusals() == {"late": 1}
    centre, _, _ = fly(rest, QUICK, stop=8)
    other, fault = make_centre(centre.config, centre.checkpoint())
    assert not fault
    other.handle(schemas.decode(held[1]), START + 5 * SECOND)
    result = other.step(START + 5 * SECOND)
    assert result.tracks.revised is None
    assert [entry.seq for entry in result.log.taken] == [2]


def test_a_flood_of_late_messages_costs_one_run_a_step_and_what_is_kept_is_bounded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("fusion_service.centre.history.MOST_COMPONENTS", 120)
    scans = ordered(world(9))
    flood = [(min(at + 0.1 * k, PERIOD * SCANS), data) for k, (at, data) in enumerate(scans)]
    for k, (at, data) in enumerate(scans[:20]):
        other = schemas.decode(data)
        assert isinstance(other, LocalTracks)
        flood.append((at + 1.0, schemas.encode(dataclasses.replace(other, epoch=7 + k, source="x"))))
    centre, late, logs = fly(sorted(flood, key=lambda one: one[0]), QUICK)
    revised = [[one for one in log.events if one["kind"] == "revised"] for log in logs]
    assert max(map(len, revised)) == 1
    kept = centre._history
    messages = [message for past in kept.past for message, _ in past.inputs]
    assert sum(len(message.means) for message in messages if isinstance(message, LocalTracks)) <= 120
    assert len(late[-1].ids) >= TARGETS


def test_an_id_that_has_ended_never_returns() -> None:
    """Silence ends all tracks; then what was sent in the meantime comes, and more."""
    seed = 6
    print("seed", seed)
    scans = [one for one in world(seed) if one.source == "r0"]
    config = {**QUICK, "coast": 0.5, "coast_periods": 0.0, "lateness": 5.0, "source_defaults": {"stale": 0.6}}
    arrivals = [
        (at if k < 3 or k >= 9 else PERIOD * (9 + (k % 4)), data) for k, (at, data) in enumerate(ordered(scans))
    ]
    arrivals.sort(key=lambda one: one[0])
    _, said, _ = fly(ordered(scans), config)
    _, late, logs = fly(arrivals, config)
    assert any(reason == "lost" for one in late for _, reason, _ in one.ended)
    assert any("back" in event for log in logs for event in log.events)
    assert rows(late[-1]) == rows(said[-1])
    check_ids(late, logs, scans)
