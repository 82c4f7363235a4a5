"""A rule of one's own: loaded by its file, checked in every batch, tried out, and never the end of a centre."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion_service.cli import main
from fusion_service.config import ConfigError, centre_config, config_hash, load_config
from fusion_service.rules import RULES, RuleError, fuse, fuse_last, is_own, load_own
from fusion_service.rules.face.own import OwnRule, loaded, own_fuse, told_name
from fusion_service.rules.face.trial import tried_out
from tests.docs.pages import blocks
from tests.helpers.flown import messy

NAIVE = """
import numpy as np

def fuse(means, covariances, *, factor=1.0):
    '''The product.

    More of it.'''
    information = np.linalg.inv(covariances)
    covariance = np.linalg.inv(information.sum(axis=1))
    mean = (covariance @ (information @ means[..., None]).sum(axis=1))[..., 0]
    return mean, factor * 0.5 * (covariance + covariance.swapaxes(-1, -2))

fuse.promise = "right for independent tracks"

def sub(means, covariances):
    return means[:, 0], covariances[:, 0]
"""
HEAD = "import numpy as np\ndef fuse(means, covariances):\n"


def written(folder: Path, body: str, name: str = "my_rule.py") -> str:
    (folder / name).write_text(body, encoding="utf-8")
    return f"{folder / name}:fuse"


def own(folder: Path, body: str) -> OwnRule:
    rule = loaded(load_own(written(folder, body))[0].name)
    assert rule is not None
    return rule


def sources(size: int = 5, count: int = 3, n: int = 4) -> tuple[Any, Any]:
    rng = np.random.default_rng(3)
    roots = rng.normal(size=(size, count, n, n)) + 2 * np.eye(n)
    return rng.normal(size=(size, count, n)), roots @ roots.swapaxes(-1, -2)


def test_it_stands_beside_the_shipped_ones_in_both_faces(tmp_path: Path) -> None:
    rule = load_own(written(tmp_path, NAIVE))[0]
    means, covariances = sources()
    mine, theirs = fuse(rule.name, means, covariances), fuse("naive", means, covariances)
    np.testing.assert_allclose(mine.mean, theirs.mean, rtol=1e-9)
    np.testing.assert_allclose(mine.covariance, theirs.covariance, rtol=1e-9)
    wide = fuse(rule.name, means, covariances, factor=2.0)
    np.testing.assert_allclose(wide.covariance, 2 * mine.covariance)
    last = fuse_last(rule.name, np.moveaxis(means, 0, -1), np.moveaxis(covariances, 0, -1))
    np.testing.assert_array_equal(last.mean, mine.mean.T)
    assert rule.promise == "right for independent tracks"
    assert rule.title == "The product."
    assert rule.name in RULES
    assert rule.name not in list(RULES)
    assert load_own(f"{tmp_path / 'my_rule.py'}:fuse")[0] is rule, "it is loaded once"
    with pytest.raises(RuleError, match="no option 'power': it has factor"):
        fuse(rule.name, means, covariances, power=2.0)
    changed = load_own(written(tmp_path, NAIVE + "\n"))[0]
    assert changed.name != rule.name
    assert told_name(rule.name) == ("my_rule.py:fuse", rule.name[-16:])
    assert not is_own("bci:max_correlation=0.5")


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("def other(means, covariances): ...", r"has no function 'fuse'.*\(it has other\)"),
        ("def fuse(:", "cannot be run: SyntaxError"),
        ("import no_such_package", r"cannot be run: ModuleNotFoundError.*\(line 1\)"),
        ("raise SystemExit(3)", r"cannot be run: SystemExit: 3"),
        ("def fuse(means): ...", r"takes \(means\): it must take \(means, covariances\)"),
        ("def fuse(means, covariances, *, power): ...", "give that option a default"),
    ],
)
def test_what_cannot_be_loaded_is_told_in_a_line(body: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(RuleError, match=words) as told:
        load_own(written(tmp_path, body))
    assert "\n" not in str(told.value).split("SyntaxError")[0]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("return means[:, 0]", r"gives ndarray, not mean \(5, 4\) and covariance \(5, 4, 4\); weights \(5, 3\)"),
        ("return means[:, 0].T, covariances[:, 0]", r"gives mean \(4, 5\), covariance \(5, 4, 4\), not mean \(5, 4\)"),
        ("return means[:, 0], covariances[:, 0], 1.0", r"weights \(\), not"),
        ("return 'a', 'b'", "gives no numbers"),
        (
            "means[2] = np.nan; return means[:, 0], covariances[:, 0]",
            r"mean or covariance \[2\] is not finite \(1 of 5",
        ),
        ("covariances[3:, 0, 0, 1] += 1; return means[:, 0], covariances[:, 0]", r"covariance \[3\] is not symmetric"),
        ("covariances[1:] *= -1; return means[:, 0], covariances[:, 0]", r"\[1\] is not positive definite \(4 of 5"),
        ("return means[:, 0], covariances[:, 7]", r"IndexError: .*, line 3"),
    ],
)
def test_what_it_gives_is_checked_and_the_first_fault_is_told(line: str, words: str, tmp_path: Path) -> None:
    rule = own(tmp_path, HEAD + f"    {line}\n")
    with pytest.raises(RuleError, match=words):
        own_fuse(rule, *sources())


def test_only_what_is_wrong_is_lost(tmp_path: Path) -> None:
    rule = own(tmp_path, HEAD + "    covariances[2] *= -1\n    return means[:, 0], covariances[:, 0]\n")
    means, covariances = (np.moveaxis(part, 0, -1) for part in sources())
    fused = fuse_last(rule.name, means, covariances, influence=True)
    assert np.isnan(fused.mean).any(axis=0).tolist() == [False, False, True, False, False]
    np.testing.assert_array_equal(fused.mean[:, 1], means[0, :, 1])
    assert "covariance [2] is not positive definite" in rule.problem
    assert fuse_last(rule.name, means[..., :0], covariances[..., :0]).mean.shape == (4, 0)


def test_a_centre_goes_on_when_it_fails(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """It fails in the second of its batches that has two sources: equal-weight intersection there, said in the log."""
    body = NAIVE.replace(
        "    information =", "    assert len(means) < 3 or factor == 1.0, 'too many'\n    information =", 1
    )
    name = load_own(written(tmp_path, body))[0].name
    with caplog.at_level(logging.WARNING):
        sound = messy({"rule": name}, steps=6, targets=5)
        failing = messy({"rule": name, "rule_options": {"factor": 2.0}}, steps=6, targets=5)
    refused = [entry for step in failing.steps for entry in step.log.refused if entry.reason == "fusion"]
    assert sum(entry.count for entry in refused) >= 5
    assert not [entry for step in sound.steps for entry in step.log.refused if entry.reason == "fusion"]
    told = [record.message for record in caplog.records if "too many" in record.message]
    assert len(told) == 1, "each kind of fault is said once"
    assert "AssertionError: too many, line 8" in told[0]
    assert len(failing.steps[-1].tracks.ids) >= 4
    assert all(np.isfinite(step.tracks.means).all() for step in failing.steps)
    assert failing.steps[-1].tracks.rule == name


def test_a_config_names_it_relative_to_itself_and_its_hash_holds_the_file(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    written(tmp_path / "deep", NAIVE)
    config = tmp_path / "centre.toml"
    config.write_text('[centre]\nrule = "deep/my_rule.py:fuse"\nrule_options = {factor = 2.0}\n')
    first = load_config(config).centre
    assert first.rule == load_own("deep/my_rule.py:fuse", tmp_path)[0].name
    written(tmp_path / "deep", NAIVE + "# changed\n")
    assert config_hash(load_config(config).centre) != config_hash(first)
    for text, words in (
        ('rule = "gone.py:fuse"', "centre.toml:2: centre.rule: no file"),
        ('rule = "deep/my_rule.py:fuse"\nrule_options = {power = 1}', "centre.toml:3: centre.rule_options:.*'power'"),
        (f'rule = "{first.rule}"', "leave out what follows #"),
    ):
        config.write_text(f"[centre]\n{text}\n")
        with pytest.raises(ConfigError, match=words):
            load_config(config)
    written(tmp_path, "def fuse(means, covariances): return 1, 2\n")
    config.write_text('[centre]\nrule = "my_rule.py:fuse"\n')
    with pytest.raises(ConfigError, match=r"cannot fuse 2 sources here: .* gives mean \(\), covariance \(\), not mean"):
        load_config(config)


def test_settings_from_elsewhere_load_no_code(tmp_path: Path) -> None:
    mark = tmp_path / "ran"
    body = f"open({str(mark)!r}, 'w').close()\n{NAIVE}"
    text = written(tmp_path, body)
    for rule in (text, f"{text}#0123456789abcdef"):
        with pytest.raises(ConfigError, match="a rule of one's own that is not loaded"):
            centre_config({"rule": rule})
    assert not mark.exists()


def test_trying_it_out_shows_where_it_is_too_sure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The product of equal sources states half the variance: with one error in both the excess is 2."""
    trial = tried_out(own(tmp_path, NAIVE))
    assert not trial.faults
    assert trial.excess["independent"] <= trial.noise
    assert trial.excess["the same in both"] > 1.5
    half = "def fuse(means, covariances):\n    return means.mean(axis=1), covariances.mean(axis=1)\n"
    assert max(tried_out(own(tmp_path, half)).excess.values()) <= trial.noise, "the average is conservative"
    batch = HEAD + "    return means[:, 0] + 1e-9 * len(means), covariances[:, 0]\n"
    faults = tried_out(own(tmp_path, batch)).faults
    assert any("depend on the batch" in fault for fault in faults)
    noisy = HEAD + "    return means[:, 0] + np.random.rand(), covariances[:, 0]\n"
    assert main(["check", written(tmp_path, noisy)]) == 1
    said = capsys.readouterr()
    assert "something else the second time" in said.out
    assert "the order of 2 sources matters" in said.out


def test_the_example_of_the_docs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (block,) = [one for one in blocks("docs/rules.md") if "my_rule.py" in one.text and "def fuse" in one.text]
    text = written(tmp_path, block.text)
    assert main(["check", text]) == 0
    assert "too sure" not in re.sub("not seen to be too sure", "", capsys.readouterr().out)
    assert main(["rules", text]) == 0
    assert "conservative for every correlation" in capsys.readouterr().out
    means, covariances = sources(count=2)
    rule = load_own(text)[0]
    fused, best = fuse(rule.name, means, covariances), fuse("ci", means, covariances)
    assert (np.linalg.det(fused.covariance) >= np.linalg.det(best.covariance) * (1 - 1e-9)).all()
