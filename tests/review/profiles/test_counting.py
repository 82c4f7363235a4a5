"""What each kind of requirement counts, on missions so small that it is counted by hand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from fusion_service.errors import ReviewError
from fusion_service.review.evaluation.assess import assess
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.evaluation.results import text
from fusion_service.review.profiles import Area, Judged, Profile, Requirement, judge
from fusion_service.review.profiles.observing import Observed, observe
from fusion_service.review.profiles.profile import KINDS
from schemas import Ecef, Message, Truth
from tests.helpers.missions import FRAME, at, info, picture, tracks, truth


def need(kind: str, **given: Any) -> Requirement:
    numbers = {key: given.pop(key, one.default) for key, one in KINDS[kind].keys.items()}
    return Requirement(kind=kind, name=kind, numbers=numbers, **given)


def seen(mission: Sequence[Message], c: float = 10.0, **rest: Any) -> Observed:
    truths = [message for message in mission if isinstance(message, Truth)]
    return observe(Logbook(mission), "centre", truths, c, **rest)


def one(mission: Sequence[Message], wanted: Requirement, areas: Sequence[Area] = (), **rest: Any) -> Judged:
    identities = rest.pop("identities", {})
    sources = wanted.kind == "tracked_through"
    (found,) = judge(
        Profile("p", "s", areas=tuple(areas), requirements=(wanted,), identities=identities),
        seen(mission, sources=sources, **rest),
    )
    return found


def lone(seconds: int, shown: Sequence[int], **rest: Any) -> list[Message]:
    """A target at rest for so many seconds, with a picture every second, that shows it at some of them."""
    mission: list[Message] = [truth(t, [1], [[0.0, 0.0]]) for t in range(seconds + 1)]
    for t in range(seconds + 1):
        mission.append(picture(t, [5], [[3.0, 4.0]], **rest) if t in shown else picture(t, [], []))
    return mission


def test_detection_is_the_share_of_scored_times_with_a_track() -> None:
    found = one(lone(9, [0, 1, 2, 5, 6, 7, 8, 9]), need("detection", share_min=0.5))
    assert (found.whole.found, found.whole.samples, found.targets[1].found) == (0.8, 10, 0.8)


def test_updates_are_new_measurements_and_intervals_are_cut_from_the_stay() -> None:
    """20 s; measured at 0, 3, 9, 17 s, coasting in between: of the windows of 4 s those of 4-8 and 12-16 have none.
    Intervals of 3, 6, 8 s; gaps longer than 5 s: 6 and 8 s, which lack 1 and 1 update of 4 s, of 5 expected."""
    mission: list[Message] = [truth(t, [1], [[0.0, 0.0]]) for t in range(21)]
    for t in range(21):
        last = max(one for one in (0, 3, 9, 17) if one <= t)
        mission.append(picture(t, [5], [[0.0, 0.0]], updated=np.array([at(last)])))
    found = one(mission, need("update", interval_s=4.0, share_min=0.5))
    assert (found.whole.found, found.whole.samples) == (3 / 5, 5)
    shown = one(mission, need("update", interval_s=4.0, share_min=0.5, counts="shown"))
    assert shown.whole.found == 1.0
    between = one(mission, need("update_interval", within_s=6.0, share_min=0.5))
    assert (between.whole.found, between.whole.samples) == (2 / 3, 3)
    gap = one(mission, need("gap", longer_than_s=5.0, interval_s=4.0, share_max=0.5))
    assert (gap.whole.found, gap.whole.samples) == (2 / 5, 5)
    age = one(mission, need("latency", of="measurement", within_s=4.0, share_min=0.1))
    ages = [t - max(one for one in (0, 3, 9, 17) if one <= t) for t in range(21)]
    assert age.whole.found == pytest.approx(np.mean(np.array(ages) <= 4))


def test_a_gap_may_be_at_the_end_and_a_target_that_is_never_seen_lacks_all() -> None:
    """Of 10 expected updates 4 s of silence at the end lack 3; of a target without any track all 10."""
    silent = one(lone(10, range(7)), need("gap", longer_than_s=3.0, interval_s=1.0, share_max=0.5))
    assert (silent.whole.found, silent.whole.samples) == (3 / 10, 10)
    never = one(lone(10, []), need("gap", longer_than_s=3.0, interval_s=1.0, share_max=1.0))
    assert never.whole.found == 1.0


def test_errors_are_split_along_and_across_the_true_velocity() -> None:
    """North-east at 10 m/s; the track 3 m ahead and 1 m to the left, its velocity 2 m/s too fast along."""
    u, left = np.array([1.0, 1.0]) / np.sqrt(2), np.array([-1.0, 1.0]) / np.sqrt(2)
    mission: list[Message] = []
    for t in range(11):
        place, velocity = 10.0 * t * u, 10.0 * u
        off, speed = place + 3.0 * u + 1.0 * left, velocity + 2.0 * u
        mission.append(truth(t, [1], [[place[0], velocity[0], place[1], velocity[1]]]))
        mission.append(picture(t, [5], [[off[0], speed[0], off[1], speed[1]]]))
    for direction, value in (("along", 3.0), ("across", 1.0), ("horizontal", np.sqrt(10.0))):
        found = one(mission, need("position_error", rms_max_m=1.0, direction=direction))
        assert found.whole.found == pytest.approx(value)
    for direction, value in (("along", 2.0), ("across", 0.0)):
        found = one(mission, need("velocity_error", rms_max_m_per_s=1.0, direction=direction))
        assert found.whole.found == pytest.approx(value, abs=1e-12)
    within = one(mission, need("position_error", within_m=3.2, share_min=0.9))
    assert (within.whole.found, within.whole.samples) == (1.0, 11)
    height = one(mission, need("position_error", rms_max_m=1.0, direction="height"))
    assert (height.verdict, height.whole.samples) == ("not shown", 0)
    ahead = one(mission, need("prediction_error", horizon_s=4.0, rms_max_m=1.0))
    assert ahead.whole.found == pytest.approx(np.hypot(3.0 + 4.0 * 2.0, 1.0)), "11 along, 1 across"
    assert ahead.whole.samples == 7
    still = one(lone(5, range(6)), need("position_error", rms_max_m=9.0, direction="along"))
    assert still.whole.samples == 0, "who stands has no along"


def test_velocity_that_truth_does_not_tell_is_taken_from_its_places() -> None:
    mission: list[Message] = []
    for t in range(6):
        place = np.array([[4.0 * t, -3.0 * t]])
        mission += [truth(t, [1], [], means=place, space=("x", "y")), picture(t, [5], [[4.0 * t, 4.0, -3.0 * t, -1.0]])]
    found = one(mission, need("velocity_error", rms_max_m_per_s=5.0))
    assert found.whole.found == pytest.approx(2.0)


def test_false_and_multiple_tracks() -> None:
    """At each of 5 times: one on the target, one 6 m off (a second one of it), one 500 m off (false)."""
    mission: list[Message] = [truth(t, [1], [[0.0, 0.0]]) for t in range(5)]
    mission += [picture(t, [5, 6, 7], [[0.0, 0.0], [6.0, 0.0], [500.0, 0.0]]) for t in range(5)]
    false = one(mission, need("false_tracks", share_max=0.1))
    assert (false.whole.found, false.whole.samples, false.verdict) == (5 / 15, 15, "failed")
    assert one(mission, need("false_tracks", share_max=0.1, farther_than_m=600.0)).whole.found == 0.0
    double = one(mission, need("multiple_tracks", share_max=0.1))
    assert (double.whole.found, double.whole.samples) == (5 / 10, 10)
    near = Area("near", disk=(0.0, 0.0), radius=50.0)
    inside = one(mission, need("false_tracks", share_max=0.1, area="near"), [near])
    assert (inside.whole.found, inside.whole.samples) == (0.0, 10)


def test_identity_is_correct_wrong_or_none() -> None:
    mission: list[Message] = [truth(t, [1, 2], [[0.0, 0.0], [100.0, 0.0]]) for t in range(10)]
    for t in range(10):
        name = None if t < 2 else "mmsi:1" if t < 9 else "mmsi:7"
        mission.append(picture(t, [5, 6], [[0.0, 0.0], [100.0, 0.0]], identity=(name, "mmsi:2"), identity_p=None))
    known = {1: "mmsi:1"}
    for verdict, share in (("correct", 0.7), ("none", 0.2), ("wrong", 0.1)):
        found = one(mission, need("identity", verdict=verdict, share_min=0.01), identities=known)
        assert (found.whole.found, found.whole.samples) == (share, 10)
    unknown = one(mission, need("identity", verdict="correct", share_min=0.5))
    assert unknown.verdict == "not shown"
    assert "[identities]" in unknown.whole.words


def test_breaks_changes_and_swaps() -> None:
    """Target 1: track 5, nothing at 10 and 11, track 5, from 20 on track 6, which was target 2's till 15: a break, a
    change, a swap. Target 2: track 6, from 16 on 8: a change. Each an hour by 30 s of life."""
    mission: list[Message] = []
    for t in range(31):
        mission.append(truth(t, [1, 2], [[0.0, 0.0], [100.0, 0.0]]))
        first = [] if t in (10, 11) else [5 if t < 20 else 6]
        second = [6 if t < 16 else 8]
        places = [[0.0, 0.0]] * len(first) + [[100.0, 0.0]]
        mission.append(picture(t, first + second, places))
    for count, events in (("breaks", 1), ("changes", 2), ("swaps", 1)):
        found = one(mission, need("continuity", count=count, per_target_hour_max=1e4))
        assert found.whole.found == pytest.approx(events / (2 * 30 / 3600))
        assert found.targets[1].found == pytest.approx(1 / (30 / 3600))


def test_tracked_through_gaps_of_the_sources() -> None:
    """A source sees the target at even seconds: 2 of 4, always. The picture has it from 3 on, but not at 8."""
    mission: list[Message] = [info("a", period=0.3)]
    for t in range(12):
        mission.append(truth(t, [1], [[0.0, 0.0]]))
        mission.append(tracks("a", t, [9] if t % 2 == 0 else [], [[0.0, 0.0]] if t % 2 == 0 else []))
        mission.append(picture(t, [5], [[0.0, 0.0]]) if t >= 3 and t != 8 else picture(t, [], []))
    found = one(mission, need("tracked_through", seen=2, of=4, share_min=0.5))
    assert (found.whole.found, found.whole.samples) == (8 / 9, 9)
    assert one(mission, need("tracked_through", seen=3, of=4, share_min=0.5)).whole.samples == 0


def test_motion_after_some_time_is_one_sample_for_each_target() -> None:
    """Course and speed are right from 6 s on; a second target has its track for 3 s only."""
    mission: list[Message] = []
    for t in range(12):
        ids, places = (
            ([1, 2], [[10.0 * t, 10.0, 0.0, 0.0], [0.0, 0.0, 500.0, 5.0]])
            if t < 4
            else ([1], [[10.0 * t, 10.0, 0.0, 0.0]])
        )
        mission.append(truth(t, ids, places))
        speed = [10.5, 0.2] if t >= 6 else [10.5, 5.0]
        rows = [[10.0 * t, speed[0], 0.0, speed[1]], [0.0, 0.0, 500.0, 5.0]][: len(ids)]
        mission.append(picture(t, [5, 6][: len(ids)], rows))
    numbers: dict[str, Any] = {"course_within_deg": 5.0, "speed_within_m_per_s": 0.6, "share_min": 0.5}
    late = one(mission, need("motion_after", after_s=6.0, **numbers))
    assert (late.whole.found, late.whole.samples) == (1.0, 1)
    early = one(mission, need("motion_after", after_s=3.0, **numbers))
    assert (early.whole.found, early.whole.samples) == (0.5, 2)
    tight = one(mission, need("motion_after", after_s=6.0, **numbers | {"speed_within_m_per_s": 0.1}))
    assert tight.whole.found == 0.0
    share = one(
        mission, need("motion_after", after_s=6.0, or_speed_share=0.06, **numbers | {"speed_within_m_per_s": 0.1})
    )
    assert share.whole.found == 1.0


def test_areas_hold_by_place_and_height_in_metres_and_degrees() -> None:
    """A target flies east and climbs, 10 m/s each; it is in the disk for 6 of 11 times and high enough for 5."""
    xyz = ("x", "y", "z")
    mission: list[Message] = []
    for t in range(11):
        place = np.array([[10.0 * t, 0.0, 10.0 * t]])
        mission.append(truth(t, [1], [], means=place, space=xyz))
        mission.append(picture(t, [5], [[10.0 * t, 0.0]]))
    for area, times in (
        (Area("a", disk=(0.0, 0.0), radius=55.0), 6),
        (Area("a", disk=(FRAME.lat, FRAME.lon), radius=55.0, degrees=True), 6),
        (Area("a", polygon=((-5.0, -5.0), (25.0, -5.0), (25.0, 5.0), (-5.0, 5.0))), 3),
        (
            Area(
                "a",
                polygon=((59.9, 9.9), (59.9, 10.0 + 25.0 / 55800), (60.1, 10.0 + 25.0 / 55800), (60.1, 9.9)),
                degrees=True,
            ),
            3,
        ),
        (Area("a", heights=(55.0, 1000.0)), 5),
        (Area("a", disk=(0.0, 0.0), radius=75.0, heights=(55.0, 1000.0)), 2),
    ):
        found = one(mission, need("detection", share_min=0.1, area="a"), [area])
        assert found.whole.samples == times, area
    flat: list[Message] = [message for message in mission if not isinstance(message, Truth)]
    flat += [truth(t, [1], [[10.0 * t, 0.0]]) for t in range(11)]
    with pytest.raises(ReviewError, match="heights"):
        one(flat, need("detection", share_min=0.1, area="a"), [Area("a", heights=(0.0, 1.0))])


def test_an_earth_centred_picture_is_level_at_the_place() -> None:
    """30 m north of the target by pymap3d, in ECEF: all of it across an eastward course."""
    import pymap3d

    xyz = ("x", "y", "z", "vx", "vy", "vz")
    lat, lon = 60.0, 10.0

    def state(north: float, t: int) -> np.ndarray[Any, Any]:
        place = pymap3d.enu2ecef(20.0 * t, north, 100.0, lat, lon, 0.0)
        return np.array([[*place, *pymap3d.enu2uvw(20.0, 0.0, 0.0, lat, lon)]])

    mission: list[Message] = []
    for t in range(5):
        mission.append(truth(t, [1], [], means=state(0.0, t), space=xyz, frame=Ecef()))
        mission.append(picture(t, [5], [], means=state(30.0, t), space=xyz, frame=Ecef()))
    for direction, value in (("across", 30.0), ("along", 0.0), ("height", 0.0)):
        found = one(mission, need("position_error", rms_max_m=50.0, direction=direction), c=100.0)
        assert found.whole.found == pytest.approx(value, abs=2e-2)


def test_a_crowd_counts_as_a_few_do() -> None:
    """Of 60 targets on a line 50 have a track, 6 m off; 10 tracks are far from all."""
    places = [[100.0 * one, 0.0] for one in range(60)]
    shown = [[100.0 * one, 6.0] for one in range(50)] + [[100.0 * one, 5000.0] for one in range(10)]
    mission: list[Message] = []
    for t in range(3):
        mission += [truth(t, list(range(60)), places), picture(t, list(range(100, 160)), shown)]
    assert one(mission, need("detection", share_min=0.1)).whole.found == 50 / 60
    assert one(mission, need("false_tracks", share_max=0.5)).whole.found == 10 / 60
    assert one(mission, need("false_tracks", share_max=0.5, farther_than_m=5001.0)).whole.found == 0.0
    assert one(mission, need("position_error", rms_max_m=9.0)).whole.found == pytest.approx(6.0)


def test_a_track_with_a_target_is_false_too_where_it_is_farther_than_that() -> None:
    """With a cut-off of 100 m the track 80 m off has the target, and is farther than 60 m from every one."""
    mission: list[Message] = [truth(t, [1], [[0.0, 0.0]]) for t in range(4)]
    mission += [picture(t, [5], [[80.0 if t < 1 else 3.0, 0.0]]) for t in range(4)]
    found = one(mission, need("false_tracks", share_max=0.5, farther_than_m=60.0), c=100.0)
    assert (found.whole.found, found.whole.samples) == (0.25, 4)
    found = one(mission, need("false_tracks", share_max=0.5), c=100.0)
    assert found.whole.found == 0.0


def test_where_truth_says_that_nobody_is_there_every_track_is_false() -> None:
    """A trial without any target, as false tracks are counted on."""
    mission: list[Message] = [truth(t, [], []) for t in range(5)]
    mission += [picture(t, [5], [[0.0, 0.0]]) if t < 2 else picture(t, [], []) for t in range(5)]
    found = one(mission, need("false_tracks", share_max=0.5), c=100.0)
    assert (found.whole.found, found.whole.samples) == (1.0, 2)
    assert one(mission, need("detection", share_min=0.5)).whole.samples == 0
    scored = assess(Logbook(mission), c=100.0)
    assert scored.unscored is None
    assert scored.evaluations["centre"].fused.gospa_false == pytest.approx(2 / 5 * 100.0**2 / 2)
    assert text([scored]).startswith("Truth tells of no target; fused tracks (ci) were shown 2 times.")


def test_of_a_target_that_nobody_ever_tracked_all_updates_are_missing() -> None:
    """16 s of 8 s each: two are expected, none came."""
    found = one(lone(16, []), need("gap", longer_than_s=10.0, interval_s=8.0, share_max=0.5))
    assert (found.whole.found, found.whole.samples) == (1.0, 2)
