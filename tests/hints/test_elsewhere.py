"""Who publishes where no centre of a realm listens."""

from __future__ import annotations

from fusion_service.hints.elsewhere import beside, realm_of

KEYS = [
    "fusoin/v1/local/m01/tracks",
    "north/v1/local/n1/tracks",
    "fusion/v1/local/ok/tracks",
    "fusion/v1/locl/m02/tracks",
]


def test_other_realms_and_slips_of_the_pen_are_told_of() -> None:
    told = beside(KEYS, "fusion")
    assert "fusoin/v1/local/m01/tracks: it publishes in the realm 'fusoin': did you mean 'fusion'?" in told
    assert "north/v1/local/n1/tracks: it publishes in the realm 'north': the centre listens in 'fusion'" in told
    assert any("'locl' is no part of a key" in one for one in told)
    assert len(told) == 3


def test_a_realm_with_a_centre_of_its_own_is_in_its_place() -> None:
    assert len(beside(KEYS, "fusion", {"north"})) == 2
    assert beside(KEYS[:1], "fusion", {"fusoin"}) == []


def test_only_what_is_nearly_right_where_one_must_be_sure() -> None:
    assert [one.split("/")[0] for one in beside(KEYS, "fusion", sure=True)] == ["fusoin"]
    assert realm_of("a/b/v1/local/x/info") == "a/b"
    assert realm_of("nonsense") == ""
