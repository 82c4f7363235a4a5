"""What `encode` refuses and takes: a caller's slip is an error with a clear line, never a wrong message."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

import schemas
from tests.schemas.golden import GOLDEN, changed


def local(name: str = "local_tracks_full") -> schemas.LocalTracks:
    message = schemas.decode(GOLDEN[name])
    assert isinstance(message, schemas.LocalTracks)
    return message


def refused(message: Any) -> str:
    with pytest.raises(schemas.MessageError) as caught:
        schemas.encode(message)
    assert caught.value.reason in schemas.REASONS
    return str(caught.value)


def test_asymmetric_covariance_is_a_callers_error() -> None:
    message = local()
    for i, j in ((0, 1), (3, 1), (1, 3)):
        covariances = message.covariances.copy()
        covariances[0, i, j] += 1e-7
        text = refused(replace(message, covariances=covariances))
        assert text == "bad-field: local_tracks.covariances: not symmetric"
    covariances = message.covariances.copy()
    covariances[1, 0, 3] = np.nan
    assert "not symmetric" in refused(replace(message, covariances=covariances)), "a NaN only above the diagonal"


def test_rounding_is_no_asymmetry_and_numbers_are_not_the_codecs_matter() -> None:
    message = local()
    covariances = message.covariances.copy()
    covariances[0, 0, 1] *= 1 + 1e-13
    assert schemas.encode(replace(message, covariances=covariances)) == GOLDEN["local_tracks_full"]
    for bad in (np.nan, np.inf, -1.0):
        covariances = message.covariances.copy()
        covariances[0] = bad
        sent = schemas.decode(schemas.encode(replace(message, covariances=covariances)))
        assert isinstance(sent, schemas.LocalTracks)
        np.testing.assert_array_equal(sent.covariances, covariances)


def test_asymmetric_position_covariance_is_a_callers_error() -> None:
    info = schemas.decode(GOLDEN["sensor_info_disk"])
    assert isinstance(info, schemas.SensorInfo)
    assert "not symmetric" in refused(replace(info, position_covariance=np.array([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]])))


@pytest.mark.parametrize(
    ("attribute", "value"),
    [
        ("ids", np.array([1, -1, 2])),
        ("ids", np.array([1.5, 2.0, 3.0])),
        ("ids", np.array([1, 1, 2])),
        ("ids", np.array([[1, 2, 3]])),
        ("ids", None),
        ("counts", np.array([1, 1, 65536])),
        ("updated", np.array([2**63, 0, 0], dtype=np.uint64)),
        ("existence", ["a", "b", "c"]),
        ("means", np.zeros((4, 3))),
        ("means", np.zeros(12)),
        ("covariances", np.zeros((3, 4))),
        ("covariances", np.zeros((3, 3, 3))),
        ("covariances", np.zeros((3, 4, 5))),
        ("covariances", np.zeros((2, 4, 4))),
        ("space", ("x", "vx", "y", "speed")),
        ("source", "a b"),
        ("source", None),
        ("seq", -1),
        ("seq", 2**64),
        ("seq", np.int64(3)),
        ("complete", np.True_),
        ("frame", "enu"),
        ("identity", ("a",)),
        ("identity", (1, 2, 3)),
        ("origin", "dream"),
    ],
)
def test_encode_refuses_what_decode_would(attribute: str, value: Any) -> None:
    refused(replace(local(), **{attribute: value}))


def test_a_refusal_names_the_field() -> None:
    slips: dict[str, Any] = {"seq": np.int64(3), "epoch": 2**64, "complete": np.True_, "origin": {1, 2}}
    for attribute, value in slips.items():
        assert refused(replace(local(), **{attribute: value})).startswith(f"bad-field: local_tracks.{attribute}: ")


def test_encode_takes_any_integers_and_floats_that_fit() -> None:
    message = local("local_tracks_weights_only")
    other = replace(
        message,
        ids=message.ids.astype(np.int32),
        means=message.means.astype(np.float32),
        covariances=np.asfortranarray(message.covariances),
        weights=message.weights.astype(">f8") if message.weights is not None else None,
    )
    assert schemas.encode(other) == GOLDEN["local_tracks_weights_only"]
    assert schemas.digest(other) == schemas.digest(message)


def test_only_messages_are_encoded() -> None:
    assert refused("text").startswith("type: ")


@pytest.mark.parametrize("name", GOLDEN)
def test_decoded_arrays_are_read_only(name: str) -> None:
    message = schemas.decode(GOLDEN[name])
    holders: list[schemas.Message | schemas.Decisions] = [message]
    if isinstance(message, schemas.StepLog):
        holders.append(message.decisions)
    for holder in holders:
        for field in fields(holder):
            value = getattr(holder, field.name)
            assert not isinstance(value, np.ndarray) or not value.flags.writeable, field.name


def test_zeros_of_either_sign_stay_what_they_are() -> None:
    """What is remembered of one frame is not given to another that merely compares equal."""
    for alt in (0.0, -0.0, 0.0):
        data = changed("truth", frame={"kind": "enu", "lat": 1.0, "lon": 2.0, "alt": alt})
        assert schemas.encode(schemas.decode(data)) == data
