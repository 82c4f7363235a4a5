"""What a message may say of an extent, a standard deviation of it, and a reference point."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import schemas
from schemas.extents import sound_extents, sound_offsets, sound_references, sound_sigmas
from tests.schemas.golden import GOLDEN, changed

NAN = np.nan


@pytest.mark.parametrize(
    ("extent", "sound"),
    [
        ((36.0, 9.6, 1.0), True),
        ((5.0, 5.0, -6.28), True),
        ((NAN, NAN, NAN), True),
        ((NAN, 9.6, NAN), True),
        ((1e4, 1e-3, NAN), True),
        ((0.0, NAN, NAN), False),
        ((-1.0, NAN, 0.0), False),
        ((1e4 + 1, 1.0, 0.0), False),
        ((5.0, 5.1, 0.0), False),
        ((5.0, 0.0, 0.0), False),
        ((NAN, 1e5, 0.0), False),
        ((np.inf, 1.0, 0.0), False),
        ((5.0, 1.0, 7.0), False),
        ((5.0, 1.0, np.inf), False),
    ],
)
def test_extents(extent: tuple[float, ...], sound: bool) -> None:
    assert sound_extents(np.array([extent])).tolist() == [sound]
    message = schemas.decode(GOLDEN["local_tracks_extent"])
    assert isinstance(message, schemas.LocalTracks)
    assert message.extent is not None
    columns = message.extent.copy()
    columns[1] = extent
    codes = schemas.check_numbers([replace(message, extent=columns)])[0]
    assert [schemas.FAULTS[code] for code in codes] == ["", "" if sound else "extent", ""]


def test_sigmas_offsets_and_references() -> None:
    assert sound_sigmas(np.array([[0, 1e4, NAN], [-1, 0, 0], [np.inf, 0, 0]])).tolist() == [True, False, False]
    assert sound_offsets(np.array([[-1e4, NAN], [1e5, 0]])).tolist() == [True, False]
    rng = np.random.default_rng(3)
    root = rng.normal(size=(200, 2, 2)) * rng.choice([1e-6, 1.0, 1e3], (200, 1, 1))
    root[:50, :, 1] = 0.0  # of one axis only
    covariances = root @ root.swapaxes(1, 2)
    assert sound_references(covariances).all()
    assert not sound_references(-covariances).any()
    indefinite = covariances.copy()
    indefinite[:, 1, 0] = 1.01 * np.sqrt(covariances[:, 0, 0] * covariances[:, 1, 1]) + 1e-9
    assert not sound_references(indefinite).any()
    assert sound_references(np.full((1, 2, 2), NAN)).all()
    assert not sound_references(np.array([[[1.0, NAN], [NAN, 1.0]], [[1e9, 0], [0, 1.0]]])).any()
    for one, shape in ((sound_extents, (0, 3)), (sound_offsets, (0, 2)), (sound_references, (0, 2, 2))):
        assert one(np.zeros(shape)).shape == (0,)


@pytest.mark.parametrize(
    ("name", "values", "reason"),
    [
        ("local_tracks_extent", {"extent": bytes(8 * 8)}, "length"),
        ("local_tracks_extent", {"extent_sigma": bytes(8)}, "length"),
        ("local_tracks_extent", {"reference_covs": bytes(8 * 8)}, "length"),
        ("local_tracks_extent", {"shape": "circle"}, "bad-field"),
        ("local_tracks_extent", {"shape": 1}, "bad-field"),
        ("local_tracks_extent", {"shape": []}, "bad-field"),
        ("local_tracks_extent", {"reference": "bow"}, "bad-field"),
        ("local_tracks_extent", {"extent": [1.0]}, "bad-field"),
        ("global_tracks_extent", {"extent": bytes(8 * 8)}, "length"),
        ("truth_extent", {"extent": bytes(8 * 5)}, "length"),
        ("truth_extent", {"extent_offset": bytes(8 * 6)}, "length"),
    ],
)
def test_what_does_not_fit_is_refused(name: str, values: dict[str, Any], reason: str) -> None:
    with pytest.raises(schemas.MessageError) as caught:
        schemas.decode(changed(name, **values))
    assert caught.value.reason == reason


def test_a_reference_that_is_not_symmetric_is_not_sent() -> None:
    message = schemas.decode(GOLDEN["local_tracks_extent"])
    assert isinstance(message, schemas.LocalTracks)
    assert message.reference_covariances is not None
    odd = message.reference_covariances.copy()
    odd[0, 0, 1] += 1.0
    with pytest.raises(schemas.MessageError, match="not symmetric"):
        schemas.encode(replace(message, reference_covariances=odd))
