"""What a message says of its platform: taken as it is, or refused with the reason."""

from __future__ import annotations

from typing import Any

import msgpack
import numpy as np
import pytest

import schemas
from schemas.platform import pack_platform, read_platform
from tests.schemas.golden import GOLDEN, changed

PLATFORM = msgpack.unpackb(GOLDEN["local_tracks_platform"])["platform"]


def test_there_and_back() -> None:
    P = np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 0.5], [0.0, 0.5, 2.25]])
    for one in (
        schemas.Platform((1.0, 2.0, 3.0)),
        schemas.Platform((1.0, 2.0, 3.0), heading=0.0),
        schemas.Platform((1.0, 2.0, 3.0), P, 1.0, 0.5),
    ):
        packed = pack_platform(one)
        again = read_platform(packed)
        assert pack_platform(again) == packed
        assert (again.position, again.heading, again.heading_sigma) == (one.position, one.heading, one.heading_sigma)
        assert (again.position_covariance is None) == (one.position_covariance is None)
    assert again.position_covariance is not None
    np.testing.assert_array_equal(again.position_covariance, P)


@pytest.mark.parametrize(
    "wrong",
    [
        {"position": [1.0, 2.0]},
        {"position": [1.0, 2.0, float("nan")]},
        {"position": [1.0, 2.0, 2e12]},
        {"position": [1.0, True, 2.0]},
        {"position": None},
        {"position_covariance": bytes(40)},
        {"position_covariance": [1.0] * 6},
        {"position_covariance": np.array([1.0, 0, 1, 0, 0, -1]).tobytes()},
        {"position_covariance": np.array([np.inf, 0, 1, 0, 0, 1]).tobytes()},
        {"heading": 7.0},
        {"heading": float("inf")},
        {"heading": "north"},
        {"heading_sigma": -0.1},
        {"heading_sigma": 3.2},
        {"heading_sigma": b"1"},
    ],
)
def test_what_cannot_be_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(schemas.MessageError, match=r"local_tracks\.platform") as caught:
        schemas.decode(changed("local_tracks_platform", platform={**PLATFORM, **wrong}))
    assert caught.value.reason == "bad-field"


@pytest.mark.parametrize("whole", [[1.0, 2.0, 3.0], "here", 5, {"position": [0, 0, 0], "position_covariance": 4}])
def test_what_is_no_platform_is_refused(whole: Any) -> None:
    with pytest.raises(schemas.MessageError, match=r"local_tracks\.platform"):
        schemas.decode(changed("local_tracks_platform", platform=whole))


def test_heading_sigma_of_an_info() -> None:
    for wrong in (-0.1, 4.0, float("nan"), "much"):
        with pytest.raises(schemas.MessageError, match="heading_sigma"):
            schemas.decode(changed("sensor_info_heading", heading_sigma=wrong))


def test_the_caller_is_told() -> None:
    for position, more in (((1.0, 2.0), {}), ((0.0, 0.0, 0.0), {"heading": 9.0})):
        with pytest.raises(ValueError, match="platform"):
            schemas.Platform(position, **more)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="symmetric"):
        schemas.Platform((0.0, 0.0, 0.0), np.array([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]))
