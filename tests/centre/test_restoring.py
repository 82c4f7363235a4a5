"""The config wins over a checkpoint: what it states holds; what the checkpoint keeps is data and orders.

Moved places are compared with the WGS84 conversions of single points.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import msgpack
import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre, IntensityCentre, Order
from fusion_service.centre.checkpoint import CheckpointError
from fusion_service.geodesy import enu_to_geodetic, geodetic_to_enu
from tests.centre.worlds import FRAME, centre, give, info, moved, step, tracks, truth

OTHER = schemas.Enu(59.1, -55.2)


def flown(**config: Any) -> FusionCentre:
    made = centre(("r1", "r2"), **config)
    for second in (1, 2, 3):
        give(made, *(tracks(name, second, moved(truth(4), second)) for name in ("r1", "r2")))
        step(made, second)
    return made


def enu(frame: schemas.Enu) -> dict[str, Any]:
    return {"kind": "enu", "lat": frame.lat, "lon": frame.lon}


def test_ignore_in_the_config_is_not_overruled_by_an_old_checkpoint() -> None:
    made = flown()
    give(made, Order("mute", "r1"), Order("unmute", "r1"))
    step(made, 4)
    again = FusionCentre({"lateness": 3.0, "sources": {"r1": {"ignore": True}}}, made.checkpoint())
    give(again, tracks("r1", 5, truth(4)), tracks("r2", 5, truth(4)))
    assert step(again, 5).status.refused == {"muted": 1}
    # nor is what it said before kept when it says so no more; an order is
    later = FusionCentre({"lateness": 3.0}, again.checkpoint())
    give(later, tracks("r1", 6, truth(4)))
    assert step(later, 6).status.refused == {}
    give(later, Order("mute", "r2"))
    step(later, 7)
    last = FusionCentre({"lateness": 3.0}, later.checkpoint())
    give(last, tracks("r2", 8, truth(4)))
    assert step(last, 8).status.refused == {"muted": 1}


def test_a_picture_in_another_frame_is_moved_with_its_ids() -> None:
    made = flown()
    before = step(made, 4).tracks
    again = FusionCentre({"lateness": 3.0, "frame": enu(OTHER)}, made.checkpoint(), generation=3)
    after = step(again, 5).tracks
    assert after.frame == OTHER
    assert after.ids.tolist() == before.ids.tolist()
    assert (after.contributor_counts == 2).all()
    for row in range(4):
        x, y = before.means[row, :2] + before.means[row, 2:]
        lat, lon, _ = enu_to_geodetic(x, y, 0.0, FRAME)
        place = np.array(geodetic_to_enu(lat, lon, 0.0, OTHER)[:2])
        # 20 km from the origin the surface lies 30 m below the plane: some metres of difference in x, y and v
        assert np.linalg.norm(after.means[row, :2] - place) < 5.0
    # the picture alone, coasting, is moved too
    blind = FusionCentre({"lateness": 0.0, "frame": enu(OTHER), "coast": 100.0}, made.checkpoint())
    coasting = step(blind, 20).tracks
    assert coasting.ids.tolist() == before.ids.tolist()
    assert (coasting.contributor_counts == 0).all()
    for row in range(4):
        x, y = before.means[row, :2] + 16 * before.means[row, 2:]
        lat, lon, _ = enu_to_geodetic(x, y, 0.0, FRAME)
        assert np.linalg.norm(coasting.means[row, :2] - np.array(geodetic_to_enu(lat, lon, 0.0, OTHER)[:2])) < 30.0


def test_what_cannot_be_moved_is_left_out_and_its_ids_are_not_used_again() -> None:
    made = flown()
    before = step(made, 4).tracks.ids.tolist()
    again = FusionCentre({"lateness": 3.0, "frame": {"kind": "local", "name": "dock"}}, made.checkpoint())
    assert step(again, 5).tracks.ids.tolist() == []
    give(again, tracks("r1", 6, truth(4), frame=schemas.Local("dock")))
    new = step(again, 6).tracks.ids.tolist()
    assert len(new) == 4
    assert not set(new) & set(before)


@pytest.mark.parametrize("space", [("x", "y"), ("vy", "y", "x", "vx")])
def test_a_picture_in_fewer_components_or_another_order_keeps_ids_and_moments(space: tuple[str, ...]) -> None:
    made = flown()
    before = step(made, 4).tracks
    again = FusionCentre({"lateness": 0.0, "space": list(space), "coast": 100.0}, made.checkpoint())
    after = step(again, 4.5).tracks
    assert after.ids.tolist() == before.ids.tolist()
    assert (after.contributor_counts == 2).all()
    assert after.space == space
    at = [before.space.index(name) for name in ("x", "y")]
    to = [space.index(name) for name in ("x", "y")]
    ahead = before.means[:, :2] + 0.5 * before.means[:, 2:]
    np.testing.assert_allclose(after.means[:, to], ahead[:, at], atol=1e-6)


def test_components_that_only_the_config_has_are_unknown_and_ids_go_on() -> None:
    made = flown()
    before = step(made, 4).tracks
    wanted = ("x", "y", "z", "vx", "vy", "vz")
    again = FusionCentre({"lateness": 3.0, "space": list(wanted), "coast": 100.0}, made.checkpoint())
    after = step(again, 5).tracks
    assert after.ids.tolist() == before.ids.tolist()
    assert (after.contributor_counts == before.contributor_counts).all()  # with what they have
    at = [wanted.index(name) for name in before.space]
    ahead = moved(before.means, 1.0)
    np.testing.assert_allclose(after.means[:, at], ahead, atol=1e-6)
    assert (np.sqrt(after.covariances[:, 2, 2]) >= 1e6).all()
    # a source that has them joins, and height comes in
    states = np.concatenate([ahead[:, :2], np.full((4, 1), 50.0), ahead[:, 2:], np.zeros((4, 1))], axis=1)
    sigma = np.diag([30.0, 30.0, 30.0, 2.0, 2.0, 2.0]) ** 2
    covariances = np.tile(sigma, (4, 1, 1))
    message = dataclasses.replace(tracks("r3", 5, ahead), space=wanted, means=states, covariances=covariances)
    give(again, info("r3"), message)
    taken = step(again, 6).tracks
    assert taken.ids.tolist() == before.ids.tolist()
    assert (taken.contributor_counts == 3).all()
    np.testing.assert_allclose(taken.means[:, 2], 50.0, atol=1.0)


def test_a_checkpoint_of_the_release_before_is_read() -> None:
    """It has no intervals, nothing remembered, no votes, no era."""
    made = flown()
    whole = msgpack.unpackb(made.checkpoint())
    for name in ("era", "frame_asked"):
        del whole[name]
    for packed in whole["sources"].values():
        for name in ("interval", "ordered", "why", "unused", "remembered", "vote"):
            packed.pop(name, None)
        del packed["tracks"]["interval"]
    again = FusionCentre({"lateness": 3.0}, msgpack.packb(whole))
    give(again, *(tracks(name, 4, moved(truth(4), 4)) for name in ("r1", "r2")))
    give(made, *(tracks(name, 4, moved(truth(4), 4)) for name in ("r1", "r2")))
    one, two = step(again, 4).tracks, step(made, 4).tracks
    assert one.ids.tolist() == two.ids.tolist()
    np.testing.assert_array_equal(one.means, two.means)
    with pytest.raises(CheckpointError, match="fuses tracks"):
        IntensityCentre({}, msgpack.packb(whole))
