"""The attacks and uses of `python -m tests.attacks`: those on keys and links all, against an open and a secured bus."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from fusion_service.bus.security import Security
from tests.attacks.judging import Verdict, on_keys, on_links, with_own_hubs
from tests.attacks.lab import Lab, bad_certificates, keys, lab
from tests.attacks.onkeys import ON_KEYS
from tests.attacks.onlinks import at_own_hub, bare_link
from tests.attacks.uses import USES

QUICK = tuple(name for name in USES if name != "the service comes back")
"""What a service needs seconds for is left to the long list."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Security]]:
    folder = tmp_path_factory.mktemp("attacks")
    certificates = keys(folder / "keys")
    return certificates, bad_certificates(folder / "bad", certificates)


@pytest.fixture(scope="module")
def attacked(made: tuple[Path, dict[str, Security]], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    with lab(tmp_path_factory.mktemp("secured"), made[0]) as one:
        yield one


def worked(verdicts: list[Verdict]) -> list[str]:
    return [verdict.name for verdict in verdicts if verdict.worked]


def silent(verdicts: list[Verdict]) -> list[tuple[str, str]]:
    return [(verdict.name, verdict.missing) for verdict in verdicts if verdict.missing]


def test_every_attack_works_in_the_open(tmp_path: Path) -> None:
    with lab(tmp_path, None) as one:
        assert worked(on_keys(one, ON_KEYS, 20.0)) == [attack.name for attack in ON_KEYS]
        assert bare_link(one, None).worked
    assert at_own_hub(None, None).worked


def test_no_attack_on_keys_works_secured_and_the_hub_says_why(attacked: Lab) -> None:
    verdicts = on_keys(attacked, ON_KEYS, 1.5)
    assert len(verdicts) == len(ON_KEYS)
    assert worked(verdicts) == []
    assert silent(verdicts) == []


def test_no_wrong_certificate_comes_in_and_both_sides_say_why(
    attacked: Lab, made: tuple[Path, dict[str, Security]]
) -> None:
    verdicts = on_links(attacked, made[1])
    assert worked(verdicts) == []
    assert silent(verdicts) == []


def test_no_honest_party_joins_a_rogue_hub(made: tuple[Path, dict[str, Security]]) -> None:
    verdicts = with_own_hubs(*made, most=3)  # the rest take seconds
    assert len(verdicts) == 3
    assert worked(verdicts) == []
    assert silent(verdicts) == []


@pytest.mark.parametrize("use", QUICK)
def test_what_is_allowed_works_beside_those_who_attack(attacked: Lab, use: str) -> None:
    assert USES[use](attacked)
