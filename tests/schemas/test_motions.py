"""Motions on the wire: what each kind takes, what is left out, and what is refused."""

import math

import msgpack
import pytest

import schemas
from schemas import MOTIONS, Motion
from schemas.values import motion, pack_motion
from tests.schemas.make_vectors import VECTORS

ONE_OF_EACH = {
    "cv": Motion("cv", 2.0),
    "ct": Motion("ct", 2.0, 0.1),
    "ca": Motion("ca", 0.5, sigma=3.0),
    "singer": Motion("singer", sigma=3.0, tau=20.0),
    "ou": Motion("ou", sigma=0.5, tau=60.0, q_turn=0.2),
    "still": Motion("still", 0.01, sigma=0.1),
}


def test_every_kind_comes_back() -> None:
    assert list(ONE_OF_EACH) == list(MOTIONS)
    for kind, one in ONE_OF_EACH.items():
        told = pack_motion(one)
        assert told["kind"] == kind
        assert set(told) == {"kind", *MOTIONS[kind]}
        assert motion(msgpack.unpackb(msgpack.packb(told))) == one


def test_golden_messages_hold_every_kind() -> None:
    infos = [schemas.decode(path.read_bytes()) for path in VECTORS.glob("sensor_info*.msgpack")]
    assert {one.motion.kind for one in infos if isinstance(one, schemas.SensorInfo)} == set(MOTIONS)


def test_what_a_kind_does_not_take_is_ignored_on_the_wire_as_every_unknown_key() -> None:
    assert motion({"kind": "cv", "q": 1, "sigma": "new", "tau": -1}) == Motion("cv", 1.0)
    assert motion({"kind": "ou", "q": 7.0, "sigma": 1, "tau": 2}) == Motion("ou", sigma=1.0, tau=2.0)


@pytest.mark.parametrize(
    ("kind", "numbers", "words"),
    [
        ("warp", {}, "unknown motion 'warp' (known: cv, ct, ca, singer, ou, still)"),
        ("cv", {}, "motion cv needs q"),
        ("cv", {"q": 1.0, "tau": 1.0}, "motion cv takes q, q_turn, not tau"),
        ("cv", {"q": math.inf}, "q is inf"),
        ("singer", {"tau": 1.0}, "motion singer needs sigma, more than 0"),
        ("singer", {"sigma": 1.0}, "motion singer needs tau, at least 1e-06 s"),
        ("singer", {"sigma": 1.0, "tau": 1.0, "q": 1.0}, "motion singer takes sigma, tau, q_turn, not q"),
        ("ou", {"sigma": math.nan, "tau": 1.0}, "sigma is nan"),
        ("ou", {"sigma": 1.0, "tau": 1e10}, "tau is 10000000000.0"),
        ("still", {"q": 1.0}, "motion still needs sigma, more than 0"),
        ("ca", {"sigma": 1.0}, "motion ca needs q"),
    ],
)
def test_what_is_wrong_is_said_in_a_line(kind: str, numbers: dict[str, float], words: str) -> None:
    with pytest.raises(ValueError) as caught:
        Motion(kind, **numbers)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
