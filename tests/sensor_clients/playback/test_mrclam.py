"""MR.CLAM playback: how a robot finds its place, what it says of itself and others, files that cannot be read, and
(with FUSION_DATA) the data."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest

from fusion_service.errors import DataError
from fusion_service.metrics import nees
from fusion_service.process import data_folder
from schemas import LocalTracks, SensorInfo, Truth
from sensor_clients.events import Event
from sensor_clients.filters.measurement import Floats
from sensor_clients.playback import mrclam
from sensor_clients.playback.own_place import OwnPlace, Pose
from sensor_clients.playback.robot import MRCLAM, Sight
from sensor_clients.playback.sighted import Others
from studies.missions import as_messages

SECOND = 10**9
BEGIN = 1_000_000.0
LANDMARKS = {
    6: (0.0, 0.0),
    7: (0.1, 0.2),
    8: (6.0, 0.5),
    9: (6.0, 6.0),
    10: (0.3, 5.0),
    11: (3.0, 7.5),
    12: (3.0, -1.5),
}
SECONDS = 120


def true_pose(n: int, t: float) -> Floats:
    """Robot n drives round a circle of its own at 0.06 m/s: x, y, heading."""
    radius = 0.8 + 0.15 * n
    phase = 1.2 * n + 0.06 / radius * t
    centre = np.array([2.0 + 0.4 * n, 2.0 + 0.5 * (n % 3)])
    return np.array([*(centre + radius * np.array([math.cos(phase), math.sin(phase)])), phase + math.pi / 2])


def sight(pose: Floats, place: Floats) -> tuple[float, float]:
    away = place - pose[:2]
    return math.hypot(*away), (math.atan2(away[1], away[0]) - pose[2] + math.pi) % (2 * math.pi) - math.pi


def write(folder: Path, seed: int) -> Path:
    """A small set in the format of the data: sightings twice a second of all within 1 rad, errors that last 5 s as
    the model says, an odometry 6 % too fast with errors as the model says, one barcode in a hundred read as another
    robot's."""
    rng = np.random.default_rng(seed)
    print("seed", seed)
    (folder / "6").mkdir(parents=True)
    rows = [f"{number},{x},{y}" for number, (x, y) in LANDMARKS.items()]
    (folder / "6" / "landmarks.csv").write_text("\n".join(["subject,x,y", *rows]) + "\n")
    keep = math.exp(-0.5 / 5.0)
    for n in range(1, 6):
        turn = 0.06 / (0.8 + 0.15 * n)
        said = 1.06 * np.array([0.06, turn]) + rng.standard_normal((4 * SECONDS, 2)) * [
            2 * MRCLAM.walk,
            2 * math.hypot(MRCLAM.turn_walk, MRCLAM.slip * turn),
        ]
        odometry = [f"{BEGIN + k / 4},{speed},{rate}" for k, (speed, rate) in enumerate(said.tolist())]
        truth = [f"{BEGIN + k / 10},{','.join(map(str, true_pose(n, k / 10)))}" for k in range(10 * SECONDS + 1)]
        errors = {subject: rng.standard_normal(2) for subject in (*range(1, 6), *LANDMARKS)}
        seen = []
        for k in range(2 * SECONDS):
            t = k / 2
            pose = true_pose(n, t)
            for subject in errors:
                errors[subject] = keep * errors[subject] + math.sqrt(1 - keep**2) * rng.standard_normal(2)
                place = true_pose(subject, t)[:2] if subject < 6 else np.array(LANDMARKS[subject])
                r, angle = sight(pose, place)
                if subject == n or abs(angle) > 1.0:
                    continue
                sigma = np.sqrt(MRCLAM.noise(np.array(r)))
                r, angle = np.array([r, angle]) + sigma * errors[subject]
                read = subject
                if subject < 6 and rng.random() < 0.01:
                    read = next(other for other in range(1, 6) if other not in (n, subject))
                seen.append(f"{BEGIN + t},{read},{r},{angle}")
        for kind, head, lines in (
            ("odometry", "time,speed,turn_rate", odometry),
            ("seen", "time,subject,range,bearing", seen),
            ("truth", "time,x,y,heading", truth),
        ):
            (folder / "6" / f"robot{n}_{kind}.csv").write_text("\n".join([head, *lines]) + "\n")
    return folder


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("mrclam"), seed=3)


def consistency(events: list[Event], shift: bool) -> tuple[Floats, Floats, Floats]:
    """Position errors (K, 2), covariances (K, 2, 2) with the common shift told last, and the robots (K,) meant."""
    errors, covariances, robots = [], [], []
    common = np.zeros((2, 2))
    for event in events:
        if event.kind == "info":
            common = event.fields["position_covariance"][:2, :2] if shift else common
            continue
        for identity, mean, covariance in zip(
            event.fields["identity"], event.fields["means"], event.fields["covariances"], strict=True
        ):
            robot = int(identity.removeprefix("robot:"))
            errors.append(mean[:2] - true_pose(robot, event.time / SECOND - BEGIN)[:2])
            covariances.append(covariance[:2, :2] + common)
            robots.append(robot)
    return np.array(errors), np.array(covariances), np.array(robots)


def test_robots_find_themselves_and_are_honest(data: Path) -> None:
    scenario = mrclam.load(data, 6)
    scores = []
    for n in range(1, 6):
        events = list(scenario.sensors[f"robot{n}-self"](0))
        assert all("position_covariance" not in event.fields for event in events), "nothing is to be added"
        errors, covariances, robots = consistency(events, shift=False)
        assert (robots == n).all()
        assert len(errors) > SECONDS / 2
        assert np.sqrt((errors**2).sum(axis=1).mean()) < 0.2
        scores.append(nees(errors, covariances).mean() / 2)
    print("NEES of the own place", scores)
    assert 0.3 < np.mean(scores) < 1.4


def test_what_they_say_of_others_is_honest_with_the_common_shift(data: Path) -> None:
    scenario = mrclam.load(data, 6)
    scores, without = [], []
    for n in range(1, 6):
        events = list(scenario.sensors[f"robot{n}"](0))
        errors, covariances, robots = consistency(events, shift=True)
        assert n not in robots
        scores += nees(errors, covariances).tolist()
        without += nees(*consistency(events, shift=False)[:2]).tolist()
    print("NEES of others", np.mean(scores) / 2, np.mean(without) / 2)
    assert len(scores) > 3 * SECONDS
    assert 0.3 < np.mean(scores) / 2 < 1.4
    assert np.mean(without) > 1.1 * np.mean(scores)


def test_messages_can_be_sent_and_read(data: Path) -> None:
    scenario = mrclam.load(data, 6)
    assert (scenario.name, scenario.origin) == ("mrclam:6", "replay")
    assert tuple(scenario.sensors) == mrclam.SENSORS
    for name in ("robot2", "robot2-self"):
        messages = list(as_messages(name, scenario.sensors[name](0), "replay"))
        infos = [one for one in messages if isinstance(one, SensorInfo)]
        tracks = [one for one in messages if isinstance(one, LocalTracks)]
        assert messages[0] is infos[0]
        assert len(infos) > 10, "it drives, so it says again where it is"
        assert all(one.correlation_group == "robot2" for one in infos)
        assert {one.time % SECOND for one in tracks} == {0}
        assert (np.diff([one.time for one in tracks]) == SECOND).all()
        assert all((one.updated is not None and (one.updated <= one.time).all()) for one in tracks)
    truth = list(as_messages("truth", scenario.truth(), "replay"))
    assert all(isinstance(one, Truth) and one.ids.tolist() == [1, 2, 3, 4, 5] for one in truth)
    for one in truth[:: len(truth) // 7]:
        expected = [true_pose(n, one.time / SECOND - BEGIN)[:2] for n in range(1, 6)]
        np.testing.assert_allclose(one.means, expected, atol=1e-4)


def test_the_parts_of_the_poses_error_make_the_whole() -> None:
    rng = np.random.default_rng(7)
    for _ in range(20):
        root = rng.standard_normal((3, 3))
        pose = Pose(rng.standard_normal(3), root @ root.T)
        place = 5 * rng.standard_normal(2)
        x, y = place - pose.mean[:2]
        J = np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])  # place = p + turned(heading) sight
        np.testing.assert_allclose(pose.common + pose.turning(place), J @ pose.covariance @ J.T, atol=1e-9)
        assert np.linalg.eigvalsh(pose.common)[0] > 0


def test_repeated_sightings_count_as_a_markov_error_does() -> None:
    for dt, count in ((0.2, 30), (1.0, 8), (20.0, 4)):
        lag = dt * np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
        R = np.exp(-lag / MRCLAM.correlated)
        exact = np.ones(count) @ np.linalg.solve(R, np.ones(count))  # information on a constant
        assert 1 + (count - 1) / MRCLAM.repeated(dt) == pytest.approx(exact)


def test_a_sights_jacobian_and_place() -> None:
    model = Sight(MRCLAM, (1.0, -2.0), 0.7)
    place = np.array([[3.0, -1.0], [1.0, -4.0]])
    step = 1e-6
    for axis in range(2):
        moved = place.copy()
        moved[axis] += step
        slope = model.difference(model.observe(moved), model.observe(place)) / step
        np.testing.assert_allclose(model.jacobian(place)[:, axis], slope, atol=1e-5)
    mean, covariance = model.locate(model.observe(place))
    np.testing.assert_allclose(mean, place, atol=1e-12)
    for k in range(2):
        H = model.jacobian(place)[..., k]
        np.testing.assert_allclose(H @ covariance[..., k] @ H.T, model.noise(place)[..., k], atol=1e-12)


def test_it_starts_from_what_it_sees_and_gives_up_when_that_is_contradicted() -> None:
    landmarks = {number: np.array(place) for number, place in LANDMARKS.items()}
    own = OwnPlace(MRCLAM, landmarks)
    pose = np.array([2.0, 3.0, 2.5])
    for k, number in enumerate((6, 7)):
        own.see(k, number, *sight(pose, landmarks[number]))
        assert own.pose() is None, "one group of barcodes leaves a circle"
    own.see(2, 9, *sight(pose, landmarks[9]))
    found = own.pose()
    assert found is not None
    np.testing.assert_allclose(found.mean[:2], pose[:2], atol=1e-6)
    assert math.cos(found.mean[2] - pose[2]) == pytest.approx(1.0)
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()
    elsewhere = np.array([5.0, 1.0, -1.0])
    for k in range(MRCLAM.lost):
        assert own.pose() is not None
        own.see(3 + k, 9, *sight(elsewhere, landmarks[9]))
    assert own.pose() is None
    assert own.state() is None
    for k, number in enumerate((6, 9, 10)):
        own.see(10**9 + k, number, *sight(elsewhere, landmarks[number]))
    found = own.pose()
    assert found is not None
    np.testing.assert_allclose(found.mean[:2], elsewhere[:2], atol=1e-6)


def test_a_start_that_contradicts_itself_waits() -> None:
    landmarks = {number: np.array(place) for number, place in LANDMARKS.items()}
    own = OwnPlace(MRCLAM, landmarks)
    pose = np.array([2.0, 3.0, 2.5])
    own.see(0, 8, *sight(pose, landmarks[11]))  # misread
    for k, number in enumerate((6, 9)):
        own.see(k, number, *sight(pose, landmarks[number]))
    assert own.pose() is None
    own.see(3, 10, *sight(pose, landmarks[10]))
    found = own.pose()
    assert found is not None
    np.testing.assert_allclose(found.mean[:2], pose[:2], atol=1e-6)


def test_a_misread_barcode_moves_no_track_and_makes_none() -> None:
    others, pose = Others(MRCLAM), Pose(np.zeros(3), np.diag([0.01, 0.01, 1e-4]))
    for k in range(MRCLAM.confirm):
        assert not others.report(k * SECOND, pose.common).subjects
        others.see(k * SECOND, 2, 3.0, 0.1, pose)
    before = others.report(5 * SECOND, pose.common)
    assert before.subjects == [2]
    others.see(5 * SECOND, 2, 3.0, 1.0, pose)
    others.see(5 * SECOND, 4, 1.0, -1.0, pose)
    after = others.report(5 * SECOND, pose.common)
    assert others.refused == 1
    assert (after.subjects, after.ids.tolist()) == ([2], before.ids.tolist())
    np.testing.assert_array_equal(after.means, before.means)
    for k in range(MRCLAM.strikes + MRCLAM.confirm):
        others.see((6 + k) * SECOND, 2, 3.0, 1.0, pose)
    moved = others.report(15 * SECOND, pose.common)
    assert moved.subjects == [2]
    assert moved.ids[0] > before.ids[0], "what comes after is another track"
    others.report(60 * SECOND, pose.common)
    assert not others.report(60 * SECOND, pose.common).subjects, "too vague to tell"


def test_a_track_seen_from_a_vaguer_pose_keeps_the_difference() -> None:
    others = Others(MRCLAM)
    vague, sure = (Pose(np.zeros(3), np.diag([s, s, 1e-4])) for s in (0.09, 0.01))
    for k in range(MRCLAM.confirm):
        others.see(k * SECOND, 2, 3.0, 0.1, vague)
    then, now = (others.report(2 * SECOND, pose.common).covariances[0, :2, :2] for pose in (vague, sure))
    np.testing.assert_allclose(then + vague.common, now + sure.common, atol=1e-12)


def test_what_cannot_be_read_is_said_with_its_line(data: Path, tmp_path: Path) -> None:
    folder = tmp_path / "6"
    folder.mkdir()
    for path in (data / "6").iterdir():
        (folder / path.name).write_text(path.read_text())
    seen = folder / "robot3_seen.csv"
    text = seen.read_text()
    for line, says in (
        ("1000000.0,2,here,0", "cannot be read"),
        ("1000000.0,2,nan,0", "not a finite number"),
        ("1000000.0,3,1.0,0", "cannot see subject 3"),
        ("1000000.0,99,1.0,0", "cannot see subject 99"),
    ):
        seen.write_text(text + line + "\n")
        with pytest.raises(DataError, match=says):
            mrclam.load(tmp_path, 6)
    seen.write_text("time,subject,range,bearing\n")
    with pytest.raises(DataError, match="no rows"):
        mrclam.load(tmp_path, 6)
    seen.unlink()
    with pytest.raises(FileNotFoundError, match=r"robot3_seen\.csv is not there"):
        mrclam.load(tmp_path, 6)


@pytest.mark.skipif("FUSION_DATA" not in os.environ, reason="set FUSION_DATA to the folder that holds mrclam")
@pytest.mark.parametrize("robots", [(1, 4), pytest.param((1, 2, 3, 4, 5), marks=pytest.mark.slow)], ids=len)
def test_on_the_data(robots: tuple[int, ...]) -> None:
    folder = data_folder("mrclam")
    if folder is None or not (folder / "6" / "landmarks.csv").is_file():
        pytest.skip("no mrclam/6 in FUSION_DATA")
    scenario = mrclam.load(folder, 6)
    truth = {event.time: event.fields for event in scenario.truth()}
    scores = []
    for n in robots:
        for event in scenario.sensors[f"robot{n}-self"](0):
            if event.kind == "tracks" and event.time in truth:
                fields = truth[event.time]
                error = event.fields["means"][0, :2] - fields["means"][fields["ids"].tolist().index(n)]
                scores.append([error @ error, float(nees(error, event.fields["covariances"][0, :2, :2])) / 2])
    squared, normalised = np.mean(scores, axis=0)
    assert len(scores) > 700 * len(robots)
    assert math.sqrt(squared) < 0.25
    assert 0.7 < normalised < 1.3
