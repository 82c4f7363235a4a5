"""`python -m studies` as its user sees it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from studies import report
from studies.cli import main
from studies.rules import fuser
from studies.study import Result, Row, Run, catalogue

COUNTER = "sharma-counter-example"


def test_list_names_every_study(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in catalogue())


def test_run_prints_a_table_and_writes_json_and_a_picture_of_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "out.json"
    assert main(["run", COUNTER, "--runs", "2000", "--seed", "5", "--json", str(target)]) == 0
    values = json.loads(target.read_text())
    assert (values["study"], values["runs"], values["seed"]) == (COUNTER, 2000, 5)
    assert set(values["rows"][0]) >= {"name", "quantity", "published", "ours", "stderr"}
    shown = capsys.readouterr().out
    assert all(row["name"] in shown for row in values["rows"])
    assert main(["run", COUNTER, "--runs", "2000", "--seed", "5"]) == 0
    assert capsys.readouterr().out == shown


def test_a_rule_of_ones_own_joins_the_experiment(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = tmp_path / "half.py"
    own.write_text("def fuse(means, covariances):\n    return means.mean(axis=1), covariances.mean(axis=1)\n")
    target = tmp_path / "out.json"
    chosen = ["--rule", f"{own}:fuse", "--rule", "bci:max_correlation=1.0"]
    assert main(["run", COUNTER, "--runs", "4000", *chosen, "--json", str(target)]) == 0
    rows = {row["name"]: row["ours"] for row in json.loads(target.read_text())["rows"]}
    assert rows["half.fuse"] < 1  # the average of two is conservative here
    assert abs(rows["bci:max_correlation=1.0"] - rows["ci"]) < 1e-3  # bci at bound 1 is ci


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["run", "no-such"], "there are"),
        (["run", COUNTER, "--rule", "nonsense"], "one of"),
        (["run", COUNTER, "--rule", "ci:speed=3"], "criterion"),
        (["run", COUNTER, "--rule", "ci:criterion=size"], "det"),
        (["run", COUNTER, "--rule", "missing.py:fuse"], "no file"),
        (["run", COUNTER, "--runs", "0"], "at least 1"),
        (["run", COUNTER, "--seed", "-1"], "at least 0"),
        (["run", COUNTER, "--json", "no-such/x.json"], "in a folder that exists"),
        (["run", COUNTER, "--png", "x.xyz"], "name a .png file"),
    ],
)
def test_bad_usage_is_told_in_a_line(arguments: list[str], word: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert word in capsys.readouterr().err


def test_a_bar_in_a_name_does_not_end_its_cell(tmp_path: Path) -> None:
    study = catalogue()[COUNTER]
    wide = [Row("most |e|", f"|number - {k}|", None, 1.0) for k in range(study.widest + 1)]
    for rows in (wide, wide[:2]):
        result = Result(tuple(rows))
        report.write_json(tmp_path / f"{COUNTER}.json", report.as_json(study, Run(1), result))
        lines = [line for line in report.page([study], tmp_path).splitlines() if line.startswith("|")]
        table = lines[lines.index(next(line for line in lines if line.startswith("| | ") and COUNTER not in line)) :]
        assert r"most \|e\|" in table[2]
        assert len({line.replace(r"\|", "").count("|") for line in table}) == 1


@pytest.mark.parametrize(
    ("body", "code", "words"),
    [
        ("def fuse(means, covariances): raise KeyError('x')", 1, "own.py:fuse: KeyError: 'x'"),
        ("def fuse(means, covariances): return 3", 1, "own.py:fuse: gives int, not mean"),
        (
            "def fuse(means, covariances): return means, covariances",
            1,
            "own.py:fuse: gives mean (100, 2, 2), covariance (100, 2, 2, 2), not mean (100, 2)",
        ),
        ("def fuse(:", 2, "own.py cannot be run: SyntaxError"),
    ],
)
def test_a_rule_of_ones_own_that_fails_is_told_in_a_line(
    body: str, code: int, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "own.py").write_text(body)
    try:
        ended = main(["run", COUNTER, "--runs", "100", "--rule", f"{tmp_path / 'own.py'}:fuse"])
    except SystemExit as error:
        ended = int(error.code or 0)
    assert ended == code
    assert words in capsys.readouterr().err


def test_rules_are_named_with_their_options() -> None:
    assert fuser("hmd-ga:criterion=trace,constants=false").options == (("criterion", "trace"), ("constants", False))
    assert fuser("ci:weights=uniform").weights == "uniform"


@pytest.mark.parametrize(
    ("row", "runs", "published_runs", "verdict"),
    [
        (Row("a", "b", 10.0, 10.3, 0.2), 100, None, "agrees"),
        (Row("a", "b", 10.0, 11.0, 0.2), 100, None, "+10 %"),
        (Row("a", "b", 10.0, 10.6, 0.1), 400, 4, "agrees"),  # their error is ten times ours
        (Row("a", "b", 1.71, 1.714, None), 1, None, "as printed"),
        (Row("a", "b", 1.71, 1.80, None), 1, None, "+5.3 %"),
        (Row("a", "b", None, 1.80, None), 1, None, ""),
    ],
)
def test_a_published_number_is_compared_with_both_errors(
    row: Row, runs: int, published_runs: int | None, verdict: str
) -> None:
    assert report.compared(row, runs, published_runs).startswith(verdict)
    assert bool(report.compared(row, runs, published_runs)) == bool(verdict)
