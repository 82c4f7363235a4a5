"""What `evaluate` does with a profile of requirements, and with a reference that is smoothed from the sources."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fusion_service.review.evaluation import Assessment
    from fusion_service.review.evaluation.logbook import Logbook
    from fusion_service.review.evaluation.truth import TruthFile
    from fusion_service.review.profiles import Profile
    from fusion_service.review.profiles.telling import Told
    from schemas import Truth

__all__ = ["Truths", "add", "begin", "by_what", "conclude", "each_source", "listed", "told"]

WITHOUT = "without:"
EACH = ("rmse_position", "anees", "pairs", "followed", "targets", "identity_switches")


def add(parser: argparse.ArgumentParser) -> None:
    """The options --profile and --reference."""
    parser.add_argument(
        "--profile",
        metavar="FILE|NAME",
        help="judge by these requirements: a TOML file, or a shipped profile (`--profile list` prints them); exit "
        "code 1 where one is failed or not shown",
    )
    parser.add_argument(
        "--reference",
        metavar="WHAT",
        help="instead of truth: smoothed (from all sources), without:SOURCE (from all others), or each (every source "
        "by all others, as a table)",
    )


def listed(args: argparse.Namespace) -> bool:
    """Whether it was `--profile list`: prints them."""
    if args.profile != "list":
        return False
    from fusion_service.review.profiles import load_profile, shipped

    for name, path in shipped().items():
        one = load_profile(name)
        print(f"{name:<20}{one.name}: {len(one.requirements)} requirements; {one.source}\n{'':<20}{path}")
    return True


def begin(args: argparse.Namespace) -> Profile | None:
    """The profile asked for, read. Raises `ProfileError`, `UsageError`."""
    from fusion_service.errors import UsageError
    from fusion_service.review.profiles import load_profile

    what = args.reference
    if what is not None:
        if what not in ("smoothed", "each") and not (what.startswith(WITHOUT) and what != WITHOUT):
            raise UsageError(f"--reference {what}: write smoothed, without:SOURCE or each")
        if args.truth:
            raise UsageError("--reference and --truth: one of them")
    if not args.recordings:
        raise UsageError("name a recording, as in evaluate mission.rrd")
    return load_profile(args.profile) if args.profile else None


class Truths:
    """What missions are scored against: truth of a file, or the smoothed reference that is asked for; neither where a
    mission has truth of its own. told: what it was, mission by mission."""

    def __init__(self, args: argparse.Namespace, file: TruthFile) -> None:
        self.told: list[list[Truth]] = []
        self.names, self.note, self.table = file.names, file.note, file.table
        self._args, self._file = args, file

    def messages(self, book: Logbook) -> list[Truth]:
        """For the mission of `book`. Raises `ReviewError` where there can be none."""
        found = self._file.messages(book)
        what = self._args.reference
        if what is not None and what != "each":
            from fusion_service.review.smoothing import smoothed_truth

            centre = next((name for name in self._args.centre or () if name in book.centres), None)
            found = smoothed_truth(book, centre, what.removeprefix(WITHOUT) if what.startswith(WITHOUT) else None)
        self.told.append(found)
        return found


def by_what(args: argparse.Namespace) -> str:
    """What is scored against, in words; empty for a mission's own truth, by which `each` has all but its table."""
    if args.reference in (None, "each"):
        return f"the truth in {args.truth}" if args.truth else ""
    left = args.reference[len(WITHOUT) :] if args.reference.startswith(WITHOUT) else ""
    whose = f"all sources but {left}" if left else "all sources"
    return f"a reference smoothed from {whose}, which does not see what these have in common"


def told(args: argparse.Namespace, profile: Profile, done: Sequence[Assessment], truths: Truths) -> list[Told]:
    """Every centre of every recording under the profile. Raises `ReviewError` where nothing can be scored."""
    from fusion_service.review.profiles import judge
    from fusion_service.review.profiles.observing import observe
    from fusion_service.review.profiles.telling import Told

    sources = any(one.kind == "tracked_through" for one in profile.requirements)
    found = []
    for one, given in zip(done, truths.told, strict=False):
        wanted = [name for name in one.book.centres if not args.centre or name in args.centre]
        for name in wanted:
            cutoff = args.cutoff or profile.cutoff or one.c
            seen = observe(one.book, name, given or one.book.truths, cutoff, every=args.every, sources=sources)
            path = Path(one.book.path or "mission").name
            found.append(
                Told(profile, path, name, cutoff, by_what(args), judge(profile, seen, truths.names), truths.names)
            )
    return found


def each_source(args: argparse.Namespace, done: Sequence[Assessment]) -> list[dict[str, Any]]:
    """Print, of every recording, each source beside the reference of all others; and the same as plain values, with
    why there is none of a source."""
    from fusion_service.errors import ReviewError
    from fusion_service.review.evaluation import assess
    from fusion_service.review.evaluation.scoring import plain
    from fusion_service.review.evaluation.tables import aligned, digits, fixed
    from fusion_service.review.smoothing import smoothed_truth

    found: list[dict[str, Any]] = []
    for one in done:
        centre = next((name for name in args.centre or one.book.centres if name in one.book.centres), None)
        rows = [["source", "RMSE, m", "ANEES", "pairs", "followed", "switches"]]
        for name in one.book.sources:
            told: dict[str, Any] = {"recording": str(one.book.path or ""), "source": name}
            found.append(told)
            try:
                truths = smoothed_truth(one.book, centre, name)
                scored = assess(one.book, c=args.cutoff or one.c, every=args.every, truths=truths)
                scores = next(iter(scored.evaluations.values())).sources[name]
            except (ReviewError, KeyError) as error:
                told["why"] = str(error)
                rows.append([name, "-", "-", str(error)[:60], "", ""])
                continue
            targets = len(next(iter(scored.evaluations.values())).targets)
            pairs = int((scores.errors == scores.errors).sum())
            numbers = (scores.rmse_position, scores.anees, pairs, scores.followed, targets, scores.identity_switches)
            told |= dict(zip(EACH, map(plain, numbers), strict=True))
            followed = f"{scores.followed} of {targets}"
            shown = [digits(scores.rmse_position), fixed(scores.anees), str(pairs), followed]
            rows.append([name, *shown, str(scores.identity_switches)])
        print(f"\n{one.book.path}: each source by a reference smoothed from all others, no truth used")
        print("\n".join(aligned(rows)))
    return found


def conclude(said: Sequence[Told]) -> None:
    """Raise `ReviewError`, exit code 1, where a requirement is failed or not shown."""
    from fusion_service.errors import ReviewError
    from fusion_service.review.profiles.judging import PASSED, worst
    from fusion_service.review.profiles.telling import summary

    if not said:
        raise ReviewError("no centre in these recordings: there is no picture to judge")
    if any(worst(one.judged) != PASSED for one in said):
        raise ReviewError(summary(said))
