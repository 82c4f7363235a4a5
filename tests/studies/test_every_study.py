"""What holds of every study: it runs, its numbers are numbers, and the same seed gives the same table."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from fusion_service.process import data_folder
from studies import pictures, report
from studies.study import Run, Study, catalogue

STUDIES = catalogue()
DATA = data_folder("autoferry")


LONG = {
    *("autoferry", "dubey-consensus", "li-nonlinear", "sharma-three-radars", "tracklets", "unequal-sensors"),
    *("dubey-sonobuoys-ct", "dubey-sonobuoys-cv", "sharma-network-1", "sharma-network-2", "track-correlation"),
    *("uney-bernoulli", "uney-iid-cluster", "li-linear", "li-phd-filter", "correlation-sweep"),
}
"""Three seconds and more each, for they fly whole missions or sweep: `make slow-test`."""


@pytest.mark.parametrize(
    "study", [pytest.param(one, id=name, marks=[pytest.mark.slow] * (name in LONG)) for name, one in STUDIES.items()]
)
def test_the_same_seed_gives_the_same_table(study: Study, tmp_path: Path) -> None:
    if study.needs_data and not DATA:
        pytest.skip("FUSION_DATA names no folder of the Autoferry recordings")
    run = Run(study.quick if study.quick < 4 else max(2, study.quick // 4), 3, data=Path(DATA) if DATA else None)
    results = [study.run(run) for _ in range(2)]
    if study.deterministic:
        first, second = (json.dumps(report.as_json(study, run, result)) for result in results)
        assert first == second
    names = [[(row.name, row.quantity, row.published) for row in result.rows] for result in results]
    assert names[0] == names[1]
    rows = results[0].rows
    assert rows
    assert len({(row.name, row.quantity) for row in rows}) == len(rows)
    for row in rows:
        assert math.isfinite(row.ours), row
        assert row.stderr is None or row.stderr >= 0, row
    table = report.text(study, report.as_json(study, run, results[0]))
    assert all(row.name in table for row in rows)
    if results[0].draw:
        pictures.save(results[0].draw, results[0].size, tmp_path / "picture.png")
        assert (tmp_path / "picture.png").stat().st_size > 5_000


def test_the_page_is_made_of_the_results_that_are_kept() -> None:
    """docs/studies.md says nothing that a study did not print."""
    root = Path(__file__).parents[2]
    assert (root / report.PAGE).read_text("utf-8") == report.page(STUDIES.values(), root / report.FOLDER)
    for name, study in STUDIES.items():
        kept = json.loads((root / report.FOLDER / f"{name}.json").read_text("utf-8"))
        assert kept["runs"] == study.runs, name
