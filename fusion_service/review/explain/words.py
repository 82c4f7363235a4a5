"""Where a global track came from, in words: its life as a timeline, what each source brought, what became of it."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from fusion_service.decision_words import MINE, SAID, THEIRS
from fusion_service.densities import moments
from fusion_service.errors import ReviewError
from fusion_service.labels import utc
from fusion_service.review.explain.fused_by import SourceSaid, shares
from fusion_service.review.explain.histories import GONE, TrackHistory
from fusion_service.review.explain.mission import RecordedMission, Refusals
from fusion_service.review.explain.story import CAME, WENT, Composition, Happening, Link, Member, Story, local_messages
from schemas import STATUSES, LocalTracks
from schemas.messages import BORN, BROKEN, COASTING, CONFIRMED_NOW, GATE_FAILED, KEPT, MERGED, SPLIT, TENTATIVE

__all__ = ["explanation", "listing"]

RUNNING = (SAID[KEPT], SAID[GATE_FAILED])
SPELLS = 6
"""Spells of a link inside and outside its gate that are told one by one."""
LONGEST_CHAIN = 20
MOST_LINES = 200
MARGIN = 10.0
"""Seconds around a life in which refusals are told."""


def explanation(mission: RecordedMission) -> str:
    """The story of `mission.story` in words. Raises `ReviewError` where the track was not there at the time asked
    for."""
    story = mission.story
    assert story is not None
    if story.until is not None and (story.until < story.first or story.composition is None):
        raise ReviewError(
            f"track {mission.labels(story.track)} was not there at {mission.seconds(story.until):.1f} s: "
            f"it lived from {mission.seconds(story.first):.1f} to {mission.seconds(story.last):.1f} s"
        )
    teller = _Teller(mission, story)
    blocks = [teller.header(), teller.timeline(), teller.contributions(), teller.summary()]
    return "\n\n".join("\n".join(block) for block in blocks if block)


def listing(mission: RecordedMission, *, everything: bool = False) -> str:
    """The tracks of a mission, a line each: those that were ever confirmed, or all."""
    lives = sorted(mission.histories, key=lambda one: (one.first, one.track))
    shown = [one for one in lives if one.confirmed or everything]
    rows = [["track", "from s", "to s", "life s", "events", "sources", "became"]]
    for one in shown:
        until = mission.histories.until(one)
        first, last = mission.seconds(one.first), mission.seconds(until)
        sources = " ".join(sorted(one.sources)) or "-"
        numbers = [f"{value:.1f}" for value in (first, last, last - first)]
        rows.append([mission.labels(one.track), *numbers, str(one.events), sources, _became(mission, one)])
    head = f"{mission.path}: centre {mission.centre.name}, {mission.steps} steps from {utc(mission.start, 'T')}"
    left = len(lives) - len(shown)
    never = f"; {left} more were never confirmed (--all lists them)" if left else ""
    count = f"{len(shown)} track{'s' * (len(shown) != 1)}"
    tail = f"{count}{never}. Ask for one: fusion-service explain {shlex.quote(str(mission.path))} --track NUMBER"
    return "\n".join([head, *_table(rows, left=(0, 5, 6)), *_ways(mission), tail])


def _ways(mission: RecordedMission) -> list[str]:
    """By which ways confirmed tracks were fused, and what was amiss with sources at the end."""
    ways = mission.fused_by
    said = [f"{one.source}: {one.text} (since {mission.seconds(one.time):.1f} s)" for one in ways.unwell()]
    return [f"fused by: {shares(ways.all)} of the steps of confirmed tracks", *said] if ways.several or said else []


def _became(mission: RecordedMission, life: TrackHistory) -> str:
    label = mission.labels
    parts = [] if life.parent is None else [f"{MINE[SPLIT]} {label(life.parent)}"]
    parts += [f"{THEIRS[MERGED]} {', '.join(map(label, life.took))}"] if life.took else []
    if life.ended is None:
        return "; ".join([*parts, "there at the end"])
    _, reason, heir = life.ended
    return "; ".join([*parts, reason if heir is None else f"{reason} into {label(heir)}"])


class _Teller:
    """Writes the blocks of one story."""

    def __init__(self, mission: RecordedMission, story: Story) -> None:
        self.mission, self.story = mission, story
        self.label = mission.labels
        self.new_gate, self.gate, self.merge_gate = mission.gates()
        sources = [source for source, _, _ in story.links]
        runs = {(source, epoch) for source, epoch, _ in story.links}
        self._epochs = {source: sorted(epoch for one, epoch in runs if one == source) for source in set(sources)}

    def time(self, at: int) -> str:
        return f"{self.mission.seconds(at):.1f}"

    def name(self, member: Member) -> str:
        """`radar1 3`; the run of the source where there were several."""
        source, epoch, local = member
        runs = self._epochs.get(source, [])
        run = f" (run {runs.index(epoch) + 1})" if len(runs) > 1 and epoch in runs else ""
        intensity = self.mission.config is not None and self.mission.config.kind == "intensity"
        return f"{source}{'' if intensity else f' {local}'}{run}"

    def names(self, members: Iterable[Member]) -> str:
        found = [self.name(member) for member in members]
        return found[0] if len(found) == 1 else f"{', '.join(found[:-1])} and {found[-1]}" if found else "nobody"

    def header(self) -> list[str]:
        mission, story, track = self.mission, self.story, self.story.track
        gates = ""
        if math.isfinite(self.gate):
            gates = f"; gates on d2: {self.new_gate:.1f} for a new link, {self.gate:.1f} for a standing one"
        status = ", ".join(f"{story.status[name]} {name}" for name in STATUSES if story.status[name])
        low, high = story.existence
        existence = f"existence {low:.2g}" if low == high else f"existence {low:.2g} to {high:.2g}"
        whole = f" (id {track}, generation {track >> 32})" if track >> 32 else ""
        span = f"{self.time(story.first)} to {self.time(story.last)} s"
        ways = mission.fused_by
        by = f"; fused by {shares(ways.steps)}" if ways.several and ways.steps else ""
        return [
            f"track {self.label(track)}{whole} of centre {mission.centre.name} in {mission.path}",
            f"mission from {utc(mission.start, 'T')}, {mission.steps} steps, rule {mission.rule}{gates}",
            f"lived from {span}, {story.steps} steps: {status}; {existence}{by}",
        ]

    def timeline(self) -> list[str]:
        rows = [("s", "what")]
        told = sorted(_compact(self.story.happenings), key=lambda one: (one.first, one.what != SAID[BORN]))
        lines = [(one.first, self._span(one.first, one.last), self._what(one)) for one in told]
        lines += [(one.first, self._span(one.first, one.last), self._refusal(one)) for one in self._refusals()]
        lines += list(self._fused_by())
        if self.story.ended is not None:
            at = self.story.ended[0]
            lines.append((at, self.time(at), f"ended: {self._end()}"))
        lines.sort(key=lambda one: one[0])
        rows += [line[1:] for line in lines]
        if len(rows) > MOST_LINES:
            half = MOST_LINES // 2
            rows = [*rows[:half], ("...", f"{len(rows) - 2 * half} lines left out"), *rows[-half:]]
        width = max(len(row[0]) for row in rows)
        return [f"{when:<{width}}  {what}" for when, what in rows]

    def _span(self, first: int, last: int) -> str:
        return self.time(first) if first == last else f"{self.time(first)}-{self.time(last)}"

    def _what(self, one: Happening) -> str:
        whom = f"{self.name(one.member)} " if one.member is not None else ""
        other = f" {self.label(one.other)}" if one.other is not None else ""
        steps = f" {one.steps} steps" if one.what.startswith(RUNNING) and one.steps > 1 else ""
        return f"{whom}{one.what}{other}{steps}{self._distance(one)}"

    def _distance(self, one: Happening) -> str:
        if not math.isfinite(one.low):
            return ", alone" if one.what == SAID[KEPT] else ""
        span = "-".join(dict.fromkeys((f"{one.low:.1f}", f"{one.high:.1f}")))
        gate = self.gate if one.what.startswith((*RUNNING, SAID[BROKEN])) else self.new_gate
        gate = self.merge_gate if one.what in (MINE[MERGED], THEIRS[MERGED]) else gate
        return f", d2 {span}" + (f" of gate {gate:.1f}" if math.isfinite(gate) else "")

    def _refusals(self) -> list[Refusals]:
        sources = {member[0] for member in self.story.links}
        early, late = self.story.first - MARGIN * 1e9, self.story.last + MARGIN * 1e9
        runs = self.mission.refusals
        return [one for one in runs if one.source in sources and one.last >= early and one.first <= late]

    def _refusal(self, one: Refusals) -> str:
        parts = [f"{one.messages} messages"] if one.messages else []
        parts += [f"{one.tracks} tracks"] if one.tracks else []
        return f"{one.source}: {' and '.join(parts)} refused ({one.reason})"

    def _fused_by(self) -> Iterator[tuple[int, str, str]]:
        """Lines of how it was fused, and of what was said of its sources."""
        ways = self.mission.fused_by
        if ways.several:
            yield from ((one.first, self._span(one.first, one.last), str(one)) for one in ways.spells())
        for said in self._said_of_sources():
            yield said.time, self.time(said.time), f"{said.source}: {said.text}"

    def _said_of_sources(self) -> list[SourceSaid]:
        story = self.story
        return self.mission.fused_by.of((member[0] for member in story.links), story.first, story.last)

    def contributions(self) -> list[str]:
        """What each member brought, at the time asked for and over the life of the track."""
        composition, story = self.story.composition, self.story
        if composition is None or not story.links:
            return []
        said = {member: _said(member, composition) for member in composition.influence}
        rows = [["source and track", "influence", "mean", "least", "most", "steps", "d2", "age s", "sigma m", "says"]]
        for member in sorted(story.links, key=lambda one: (one not in composition.influence, one)):
            link = story.links[member]
            age, sigma, identity = said.get(member, ("", "", ""))
            here = f"{composition.influence[member]:.2f}" if member in composition.influence else "-"
            d2 = f"{composition.values[member]:.1f}" if math.isfinite(composition.values.get(member, math.nan)) else "-"
            rows.append([self.name(member), here, *_over_life(link), str(link.steps), d2, age, sigma, identity])
        if not any(row[-1] for row in rows[1:]):
            rows = [row[:-1] for row in rows]
        at = composition.picture.time
        status = STATUSES[composition.picture.status[composition.row]]
        head = f"contributions at {self.time(at)} s (step {composition.picture.step}, {status}), and over its life:"
        return [head, *_table(rows, left=(0, 9))]

    # In plain words

    def summary(self) -> list[str]:
        return [" ".join([*self._began(), *self._lived(), *self._became()])]

    def _began(self) -> list[str]:
        story, name = self.story, self.label(self.story.track)
        born = next((one for one in story.happenings if one.what == SAID[BORN]), None)
        split = next((one for one in story.happenings if one.what == MINE[SPLIT]), None)
        life = self.mission.histories.known[story.track]
        at = self.time(story.first)
        if born is None:
            why = "when the recording of it begins"
            return [f"Track {name} was there already at {at} s, {why}."]
        founders = [member for member, link in story.links.items() if link.first == born.first]
        text = f"Track {name} was born at {self.time(born.first)} s from {self.names(founders)}"
        parent = split.other if split is not None else life.parent
        if parent is not None:
            why = "by an operator's order" if SPLIT in story.ordered else "with which it no longer agreed"
            text += f", split from track {self.label(parent)} {why}"
        confirmed = next((one for one in story.happenings if one.what == SAID[CONFIRMED_NOW]), None)
        if confirmed is None:
            return [f"{text}; it was never confirmed."]
        when = "at once" if confirmed.first == born.first else f"{(confirmed.first - born.first) / 1e9:.1f} s later"
        ancestors = self._chain(parent, lambda life: life.parent, "was itself split from")
        return [f"{text}, and confirmed {when}.", *ancestors]

    def _lived(self) -> list[str]:
        story = self.story
        said = []
        late = [one for one in story.links if story.links[one].first > story.first]
        if late:
            said.append(f"{self.names(late)} joined later.")
        for one in story.happenings:
            at = self.time(one.first)
            if one.what == SAID[BROKEN] and one.member is not None:
                why = "too far from the others" if math.isfinite(one.low) else "another has its place"
                said.append(f"{self.name(one.member)} was broken off at {at} s: {why}.")
            elif one.what in (CAME, WENT) and one.member is not None and one.other is not None:
                how, where = ("came over from", "here") if one.what == CAME else ("went over to", "there")
                whom = f"{self.name(one.member)} {how} track {self.label(one.other)}"
                said.append(f"{whom} at {at} s: it fits better {where}.")
            elif one.what == THEIRS[MERGED] and one.other is not None:
                said.append(f"It took in track {self.label(one.other)} at {at} s.")
            elif one.what == THEIRS[SPLIT] and one.other is not None:
                said.append(f"Track {self.label(one.other)} was split off it at {at} s.")
        if story.status["coasting"]:
            said.append(f"It coasted for {story.status['coasting']} of its {story.steps} steps.")
        said += self._by()
        heavy = sorted(story.links, key=lambda one: -story.links[one].total)[:3]
        total = sum(story.links[one].total for one in story.links)
        if total > 0:
            parts = [f"{self.name(one)} {story.links[one].total / total:.0%}" for one in heavy]
            said.append(f"Over its life its data came from {', '.join(parts)}.")
        return said

    def _by(self) -> list[str]:
        """How it was fused, and whose tracks were no tracklets in the end."""
        ways = self.mission.fused_by
        said = []
        if ways.several and len(ways.steps) > 1:
            parts = [f"{way} in {count}" for way, count in ways.steps.most_common()]
            said.append(f"Of {ways.steps.total()} steps with a source it was fused by {', '.join(parts)}.")
        elif ways.several and ways.steps:
            said.append(f"It was fused by {next(iter(ways.steps))} all the time.")
        newest = {(one.source, one.kind): one for one in self._said_of_sources()}
        return said + [f"{name}: {one.text}." for (name, _), one in sorted(newest.items()) if not one.good]

    def _became(self) -> list[str]:
        story = self.story
        if story.ended is None:
            return ["It was still there at the end of the recording."]
        at, _, heir = story.ended
        text = f"It ended at {self.time(at)} s: {self._end()}."
        if heir is None:
            return [text]
        return [
            text,
            *self._chain(heir, lambda life: life.ended[2] if life.ended is not None else None, "was merged into"),
        ]

    def _end(self) -> str:
        """Why it ended."""
        story, config = self.story, self.mission.config
        assert story.ended is not None
        at, reason, heir = story.ended
        if heir is not None and MERGED in story.ordered:
            return f"{reason} into track {self.label(heir)} by an operator's order"
        if heir is not None:
            return f"{reason} into track {self.label(heir)}, the older one, with which it agreed"
        if reason == "ordered":
            return "deleted by an operator's order"
        if reason == GONE:
            return "the next picture does not show it, and no log says why"
        if story.newest is None:
            return reason
        picture, row = story.newest
        silent = (at - story.supported) / 1e9
        if config is not None and picture.existence[row] < config.min_existence:
            return f"its existence fell below {config.min_existence:g} (min_existence) without a source"
        if picture.status[row] == TENTATIVE and not (config is not None and silent > config.coast):
            return f"no source had it any more after {self.time(story.supported)} s, and it was tentative"
        if config is not None and 0 < silent <= config.coast:
            return f"its sources list it no more, and for {silent:.1f} s no report has brought it back"
        if picture.status[row] == COASTING or silent > 0:
            limit = f", longer than {config.coast:g} s (coast)" if config is not None else ""
            return f"no source had it for {silent:.1f} s{limit}"
        return reason

    def _chain(self, track: int | None, following: Callable[[TrackHistory], int | None], how: str) -> list[str]:
        """A sentence for each track of a line of ancestors or heirs."""
        said: list[str] = []
        seen = {self.story.track}
        while track is not None and track not in seen and len(said) < LONGEST_CHAIN:
            seen.add(track)
            life = self.mission.histories.known.get(track)
            if life is None:
                break
            until = self.time(self.mission.histories.until(life))
            text = f"Track {self.label(track)}, from {', '.join(sorted(life.sources)) or 'no source'}, lived from"
            text = f"{text} {self.time(life.first)} to {until} s"
            track = following(life)
            said.append(f"{text} and {how} {self.label(track)}." if track is not None else f"{text}.")
        return said


def _compact(happenings: Sequence[Happening]) -> list[Happening]:
    """The same, with the spells of a link inside and outside its gate as one where they are many."""
    spells: dict[Member, list[Happening]] = {}
    told: list[Happening] = []
    closed: list[list[Happening]] = []
    for one in happenings:
        if one.member is not None and one.what in RUNNING:
            spells.setdefault(one.member, []).append(one)
            continue
        told.append(one)
        if one.member is not None and one.member in spells:
            closed.append(spells.pop(one.member))
    for some in (*closed, *spells.values()):
        told += some if len(some) <= SPELLS else [_joined(some)]
    return told


def _joined(some: Sequence[Happening]) -> Happening:
    kept, outside = ([one for one in some if one.what == what] for what in RUNNING)
    steps = sum(one.steps for one in outside)
    what = f"{RUNNING[0]} {sum(one.steps for one in kept)} steps, {RUNNING[1]} {steps} in {len(outside)} spells"
    low, high = np.fmin.reduce([one.low for one in some]), np.fmax.reduce([one.high for one in some])
    return Happening(
        some[0].first, max(one.last for one in some), what, some[0].member, None, 1, float(low), float(high)
    )


def _over_life(link: Link) -> list[str]:
    if not math.isfinite(link.least):
        return ["-", "-", "-"]
    return [f"{value:.2f}" for value in (link.total / link.steps, link.least, link.most)]


def _said(member: Member, composition: Composition) -> tuple[str, str, str]:
    """Of the newest message of a member's source that holds it: age (s), standard deviation of its position (m), and
    what it says that it is."""
    source, epoch, local = member
    for message in reversed(local_messages(composition.recent.get(source, ()))):
        if message.epoch != epoch or message.time > composition.picture.time:
            continue
        age = f"{(composition.picture.time - message.time) / 1e9:.1f}"
        if not isinstance(message, LocalTracks):
            return age, "", ""
        rows = np.flatnonzero(message.ids == np.uint64(local))
        if not len(rows):
            continue
        row = int(rows[0])
        _, covariances = moments(message.means, message.covariances, message.weights, message.counts)
        places = [message.space.index(name) for name in "xyz" if name in message.space]
        variance = float(np.mean(covariances[row][places, places]))
        says = [column[row] for column in (message.identity, message.kind) if column is not None]
        return age, f"{math.sqrt(max(variance, 0.0)):.3g}", " ".join(one for one in says if one)
    return "", "", ""


def _table(rows: Sequence[Sequence[str]], left: Sequence[int]) -> list[str]:
    """Rows in columns, those of `left` to the left."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [
            f"{cell:<{w}}" if k in left else f"{cell:>{w}}" for k, (cell, w) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return lines
