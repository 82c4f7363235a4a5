"""A step of few tracks, by its short cuts and without them: the same bytes; and what a step tells of itself, whenever
it is asked."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import schemas
from benchmarks.load import FRAME, Load
from fusion_service import motion
from fusion_service.centre import FusionCentre, SourceFound, align, association, candidates, deltas, kinship, lineage
from fusion_service.centre.intake import Intake
from fusion_service.centre.lifecycle import empty_picture, newborn
from fusion_service.centre.motions import Motions
from fusion_service.config import centre_config
from schemas import LocalTracks, Motion, numeric
from schemas.spaces import MOTIONS

SECOND = 1_000_000_000
PERIOD = SECOND // 10
SOURCES, TRACKS, SCANS = 3, 5, 22
VALUES = {"q": 0.7, "q_turn": 0.1, "sigma": 2.0, "tau": 9.0}
PLAIN = {"rule": "ci", "memory": "restart", "supervision": "off", "registration": "off"}


def said(scan: int, source: int, message: LocalTracks) -> LocalTracks | None:
    """What a source says: tracks end and begin, jump, are exchanged, and it falls silent for a while."""
    if scan in (7, 8) and source == 1:
        return replace(message, ids=message.ids[:-2], means=message.means[:-2], covariances=message.covariances[:-2])
    if scan in (14, 15) and source == 2:
        return None
    means = message.means.copy()
    if scan == 11:
        means[0, 0] += 400.0
    if scan > 18 and source == 0:
        means[[1, 2]] = means[[2, 1]]
    ids = message.ids + np.uint64(1000) * np.uint64(scan > 12 and source == 2)
    return replace(message, ids=ids, means=means)


def arrivals(late: bool) -> list[tuple[int, list[LocalTracks]]]:
    """The steps, ns, and what comes for each: with `late`, a scan now and then two steps after its time."""
    world, out, held = Load(SOURCES, TRACKS, 3, spacing=300.0).world(), [], list[LocalTracks]()
    for scan in range(SCANS):
        for source in range(SOURCES):
            time = SECOND + scan * PERIOD + source * PERIOD // SOURCES
            message = said(scan, source, world.at(source, scan, time, SECOND))
            came = [message] if message is not None else []
            if late and scan % 6 == 4 and source == 1:
                held, came = came, []
            elif held and source == 0:
                came, held = [*held, *came], []
            out.append((time, came))
    return out


def flown(late: bool = False, *, asks: bool = True, prepares: bool = False, **settings: Any) -> list[bytes]:
    """All that the steps give. asks: for the status after each step, else only when the next is made."""
    known = {f"load-{s + 1:02d}": {"override": True, "period": 0.1} for s in range(SOURCES)}
    place = {"kind": "enu", "lat": FRAME.lat, "lon": FRAME.lon}
    centre = FusionCentre({"period": 0.1, "trigger": "arrival", "frame": place, "sources": known, **settings})
    parts: list[list[bytes]] = []
    before = None
    for number, (time, came) in enumerate(arrivals(late)):
        if number == 4:
            centre.handle(SourceFound("load-02"), time)
        for message in came:
            centre.handle(message, time + 1)
        result = centre.step(time)
        if asks:
            assert result.status is result.status
        parts.append([schemas.encode(one) for one in (result.tracks, result.log, result.picture)])
        if prepares:
            centre.foresee()
        if number % 10 == 0:
            parts[-1].append(centre.checkpoint())
        if before is not None:  # which was made at the latest when the centre went on
            parts[-2].append(schemas.encode(before.status))
        before = result
    return [one for part in parts for one in part]


def different(one: list[bytes], other: list[bytes]) -> list[int]:
    return [place for place, (a, b) in enumerate(zip(one, other, strict=True)) if a != b]


@pytest.mark.parametrize(
    ("late", "settings"), [(False, PLAIN), (True, {"lateness": 1.0}), (False, {"memory": "tracklet"})]
)
def test_by_short_cuts_and_without_them_are_the_same(
    late: bool, settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    counts = dict.fromkeys(("apart", "recalled", "planned", "whole"), 0)

    def counted(place: Any, name: str, what: str) -> None:
        plain = getattr(place, name)

        def count(*given: Any) -> Any:
            found = plain(*given)
            counts[what] += bool(found)
            return found

        monkeypatch.setattr(place, name, count)

    with monkeypatch.context() as patched:
        counted(candidates, "_far_apart", "apart")
        counted(motion, "_driven", "planned")
        counted(deltas, "all_of", "whole")
        recalled = lineage.Lineages.recalled

        def look(self: lineage.Lineages, key: Any, make: Any) -> NDArray[Any]:
            counts["recalled"] += key in self._recalled
            return recalled(self, key, make)

        patched.setattr(lineage.Lineages, "recalled", look)
        quick = flown(late, **settings)
    assert all(counts.values()), counts
    monkeypatch.setattr(association, "FEW", -1)
    monkeypatch.setattr(candidates, "FEW", -1)
    monkeypatch.setattr(kinship, "FEW", -1)
    monkeypatch.setattr(lineage, "FEW", -1)
    monkeypatch.setattr(numeric, "FEW", -1)
    monkeypatch.setattr(align, "KEPT", -1)
    monkeypatch.setattr(motion, "_driven", lambda *_: None)
    monkeypatch.setattr(deltas, "all_of", lambda _: False)
    assert different(quick, flown(late, **settings)) == []


def test_a_status_is_the_same_whenever_it_is_asked_for_and_a_checkpoint_made_ahead() -> None:
    assert different(flown(True, lateness=1.0), flown(True, asks=False, prepares=True, lateness=1.0)) == []


def test_a_status_that_cannot_be_made_harms_no_step(monkeypatch: pytest.MonkeyPatch) -> None:
    centre = FusionCentre(PLAIN)
    with monkeypatch.context() as patched:
        patched.setattr(FusionCentre, "_watched", lambda _: 1 // 0)
        result = centre.step(SECOND)
        with pytest.raises(ZeroDivisionError):
            centre.handle(SourceFound("a"), SECOND)
    with pytest.raises(ValueError, match="no status"):
        _ = result.status
    centre.handle(SourceFound("a"), SECOND)
    assert centre.step(2 * SECOND).status.step == 2


@pytest.mark.parametrize("kind", ["cv", "ca", "still", "singer", "ou", "ct"])
@pytest.mark.parametrize(
    "space",
    [("x", "y"), ("x", "y", "vx", "vy"), ("vx", "x", "y", "vy", "z"), ("x", "vx", "ax", "y", "vy", "ay"),
     ("x", "y", "vx", "vy", "turn_rate")],
)  # fmt: skip
def test_motion_by_a_plan_is_that_of_its_chains(
    kind: Any, space: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(7)
    n, count = len(space), 17
    root = rng.normal(size=(n, n, count))
    means, covariances = rng.normal(size=(n, count)), np.einsum("ijb,kjb->ikb", root, root)
    takes = {name: value for name, value in VALUES.items() if name in MOTIONS[kind]}
    moves = [Motion(kind, **takes), Motion(kind, **(takes | ({"sigma": 0.0} if kind == "ca" else {})))]
    gaps = [rng.uniform(0.0, 3.0, count), np.full(count, 0.3), np.where(rng.random(count) < 0.5, 0.0, 0.7)]
    cases = [(one, dt) for one in moves for dt in gaps]
    planned = [motion.predict(one, space, means, covariances, dt) for one, dt in cases]
    motion._at_once.cache_clear()
    monkeypatch.setattr(motion, "_driven", lambda *_: None)
    for (one, dt), found in zip(cases, planned, strict=True):
        for a, b in zip(found, motion.predict(one, space, means, covariances, dt), strict=True):
            np.testing.assert_array_equal(a, b)
    motion._at_once.cache_clear()


def test_the_one_motion_of_all_sources_is_that_of_what_they_feed() -> None:
    motions = Motions(Intake(centre_config({})))
    picture = empty_picture(4).join(newborn(np.arange(1, 6, dtype=np.uint64), 4, SECOND))
    fed, source = np.array([0, 3, 3]), np.array([0, 1, 0])
    one, other = Motion("cv", 1.0), Motion("cv", 2.0)
    assert motions.follow(picture, fed, [one, one], source).tolist() == [0, -1, -1, 0, -1]
    assert motions.follow(picture, fed, [None, None], source).tolist() == [-1] * 5
    assert motions.follow(picture, fed, [other, one], source).tolist() == [1, -1, -1, 1, -1]


@pytest.mark.parametrize("n", [1, 2, 4, 6])
def test_few_densities_are_checked_as_many_are(n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(n)
    count = 60
    root = rng.normal(size=(count, n, n))
    covariances = root @ root.swapaxes(1, 2)
    covariances[::5, 0, 0] = rng.choice([np.nan, np.inf, -1.0, 0.0, 1e40], len(covariances[::5]))
    covariances[1::7, -1] = covariances[1::7, 0]
    means = np.where(rng.random((count, n)) < 0.02, np.nan, rng.normal(size=(count, n)))
    with np.errstate(all="ignore"):
        few = numeric._sound(means, covariances)
        monkeypatch.setattr(numeric, "FEW", -1)
        np.testing.assert_array_equal(few, numeric._sound(means, covariances))
    assert few.any()
    assert not few.all()
