"""What a study is: a function from a `Run` (how many runs, which seed) to a `Result` (rows, notes, a picture).

The same seed gives the same rows: a study draws from `Run.rng` only, and what it spreads over processes it seeds by
item, so that the number of processes does not matter.
"""

from __future__ import annotations

import importlib
import multiprocessing
import pkgutil
import signal
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion_service.errors import FusionError
from studies.rules import Fuser

__all__ = ["MissingDataError", "Result", "Row", "Run", "Study", "catalogue"]

Floats = NDArray[np.float64]
Item = TypeVar("Item")
Answer = TypeVar("Answer")


class MissingDataError(FusionError, ValueError):
    """A study of real data has not been told where they are: one line that says how to."""


@dataclass(frozen=True, slots=True)
class Row:
    """One number: `name` says of what (a rule, a filter), `quantity` which number, with its unit.

    published: as printed in the paper, None where it prints none; decimals: how many it prints, for its rounding.
    stderr: standard error of `ours` over the runs; None of a number that no chance is in.
    """

    name: str
    quantity: str
    published: float | None
    ours: float
    stderr: float | None = None
    decimals: int | None = None


@dataclass(frozen=True, slots=True)
class Result:
    """rows: the table; notes: the reading used, what differs and why, a sentence or two each; draw: paints the picture
    on an empty matplotlib figure of `size` inches."""

    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    draw: Callable[[Any], None] | None = None
    size: tuple[float, float] = (9.0, 5.0)


@dataclass(frozen=True, slots=True)
class Run:
    """How a study is to be run. rules: what a researcher adds to the rules it compares; data: folder of the real
    recordings; jobs: processes; progress: called with the share done, from 0 to 1, and a word on where it is."""

    runs: int
    seed: int = 0
    rules: tuple[Fuser, ...] = ()
    data: Path | None = None
    jobs: int = 1
    progress: Callable[[float, str], None] = field(default=lambda share, note: None)

    def rng(self, *key: int) -> np.random.Generator:
        """Random numbers of this seed's own; another stream for every key."""
        return np.random.default_rng([self.seed, *key])

    def map(self, function: Callable[[Item], Answer], items: Iterable[Item], note: str = "") -> list[Answer]:
        """`function` of every item, in their order, over `jobs` processes, with progress. A function of a module (or a
        `partial` of one), which draws its random numbers from a seed in the item."""
        work = list(items)
        answers: list[Answer] = []
        if self.jobs < 2 or len(work) < 2:
            for item in work:
                answers.append(function(item))
                self.progress(len(answers) / len(work), note)
            return answers
        spawn, ignore = multiprocessing.get_context("spawn"), (signal.SIGINT, signal.SIG_IGN)
        with ProcessPoolExecutor(self.jobs, spawn, initializer=signal.signal, initargs=ignore) as pool:
            try:
                for answer in pool.map(function, work):
                    answers.append(answer)
                    self.progress(len(answers) / len(work), note)
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
        return answers


@dataclass(frozen=True, slots=True)
class Study:
    """An experiment. title: one line; source: paper and section; about: the set-up and the reading, Markdown (the
    page's text; by habit the module's docstring); runs: of the full study, quick: of the same in CI; published_runs:
    what the paper's numbers are averages over, so that their own error is known; seconds: what the full study takes on
    two cores, measured; takes_rules: whether `--rule` adds to what it compares; needs_data: real recordings;
    deterministic: false of a study that measures time, whose numbers no seed repeats; widest:
    quantities that the page sets side by side at most."""

    name: str
    title: str
    source: str
    about: str
    run: Callable[[Run], Result]
    runs: int
    quick: int
    seconds: float
    published_runs: int | None = None
    takes_rules: bool = False
    needs_data: bool = False
    deterministic: bool = True
    widest: int = 6


def catalogue() -> Mapping[str, Study]:
    """All studies by name, in alphabetical order."""
    from studies import experiments

    found = [
        study
        for module in pkgutil.iter_modules(experiments.__path__)
        for study in importlib.import_module(f"studies.experiments.{module.name}").STUDIES
    ]
    return {study.name: study for study in sorted(found, key=lambda study: study.name)}
