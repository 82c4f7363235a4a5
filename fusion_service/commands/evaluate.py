"""`fusion-service evaluate`."""

from __future__ import annotations

import argparse
import json
import math
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from fusion_service.commands import requirements
from fusion_service.commands.sealed import add_authority
from fusion_service.process import argument, positive

if TYPE_CHECKING:
    from fusion_service.commands.requirements import Truths
    from fusion_service.recording.finding import Finding
    from fusion_service.review.evaluation import Assessment
    from fusion_service.review.profiles import Profile
    from schemas import Truth

__all__ = ["EXAMPLE", "HELP", "add", "run"]

HELP = "How good the tracks of a mission were: against truth where there is any, and against each other."
EXAMPLE = (
    "fusion-service evaluate mission.rrd\n"
    "  fusion-service evaluate mission.rrd --cutoff 5000 --html report.html --json scores.json\n"
    "  fusion-service evaluate ci.rrd naive.rrd --html rules.html      one row for each centre of each recording\n"
    "  fusion-service evaluate mission.rrd --truth gps.csv --every 1\n"
    "  fusion-service evaluate mission.rrd --profile en-route --html report.html    requirements, passed or failed\n"
    "  fusion-service evaluate mission.rrd --reference each       no truth: every source by all others"
)
ODD = 4.0
"""ANEES beyond which it is asked whether the given truth fits."""
SAMPLE = 20_000
"""Tracks of each source on the map, about."""


def add(parser: argparse.ArgumentParser) -> None:
    """The arguments."""
    parser.add_argument("recordings", metavar="FILE", nargs="*", help="recordings (.rrd)")
    parser.add_argument(
        "--truth",
        metavar="FILE",
        help="truth: a recording, a table as `export` writes it, or a CSV with time, id and lat, lon or x, y",
    )
    parser.add_argument(
        "--cutoff",
        type=argument(positive),
        metavar="M",
        help="largest error that still counts as followed, m (default: that which the recording keeps, else chosen)",
    )
    parser.add_argument(
        "--every",
        type=argument(positive),
        metavar="S",
        help="score so often, s (default: as the recording keeps, else at each step)",
    )
    parser.add_argument("--centre", metavar="NAME", action="append", help="only this centre; may be repeated")
    parser.add_argument("--json", metavar="FILE", help="write every number here")
    parser.add_argument("--html", metavar="FILE", help="write a page for people here")
    requirements.add(parser)
    add_authority(parser)


def run(args: argparse.Namespace, stop: threading.Event) -> None:
    """Score the recordings. Raises `ReviewError`, OSError."""
    from fusion_service.commands.scored_mission import need_rerun, scored_mission
    from fusion_service.commands.sealed import find
    from fusion_service.errors import ReviewError, Stopped
    from fusion_service.recording.scoring import Scoring, scoring_of
    from fusion_service.review.evaluation.truth import NO_TRUTH, read_truth
    from fusion_service.review.outputs import check_page

    if requirements.listed(args):
        return
    profile = requirements.begin(args)
    for page in filter(None, (args.json, args.html)):
        check_page(page, *args.recordings, *filter(None, [args.truth]))
    need_rerun()
    if args.html:
        from fusion_service.review.evaluation.report import need_matplotlib

        need_matplotlib()
    done: list[Assessment] = []
    truths = requirements.Truths(args, NO_TRUTH)
    seals: list[Finding] = []
    try:
        truths = requirements.Truths(args, read_truth(Path(args.truth)) if args.truth else NO_TRUTH)
        kept = scoring_of(args.recordings[0])
        asked = args.cutoff or (profile.cutoff if profile else None)
        how = Scoring(asked or kept.cutoff, args.every or kept.every)
        for path in map(Path, args.recordings):
            how = how._replace(cutoff=how.cutoff or (done[0].c if done else None))
            rows = SAMPLE if args.html else 0
            scored = scored_mission(path, truths, how, stop, centres=args.centre or (), rows=rows)
            if not (done or asked) and kept.cutoff:
                scored = replace(scored, kept=True)
            seals.append(find(str(path), args.ca, stop))
            done.append(scored)
    except Stopped:
        print(f"stopped: {len(done)} of {len(args.recordings)} recordings are scored")
    if not done:
        return
    wanted = set(args.centre or ())
    there = {name for one in done for name in one.book.centres}
    if wanted - there:
        raise ReviewError(
            f"no centre {min(wanted - there)!r} in these recordings; there are: {', '.join(sorted(there))}"
        )
    _tell(args, done, truths, seals, profile)


def _tell(
    args: argparse.Namespace,
    done: list[Assessment],
    truths: Truths,
    seals: list[Finding],
    profile: Profile | None,
) -> None:
    """Print, and write, what came of it. Raises `ReviewError`: also where a requirement of the profile is not met."""
    from fusion_service.commands.sealed import say
    from fusion_service.review.evaluation.results import results, text
    from fusion_service.review.profiles import telling

    if by := requirements.by_what(args):
        print(f"scored against {by}")
    print(text(done, "the truth" if args.reference in (None, "each") else "the reference"))
    if truths.note:
        print(truths.note)
    fits = zip(done if args.truth else (), truths.told, strict=False)
    odd = [f"{args.truth}: {words}" for one, given in fits if (words := _misfit(one, given, truths))]
    for words in odd:
        print(words, file=sys.stderr)
    each = requirements.each_source(args, done) if args.reference == "each" else []
    judged = requirements.told(args, profile, done, truths) if profile else []
    if judged:
        print(telling.text(judged))
    for recording, seal in zip(args.recordings, seals, strict=False):
        say(recording, seal)
    if args.json:
        scores = results(done)
        for told, seal in zip(scores["recordings"], seals, strict=False):
            told["seal"] = seal.as_json()
        scores |= {"reference": by, "misfit": odd}
        if each:
            scores["each_source"] = each
        if profile:
            scores["requirements"] = telling.as_json(judged)
        Path(args.json).write_text(json.dumps(scores, allow_nan=False) + "\n", encoding="utf-8")
        print(f"scores: {args.json}")
    if args.html:
        from fusion_service.review.evaluation.report import report

        Path(args.html).write_text(report(done, [*telling.against(by, odd), *telling.page(judged)]), encoding="utf-8")
        print(f"page:   {args.html}")
    if profile:
        requirements.conclude(judged)


def _misfit(one: Assessment, given: list[Truth], truths: Truths) -> str:
    """What is to be said of a truth that hardly fits a mission, "" where it does."""
    from fusion_service.review.evaluation.truth_fit import misfit

    centre, found = next(iter(one.evaluations.items()), ("", None))
    if found is None or not centre:
        return ""
    lost = math.isnan(found.fused.anees)
    return misfit(one.book, centre, given, truths.table, one.c, lost) if lost or found.fused.anees > ODD else ""
