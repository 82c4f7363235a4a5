"""`python -m studies`: list, run, all, page."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from fusion_service.process import data_folder
from fusion_service.progress import Progress
from studies import pictures, report
from studies.rules import OwnRuleError, fuser
from studies.study import MissingDataError, Result, Run, Study, catalogue

__all__ = ["main"]

LIST = """examples:
  python -m studies list"""
RUN = """examples:
  python -m studies run li-linear
  python -m studies run li-linear --quick --json li.json --png li.png
  python -m studies run sharma-network-1 --rule bci:max_correlation=0.3 --rule my_rule.py:fuse
  python -m studies run autoferry --data path/to/autoferry"""
ALL = """examples:
  python -m studies all                 every study in full; results in docs/studies, the page docs/studies.md
  python -m studies all li-linear li-nonlinear
  python -m studies all --quick --out /tmp/studies"""
PAGE = """examples:
  python -m studies page                docs/studies.md from the results in docs/studies"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code: 0 done, 2 bad usage, 1 failure with one line."""
    parser = argparse.ArgumentParser(prog="python -m studies", description="The papers' experiments, by Monte Carlo.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    form = argparse.RawDescriptionHelpFormatter
    commands.add_parser("list", help="the studies there are", epilog=LIST, formatter_class=form)
    one = commands.add_parser("run", help="run one and print its table", epilog=RUN, formatter_class=form)
    one.add_argument("name", metavar="NAME")
    one.add_argument("--runs", type=_count, metavar="M", help="Monte Carlo runs (default: those of the full study)")
    one.add_argument("--rule", action="append", default=[], metavar="RULE", help="compare this rule too")
    one.add_argument("--json", type=Path, metavar="F", help="write the table as JSON")
    one.add_argument("--png", type=Path, metavar="F", help="draw the picture")
    every = commands.add_parser("all", help="run every one, keep the results", epilog=ALL, formatter_class=form)
    every.add_argument("names", nargs="*", metavar="NAME", help="only these")
    every.add_argument("--out", type=Path, default=report.FOLDER, metavar="DIR", help="(default %(default)s)")
    for command in (one, every):
        command.add_argument("--quick", action="store_true", help="as few runs as in CI")
        command.add_argument("--seed", type=_seed, default=1, metavar="S", help="(default %(default)s)")
        command.add_argument("--jobs", type=_count, default=os.cpu_count() or 1, metavar="N", help="processes")
        command.add_argument(
            "--data", metavar="DIR", help="Autoferry's folder, or what holds autoferry/ (default: $FUSION_DATA)"
        )
    commands.add_parser("page", help="make docs/studies.md", epilog=PAGE, formatter_class=form)
    args = parser.parse_args(arguments)
    known = catalogue()
    if args.command == "list":
        return _list(known)
    if args.command == "page":
        return _page(known)
    run = Run(0, args.seed, data=data_folder("autoferry", args.data), jobs=args.jobs)
    for name in args.names if args.command == "all" else [args.name]:
        if name not in known:
            parser.error(f"no study {name!r}; there are {', '.join(known)}")
    if args.command == "all":
        return _all([known[name] for name in args.names or known], args.out, args.quick, run)
    study = known[args.name]
    if args.rule and not study.takes_rules:
        parser.error(f"{study.name} compares no rules: --rule has no effect on it")
    for path in filter(None, (args.json, args.png)):
        if path.is_dir() or not path.parent.is_dir():
            parser.error(f"cannot write {path}: name a file in a folder that exists")
    if args.png and args.png.suffix != ".png":
        parser.error(f"cannot draw {args.png}: name a .png file")
    try:
        run = replace(run, rules=tuple(fuser(text) for text in args.rule))
    except ValueError as error:
        parser.error(str(error))
    return _run(study, replace(run, runs=args.runs or _runs(study, args.quick)), args.json, args.png)


def _seed(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{value}: at least 0")
    return value


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value}: at least 1")
    return value


def _runs(study: Study, quick: bool) -> int:
    return study.quick if quick else study.runs


def _list(studies: Mapping[str, Study]) -> int:
    for study in studies.values():
        about = f"{study.runs:,} runs, about {_duration(study.seconds)}" + (", --rule" if study.takes_rules else "")
        print(f"{study.name:<24}{study.title} ({study.source}; {about})")
    return 0


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"


def _answer(study: Study, run: Run, label: str) -> Result:
    with Progress(label) as bar:
        return study.run(replace(run, progress=bar.show))


def _run(study: Study, run: Run, json_path: Path | None, png: Path | None) -> int:
    began = time.monotonic()
    try:
        result = _answer(study, run, study.name)
        values = report.as_json(study, run, result)
        print(report.text(study, values))
        if json_path:
            report.write_json(json_path, values)
        if png and result.draw:
            pictures.save(result.draw, result.size, png)
    except (MissingDataError, OwnRuleError, OSError) as error:
        print(f"{study.name}: {error}", file=sys.stderr)
        return 1
    print(f"\n{_duration(time.monotonic() - began)}" + (f", {png}" if png else ""), file=sys.stderr)
    return 0


def _all(studies: list[Study], out: Path, quick: bool, run: Run) -> int:
    out.mkdir(parents=True, exist_ok=True)
    left = sum(study.seconds for study in studies)
    began = time.monotonic()
    for number, study in enumerate(studies, 1):
        rest = "" if quick else f", {_duration(left)} left"
        one = replace(run, runs=_runs(study, quick))
        begun = time.monotonic()
        try:
            result = _answer(study, one, f"{number}/{len(studies)} {study.name}{rest}")
        except MissingDataError as error:
            print(f"{study.name}: skipped: {error}")
            continue
        report.write_json(out / f"{study.name}.json", report.as_json(study, one, result))
        if result.draw:
            pictures.save(result.draw, result.size, out / f"{study.name}.png")
        left -= study.seconds
        print(f"{study.name:<24}{one.runs:>7,} runs {time.monotonic() - begun:7.1f} s", flush=True)
    print(f"{'all':<24}{'':12} {time.monotonic() - began:7.1f} s")
    return _page(catalogue()) if out == report.FOLDER else 0


def _page(studies: Mapping[str, Study]) -> int:
    try:
        report.PAGE.write_text(report.page(studies.values()), encoding="utf-8")
    except FileNotFoundError as error:
        print(f"no result to make the page of: {error.filename} (python -m studies all makes them)", file=sys.stderr)
        return 1
    print(report.PAGE)
    return 0
