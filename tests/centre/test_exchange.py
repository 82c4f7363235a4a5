"""Centres that exchange their pictures: neither double-counting nor silent, and no target lives on their word alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre
from fusion_service.config import ConfigError, centre_config
from tests.centre.exchange import MESH, PAIR, RING, TREE, Network, Score, scores
from tests.centre.worlds import SECOND, START, centre, give, info, step, tracks, truth

SIGMAS: dict[str, tuple[tuple[float, float], ...]] = {
    "A": ((10, 40), (30, 30)),
    "B": ((40, 10), (25, 25)),
    "C": ((15, 15), (50, 20)),
    "top": (),
}
GRAPHS: dict[str, Mapping[str, Sequence[str]]] = {"pair": PAIR, "tree": TREE, "ring": RING, "mesh": MESH}


def network(graph: str, **given: Any) -> Network:
    hears = GRAPHS[graph]
    return Network(hears, {name: SIGMAS[name] for name in hears}, **given)


def honest(found: Mapping[str, Score]) -> None:
    """The stated covariance covers the true one in every direction, within three standard errors."""
    for name, score in found.items():
        assert score.worst <= 1.05 + 3 * score.error, (name, score)


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("graph", "steps"),
    [
        pytest.param("pair", 300, marks=SLOW),
        ("pair", 70),
        pytest.param("tree", 120, marks=SLOW),
        pytest.param("ring", 120, marks=SLOW),
    ],
)
def test_every_centre_is_honest_and_no_worse_than_alone(graph: str, steps: int) -> None:
    """Unequal sensors: what one centre sees badly the other sees well."""
    together = scores(network(graph, targets=40, seed=3), steps)
    alone = scores(network(graph, targets=40, seed=3, exchange=False), 60) if graph != "tree" else together
    print({name: (score, alone[name].rmse) for name, score in together.items()})
    honest(together)
    for name, score in together.items():
        assert score.rmse <= 1.02 * alone[name].rmse, name
    if graph == "tree":
        assert together["top"].rmse < 0.9 * min(together["A"].rmse, together["B"].rmse)
    else:
        assert together["A"].rmse < 0.75 * alone["A"].rmse, "it hears nothing"


@pytest.mark.parametrize("graph", ["tree", pytest.param("mesh", marks=SLOW)])
def test_a_rule_for_independent_tracks_counts_nothing_twice(graph: str) -> None:
    """Sensors that say a new, independent measurement each time: the naive rule is exact for one centre, and, where
    pictures do not say what is in them, far too sure for three."""
    given: dict[str, Any] = {"targets": 40, "q": 0.0, "seed": 5, "config": {"rule": "naive"}}
    together = scores(network(graph, **given), 60, skip=10)
    print(together)
    honest(together)
    if graph == "mesh":
        blind = scores(network(graph, **given, told=False), 60, skip=10)
        assert min(score.worst for score in blind.values()) > 1.5
        alone = scores(network(graph, **given, exchange=False), 30, skip=10)
        assert all(score.rmse < alone[name].rmse for name, score in together.items())
    else:
        assert together["top"].nees == pytest.approx(1.0, abs=0.06), "the two branches have nothing in common"


@pytest.mark.parametrize(
    ("graph", "coasting", "config"),
    [
        pytest.param("pair", True, {}, marks=SLOW),
        ("pair", False, {"memory": "recursive"}),
        ("tree", True, {}),
        pytest.param("ring", False, {}, marks=SLOW),
        ("ring", True, {"memory": "recursive"}),
        ("mesh", True, {"rule": "naive", "min_existence": 0.1}),
    ],
)
def test_a_dead_target_is_gone_in_bounded_time(graph: str, config: dict[str, Any], coasting: bool) -> None:
    """Whether its sensors drop it, or list it on without a measurement: `coast` (5 s), what the reports are overdue by,
    and one exchange on the longest way."""
    made = network(graph, targets=6, config=config)
    for _ in range(12):
        made.step()
    assert all(length[-1] == 6 for length in made.lengths.values())
    made.alive[:2], made.coasting, made.lost = False, coasting, START + made.second * SECOND
    for _ in range(14):
        made.step()
    assert all(length[-1] == 4 for length in made.lengths.values())
    for _ in range(12):
        made.step()
    assert all(length[-12:] == [4] * 12 for length in made.lengths.values()), "a ghost"


@pytest.mark.parametrize("memory", ["restart", "recursive"])
def test_a_target_of_one_centre_is_in_the_pictures_of_all_and_comes_back_after_a_restart(memory: str) -> None:
    made = Network(RING, {"A": SIGMAS["A"], "B": (), "C": ()}, targets=5, config={"memory": memory})
    for _ in range(12):
        made.step()
    assert all(length[-1] == 5 for length in made.lengths.values())
    made.centres["B"] = FusionCentre(made.centres["B"].config, epoch=START + 12 * SECOND)  # without a checkpoint
    for _ in range(12):
        made.step()
    for name, picture in made.pictures.items():
        assert len(picture.ids) == 5, name
        assert set(picture.lineage or ()) >= {"A0", "A1", "A"}
        assert (picture.status == 1).all()


def test_clutter_of_one_sensor_is_not_confirmed_by_its_own_echo() -> None:
    """Two sources at once confirm a track; a row that says again what the centre said is no second source."""
    slow = {"confirm_hits": 4, "confirm_within": 6}
    made = Network(PAIR, {"A": ((10, 10),), "B": ()}, targets=3, config=slow)
    first = made.step()["A"]
    assert (first.status == 0).all()
    made.alive[:] = False
    made.coasting = True
    made.lost = START + SECOND
    for _ in range(4):
        pictures = made.step()
        assert not any((picture.status == 1).any() for picture in pictures.values())
    assert len(pictures["B"].ids) == 3


def pair_of(rule: str = "ci") -> tuple[FusionCentre, FusionCentre]:
    """Two centres that hear each other, one with a source r and one with s."""
    made = []
    for name, other, source in (("A", "B", "r"), ("B", "A", "s")):
        made.append(FusionCentre({"name": name, "rule": rule, "lateness": 3.0, "sources": {f"global/{other}": {}}}))
        give(made[-1], info(source))
    return made[0], made[1]


def test_what_each_track_contains_is_published_and_order_of_arrival_changes_nothing() -> None:
    states = truth(3)
    first, second = pair_of()
    give(second, tracks("s", 1, states[:2]))
    heard = step(second, 1).tracks
    assert (heard.lineage, heard.track_lineage.tolist()) == (("s", "B"), [[3], [3]])  # type: ignore[union-attr]
    mine = tracks("r", 1, states[2:])
    give(first, heard, mine)
    made = step(first, 2).tracks
    assert made.lineage == ("B", "r", "s", "A")
    by_place = dict(zip(np.rint(made.means[:, 0]).tolist(), made.track_lineage.tolist(), strict=True))  # type: ignore[union-attr]
    assert by_place[np.rint(states[2, 0] + states[2, 2])] == [0b1010], "of its own sensor"
    assert by_place[np.rint(states[0, 0] + states[0, 2])] == [0b1101], "of the other centre"
    assert made.sources == ("global/B", "r")
    again, _ = pair_of()
    give(again, mine, heard)
    assert schemas.encode(step(again, 2).tracks) == schemas.encode(made)


def test_its_own_picture_and_those_of_centres_that_it_does_not_know_are_refused() -> None:
    first, second = pair_of()
    give(second, tracks("s", 1, truth(2)))
    heard = step(second, 1).tracks
    assert len(heard.ids) == 2
    give(first, replace(heard, source="A"), replace(heard, source="C"), replace(heard, existence=heard.existence[:1]))
    result = step(first, 2)
    assert result.status.refused == {"loop": 1, "type": 2}
    assert len(result.tracks.ids) == 0
    with pytest.raises(ConfigError, match=r'sources\."global/A": is this centre itself'):
        centre_config({"name": "A", "sources": {"global/A": {}}})
    with pytest.raises(ConfigError, match="bad name"):
        centre_config({"sources": {"global/a/b": {}}})
    assert centre_config({"motion": schemas.Motion("cv", 9.0), "sources": {"global/B": {}, "r": {}}}).sources == {
        "global/B": replace(centre_config({}).source_defaults, motion=schemas.Motion("cv", 9.0)),
        "r": centre_config({}).source_defaults,
    }


def test_a_centre_from_its_checkpoint_goes_on_as_the_same() -> None:
    for memory in ("restart", "recursive"):
        made = network("ring", targets=5, config={"memory": memory, "rule": "naive"})
        for _ in range(6):
            made.step()
        other = FusionCentre(made.centres["A"].config, made.centres["A"].checkpoint())
        twin = FusionCentre(made.centres["A"].config, made.centres["A"].checkpoint())
        pictures = made.pictures
        for at, one in ((7, other), (7, twin)):
            give(one, pictures["C"], *(made._report(f"A{k}", START + 7 * SECOND) for k in range(2)))
            step(one, at)
        assert other.checkpoint() == twin.checkpoint()
        made.centres["A"] = other
        assert set(made.pictures["A"].lineage or ()) == {"A", "A0", "A1", "B", "B0", "B1", "C", "C0", "C1"}


def test_the_memory_keeps_the_lineage_of_all_that_was_ever_fused() -> None:
    for memory, kept in (("restart", ("r1", "centre")), ("recursive", ("r1", "r2", "centre"))):
        made = centre(("r1", "r2"), memory=memory)
        states = truth(1)
        give(made, tracks("r1", 1, states), tracks("r2", 1, states))
        step(made, 1)
        for second in (2, 3):
            give(made, tracks("r1", second, states), tracks("r2", second, [], []))
            picture = step(made, second).tracks
        names = np.array(picture.lineage)
        assert picture.track_lineage is not None
        bits = np.unpackbits(picture.track_lineage[0], bitorder="little")[: len(names)].astype(bool)
        assert tuple(names[bits]) == kept


def test_identity_and_class_are_heard_once() -> None:
    """A centre that hears its own word from another one grows no surer of it."""
    surest = {}
    for exchange in (True, False):
        first, second = pair_of()
        states = truth(1)
        told: dict[int, schemas.GlobalTracks] = {}
        for at in range(1, 12):
            give(first, tracks("r", at, states, kind=("boat",), kind_p=np.array([0.6])))
            give(second, tracks("s", at, states))
            if exchange and told:
                give(first, told[1])
                give(second, told[0])
            told = {0: step(first, at).tracks, 1: step(second, at).tracks}
        surest[exchange] = told[0].kind_p
        assert not exchange or told[1].kind == ("boat",)
    np.testing.assert_array_equal(surest[True], surest[False])
