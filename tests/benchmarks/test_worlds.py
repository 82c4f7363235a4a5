"""Hard worlds: the measures on pictures made by hand, the trackers against a dense solve, the worlds as data."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import schemas
from benchmarks.worlds.catalogue import KINDS, make
from benchmarks.worlds.cli import main
from benchmarks.worlds.flight import fly
from benchmarks.worlds.floor import HOLD, Ear, fresh_errors, known_assignment
from benchmarks.worlds.kalman import filtered
from benchmarks.worlds.measures import Picture, average, correspondence, impure, score
from benchmarks.worlds.world import FALSE, FRAME, SPACE, flickers, ns
from fusion_service.rules import fuse
from schemas import LocalTracks, Motion

SECOND = 10**9
GONE = (np.nan, np.nan)
Floats = NDArray[np.float64]


def truth(*places: tuple[float, float]) -> Floats:
    return np.array(places, dtype=float).reshape(-1, 2)


def picture(tracks: dict[int, tuple[float, float]], sigma: float = 2.0) -> Picture:
    places = np.array(list(tracks.values()), dtype=float).reshape(-1, 2)
    return Picture(np.array(list(tracks), dtype=np.uint64), places, np.tile(sigma**2 * np.eye(2), (len(tracks), 1, 1)))


def scores(steps: list[tuple[Floats, Picture]], cutoff: float = 10.0) -> dict[str, float]:
    return asdict(score([there for there, _ in steps], [seen for _, seen in steps], cutoff))


def test_a_perfect_picture() -> None:
    there = truth((0, 0), (100, 0))
    found = scores([(there, picture({7: (0, 0), 9: (100, 0)}))] * 3)
    assert found == dict.fromkeys(found, 0.0) | {
        "ids_mean": 1.0, "ids_worst": 1, "nearest_mean": 1.0, "nearest_worst": 1, "confirmed": 2,
    }  # fmt: skip


def test_gospa_and_its_parts_are_means_over_steps() -> None:
    """c = 10: a pair 3 m apart costs 9, a missed target and a false track 50 each."""
    there = truth((0, 0), (100, 0))
    found = scores([(there, picture({1: (3, 0)})), (there, picture({1: (3, 0), 2: (100, 0), 3: (500, 0)}))])
    assert (found["localisation"], found["missed"], found["false"]) == (9.0, 25.0, 25.0)
    assert found["gospa"] == pytest.approx(np.sqrt(59.0))


def test_ids_switches_duplicates_and_ghosts() -> None:
    there = truth((0, 0), GONE)
    steps = [
        (there, picture({1: (0, 0)})),
        (there, picture({2: (1, 0), 3: (5, 0)})),
        (there, picture({2: (5, 0), 3: (1, 0), 4: (300, 0)})),
        (there, picture({})),
    ]
    found = scores(steps)
    assert (found["ids_worst"], found["ids_mean"]) == (3, 1.5), "duplicates count; the second target was never there"
    assert (found["nearest_worst"], found["nearest_mean"]) == (3, 1.5)
    assert found["switches"] == 1, "2 stays near, so that 3, nearer in the third step, changes nothing"
    assert (found["duplicates"], found["ghosts"], found["confirmed"]) == (0.5, 0.25, 4)


def test_a_target_keeps_its_track_while_that_is_near() -> None:
    there = truth((0, 0), (6, 0))
    crossed = picture({1: (5, 0), 2: (1, 0)})
    assert correspondence({0: 1, 1: 2}, there, crossed, 10.0) == {0: 1, 1: 2}
    assert correspondence({0: 1, 1: 2}, there, crossed, 5.0) == {0: 2, 1: 1}
    assert correspondence({}, there, crossed, 10.0) == {0: 2, 1: 1}
    assert correspondence({0: 1}, truth(GONE, (6, 0)), crossed, 10.0) == {1: 1}


def test_swapped_tracks_are_switches_once_they_have_parted() -> None:
    def at(x: float) -> Floats:
        return truth((x, 0), (-x, 0))

    steps = [(at(50), picture({1: (50, 0), 2: (-50, 0)})), (at(1), picture({1: (1, 0), 2: (-1, 0)}))]
    steps += [(at(x), picture({1: (-x, 0), 2: (x, 0)})) for x in (2, 50, 60)]
    found = scores(steps)
    assert (found["switches"], found["ids_worst"]) == (2, 2)


def test_a_leap_is_measured_from_the_target_that_was_followed() -> None:
    there = truth((0, 0), (1000, 0))
    steps = [(there, picture({1: (0, 0)})), (there, picture({1: (1000, 0)}))]
    assert scores(steps)["leap"] == pytest.approx(500.0), "1000 m at a sigma of 2 m, though it sits on a target"
    steps = [(there, picture({1: (0, 0)})), (truth(GONE, (1000, 0)), picture({1: (1000, 0)}))]
    assert scores(steps)["leap"] == 0.0, "the target has gone: nothing to be measured from"
    close = truth((0, 0), (8, 0))
    steps = [(close, picture({1: (0, 0)})), (close, picture({1: (9, 0)}))]
    assert scores(steps)["leap"] == pytest.approx(0.5), "between targets nearer than the cutoff nobody can tell"


def test_averages_over_runs_keep_the_worst() -> None:
    there = truth((0, 0))
    one = score([there], [picture({1: (2, 0)})], 10.0)
    two = score([there, there], [picture({1: (0, 0)}), picture({2: (6, 0)})], 10.0)
    both = average([one, two])
    assert (both.ids_worst, both.leap, both.switches, both.localisation) == (2.0, two.leap, 0.5, (4 + 18) / 2)


def test_global_tracks_of_several_targets() -> None:
    assert impure([[1, 1], [1, 2], [3], [], [-2, 3]]) == 2


def scan(source: str, seconds: float, rows: dict[int, tuple[float, float]], ids: list[int] | None = None) -> Any:
    """A scan of targets at places, sigma 3 m and 1 m/s, with the targets."""
    target = np.array(list(rows), dtype=np.int64)
    places = np.array(list(rows.values()), dtype=float).reshape(-1, 2)
    message = LocalTracks(
        source=source, epoch=1, seq=round(seconds * 10), sent=ns(seconds), time=ns(seconds), complete=True, space=SPACE,
        frame=FRAME, ids=np.array(ids or range(len(rows)), dtype=np.uint64), means=np.pad(places, ((0, 0), (0, 2))),
        covariances=np.tile(np.diag([9.0, 9.0, 1.0, 1.0]), (len(rows), 1, 1)),
    )  # fmt: skip
    return message, target


def ears(count: int = 2, targets: int = 3) -> list[Ear]:
    return [Ear.of(Motion("cv", 0.0), targets) for _ in range(count)]


def test_the_floor_fuses_what_is_of_one_target() -> None:
    a, b = ears()
    a.hear(*scan("a", 1.0, {0: (0, 0), 1: (50, 0)}))
    b.hear(*scan("b", 3.0, {1: (52, 0), FALSE: (0, 1)}))
    seen = known_assignment([a, b], ns(3.0), "ci")
    assert seen.id.tolist() == [0, 1]
    older, newer = np.diag([13.0, 13.0, 1.0, 1.0]), np.diag([9.0, 9.0, 1.0, 1.0])  # 9 + 2^2, with its correlation
    older[[0, 1, 2, 3], [2, 3, 0, 1]] = 2.0
    fused = fuse("ci", np.array([[50.0, 0, 0, 0], [52, 0, 0, 0]]), np.stack([older, newer]))
    np.testing.assert_allclose(seen.place, np.stack([np.zeros(2), fused.mean[:2]]), atol=1e-9)
    np.testing.assert_allclose(seen.covariance, np.stack([13 * np.eye(2), fused.covariance[:2, :2]]), atol=1e-9)


def test_the_floor_holds_what_nobody_lists_for_a_while() -> None:
    a, b = ears()
    a.hear(*scan("a", 1.0, {0: (0, 0), 1: (50, 0)}))
    b.hear(*scan("b", 1.0, {0: (2, 0)}))
    a.hear(*scan("a", 2.0, {}))
    assert known_assignment([a, b], ns(2.0), "ci").id.tolist() == [0, 1]
    assert known_assignment([a, b], ns(1.0 + HOLD), "ci").id.tolist() == [0, 1]
    assert known_assignment([a, b], ns(1.5 + HOLD), "ci").id.tolist() == [0], "b still lists 0"
    a.hear(*scan("a", 1.5, {2: (9, 9)}))
    assert not a.listed.any(), "older than the newest: not heard"


def test_a_fresh_assignment_has_the_errors_of_one_scan() -> None:
    a, b = ears(targets=4)
    a.hear(*scan("a", 1.0, {0: (0, 0), 1: (10, 0), 2: (500, 0)}))
    b.hear(*scan("b", 1.0, {0: (8, 0), 1: (3, 0), 2: (500, 0), 3: (900, 0)}))
    assert fresh_errors(a, b, ns(1.0)) == 2, "(0, 10) with (3, 8) costs less than with (8, 3)"
    b.hear(*scan("b", 2.0, {0: (1, 0), 1: (9, 0), 2: (500, 0)}))
    assert fresh_errors(a, b, ns(2.0)) == 0


def test_the_trackers_are_the_least_squares_of_their_measurements() -> None:
    """q = 0: the mean and covariance of a straight line, with the first velocity as a prior, solved as one system."""
    rng = np.random.default_rng(2)
    times = np.array([1.0, 1.5, 3.0, 4.0])
    measured = rng.normal(0, 5, (4, 3, 2))
    measured[2, 1] = np.nan
    found = filtered(times, measured, 5.0, 0.0, 15.0, 3, rng)
    for target in range(3):
        hit = np.isfinite(measured[:, target, 0])
        # position at the end and velocity: z = p - (t_end - t) v
        A = np.concatenate([np.stack([np.ones(hit.sum()), times[hit] - 4.0], axis=1) / 5.0, [[0.0, 1 / 15.0]]])
        P = np.linalg.inv(A.T @ A)
        for axis in range(2):
            x = P @ A.T @ np.append(measured[hit, target, axis] / 5.0, 0.0)
            np.testing.assert_allclose(found.mean[-1, target, axis::2], x, rtol=1e-9)
            np.testing.assert_allclose(found.covariance[-1, target, axis::2, axis::2], P, rtol=1e-9)
    np.testing.assert_array_equal(found.updated[2], [3.0, 1.5, 3.0])


def test_the_trackers_are_honest_under_their_own_motion() -> None:
    """NEES of 400 targets driven by white noise as declared: mean 4, error 2 sqrt(8 / 400) at two sigma."""
    seed = 3
    print("seed", seed)
    rng = np.random.default_rng(seed)
    count, q, sigma = 400, 2.0, 6.0
    times = np.arange(1.0, 31.0)
    states = np.concatenate([rng.normal(0, 100, (count, 2)), rng.normal(0, 15, (count, 2))], axis=1)
    path = [states]
    for _ in times[1:]:
        one, other = np.sqrt(q) * rng.normal(
            size=(2, count, 2)
        )  # of an integral and its mean: q [[1/3, 1/2], [1/2, 1]]
        states = np.concatenate([states[:, :2] + states[:, 2:] + one / 2 + other / np.sqrt(12), states[:, 2:] + one], 1)
        path.append(states)
    truth = np.stack(path)
    found = filtered(times, truth[..., :2] + sigma * rng.normal(size=(30, count, 2)), sigma, q, 15.0, 3, rng)
    error = found.mean[-1] - truth[-1]
    nees = np.einsum("ja,jab,jb->j", error, np.linalg.inv(found.covariance[-1]), error)
    assert nees.mean() == pytest.approx(4.0, abs=3 * np.sqrt(8 / count))


def test_tracks_end_after_their_misses_and_come_back_under_new_ids() -> None:
    measured = np.zeros((7, 1, 2))
    measured[[2, 4, 5]] = np.nan
    found = filtered(np.arange(7.0), measured, 1.0, 0.1, 5.0, 2, np.random.default_rng(0))
    assert found.id[:, 0].tolist() == [1, 1, 1, 1, 1, 0, 2]
    assert found.covariance[6, 0, 0, 0] == 1.0


def test_clutter_is_as_dense_as_said() -> None:
    seed = 5
    print("seed", seed)
    rng = np.random.default_rng(seed)
    false = flickers(rng, 400, 30.0, 1000.0, 2.0, 2)
    tracks = filtered(np.arange(400.0), false, 5.0, 0.5, 15.0, 2, rng)
    number = (tracks.id > 0).sum(axis=1)
    assert number.mean() == pytest.approx(30.0, rel=0.05), "Poisson numbers, correlated over three scans"
    assert number[:20].mean() == pytest.approx(30.0, rel=0.25), "and from the beginning"


@pytest.mark.parametrize("name", [name for name, kind in KINDS.items() if kind.quick])
def test_a_world_is_well_formed_and_the_same_for_its_seed(name: str) -> None:
    variant = KINDS[name].quick[0]
    one, again, other = (make(name, variant, seed, quick=True) for seed in (1, 1, 2))
    assert [schemas.encode(a.message) for a in one.told] == [schemas.encode(b.message) for b in again.told]
    assert [schemas.encode(a.message) for a in one.told] != [schemas.encode(b.message) for b in other.told]
    np.testing.assert_array_equal(one.truth, again.truth)
    assert np.isfinite(one.truth).any(axis=(1, 2)).all()
    assert [a.received for a in one.told] == sorted(a.received for a in one.told)
    assert one.times[0] > one.told[0].received - SECOND
    for told in one.told:
        if isinstance(told.message, LocalTracks):
            assert schemas.check_numbers([told.message]) is not None
            assert told.target is not None
            assert len(told.target) == len(told.message.ids)
            assert told.received > told.message.time
            assert len(set(told.message.ids.tolist())) == len(told.message.ids)


def test_local_tracks_are_near_the_targets_they_are_said_to_be_of() -> None:
    for name in ("formation", "lanes", "joins", "manoeuvres", "overlap", "id re-use", "bias"):
        world = make(name, KINDS[name].quick[-1], 3, quick=True)
        at = {time: k for k, time in enumerate(world.times.tolist())}
        seen = 0
        for told in world.told:
            if isinstance(told.message, LocalTracks) and told.message.time in at and told.target is not None:
                places = world.truth[at[told.message.time], told.target]
                sigma = np.sqrt(np.einsum("jaa->ja", told.message.covariances[:, :2, :2]))
                assert (np.abs(told.message.means[:, :2] - places) < 7 * sigma + 20.0).all(), name
                seen += len(places)
        assert seen > 20, name


def test_a_flight_without_hardship_reaches_the_floor() -> None:
    world = make("bias", "0 m", 1, quick=True)
    flight = fly(world)
    assert flight.floor is not None
    centre, floor = (score(world.truth[5:], found[5:], world.cutoff) for found in (flight.pictures, flight.floor))
    assert centre.gospa == pytest.approx(floor.gospa, rel=0.02)
    assert (centre.ids_worst, centre.switches, centre.duplicates, centre.ghosts) == (1, 0, 0, 0)
    assert max(flight.wrong) == 0
    assert len(flight.milliseconds) == len(world.times) == len(flight.pictures)


def test_wrong_pairs_are_counted_from_the_contributors() -> None:
    """While the ids are swapped some global track has contributors of two targets, whoever judges it."""
    flight = fly(make("id re-use", "a swaps", 1, quick=True))
    assert flight.wrong[0] == 0
    assert flight.fresh == []
    again = fly(make("id re-use", "a swaps", 1, quick=True))
    for one, other in zip(flight.pictures, again.pictures, strict=True):
        np.testing.assert_array_equal(one.place, other.place)


def test_the_command_prints_a_row_for_each_world(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FUSION_DATA", raising=False)
    file, page = tmp_path / "worlds.json", tmp_path / "worlds.md"
    quick = ["--quick", "--world", "splits", "--world", "id re-use"]
    assert main([*quick, "--json", str(file)]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    assert [row.split(" (c =")[0] for row in rows[1:]] == [
        "| splits, 20 s",
        "| id re-use, one source",
        "| id re-use, a swaps",
    ]
    assert {row.count("|") for row in rows} == {10}
    found = json.loads(file.read_text())
    assert [one["variant"] for one in found["worlds"]] == ["20 s", "one source", "a swaps"]
    assert found["worlds"][0]["floor"]["ids_mean"] == 1.0
    assert main([*quick, "--against", str(file), "--page", str(page), "--world", "radar-v2x"]) == 0
    out = capsys.readouterr().out
    assert "| splits, 20 s (c = 40 m), before |" in out
    assert "radar-v2x: skipped: --data and FUSION_DATA name no folder." in out
    assert page.read_text().startswith("# Hard worlds")
    assert "| splits, 20 s (c = 40 m) |" in page.read_text()
