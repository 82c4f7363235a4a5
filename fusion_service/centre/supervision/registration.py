"""Clock offsets and registration errors of the sources, estimated from the targets that they share.

`bias` says what the errors are, `estimate` how they are found jointly, `gauge` by what they are measured, `lasting` how
little successive data tell, `matching` what is done where errors are too large for any link, `correction` how they are
taken off. What is known fades with `registration_memory`: drift is followed where it is slow beside that.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fusion_service.arrays import Bools, Floats, Ints, from_bytes, to_bytes
from fusion_service.centre.intake import Intake
from fusion_service.centre.journal import Journal
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.places import Place
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.centre.stated_registration import shift_of
from fusion_service.centre.supervision import telling
from fusion_service.centre.supervision.applying import Applied, decide
from fusion_service.centre.supervision.bias import CLOCK, DRIFT, PARAMETERS, prior_sigma, site_of
from fusion_service.centre.supervision.comparing import Compared, Treated, chosen_rows, compared, labels
from fusion_service.centre.supervision.correction import Bias
from fusion_service.centre.supervision.estimate import Information, Posterior
from fusion_service.centre.supervision.gauge import connected, gauge, gauge_weights, gauge_words, halved
from fusion_service.centre.supervision.lasting import Lasting, robust
from fusion_service.centre.supervision.unlinked import Unlinked
from fusion_service.centre.treatment import Correction
from schemas import Ecef, SensorInfo

__all__ = ["Registration"]

P = len(PARAMETERS)
MOST_SOURCES = 64
"""That are estimated together: those that share most."""
SEEN = 6
CERTAIN = 0.25


@dataclass(slots=True, eq=False)
class _Known:
    """What is found of the sources of the estimate (S,) in a step."""

    sigma: Floats
    label: Ints
    reference: Bools
    posterior: Posterior
    sites: Floats = field(default_factory=lambda: np.zeros((2, 0)))


class Registration:
    """The estimates of all sources."""

    def __init__(self, intake: Intake) -> None:
        self._intake = intake
        self._begin()

    def _begin(self) -> None:
        self._frame = self._intake.frame
        self._information, self._lasting = Information(), Lasting()
        self._seen = np.zeros((0, SEEN))
        self._effect = np.zeros((0, 3))
        self._epochs: dict[str, int] = {}
        self._applied: dict[str, Applied] = {}
        self._known: _Known | None = None
        self._weights = np.zeros((0, P))
        self._standings: dict[str, tuple[SensorInfo | None, Place | None, Floats, Floats]] = {}
        self._unlinked = Unlinked()
        self._step, self._time = 0, -1

    @property
    def _works(self) -> bool:
        config = self._intake.config
        placed = {"x", "y"} <= set(config.space) and not isinstance(self._intake.frame, (Ecef, type(None)))
        return config.registration != "off" and placed

    def observe(self, rows: Rows, names: tuple[str, ...], now: Picture, time: int, journal: Journal) -> None:
        """Learn from a step. now: the picture predicted to it, with its links decided."""
        if self._frame != self._intake.frame:
            self._begin()
        if not self._works:
            return
        self._step += 1
        whose = self._arrange(rows, names)
        if self._time >= 0:
            dt = max(time - self._time, 0) / 1e9
            kept = math.exp(-dt / self._intake.config.registration_memory)
            self._information.fade(kept, dt)
            self._seen = kept * self._seen
        self._time = time
        if not self._information.names:
            self._known = None
            return
        label = labels(rows, self._unlinked.same())
        row = chosen_rows(rows, label, now, whose, self._lasting, self._step)
        how = self._how()
        part = compared(rows, row, label, now, whose, how, self._intake.config.space)
        self._take(part, rows, how.site)
        if self._known is None or not len(row):
            self._estimate(how.site)
        self._weigh(part)
        assert self._known is not None
        self._unlinked.look(rows, whose, how.site, self._known.sigma, self._intake.config.space, self._step)
        self._decide(journal)

    def _arrange(self, rows: Rows, names: tuple[str, ...]) -> Ints:
        """Have the sources in the estimate that it is about; the number of each (N,) there, or -1."""
        old = self._information.names
        linked = np.bincount(rows.source[rows.tracks.link != NO_TRACK], minlength=len(names))
        wanted = [name for name, count in zip(names, linked.tolist(), strict=True) if count or name in old]
        if len(wanted) > MOST_SOURCES:
            most = dict(zip(names, linked.tolist(), strict=True))
            order = sorted(wanted, key=lambda name: (-most[name] * (2 if name in old else 1), name))
            wanted = sorted(order[:MOST_SOURCES])
        new = tuple(wanted)
        if new != old:
            to = np.array([new.index(name) if name in new else -1 for name in old], dtype=np.intp)
            self._information.arrange(new)
            self._lasting.arrange(to, len(new))
            for name in ("_seen", "_effect"):
                before = getattr(self, name)
                after = np.zeros((len(new), before.shape[1]))
                after[to[to >= 0]] = before[to >= 0]
                setattr(self, name, after)
            self._applied = {name: one for name, one in self._applied.items() if name in new}
            self._standings = {name: one for name, one in self._standings.items() if name in new}
            self._known, self._weights = None, np.ones((len(new), P))
        for at, name in enumerate(new):
            epoch = self._intake.sources[name].epoch
            if self._epochs.get(name, epoch) != epoch:
                self._restarted(at)
        self._epochs = {name: self._intake.sources[name].epoch for name in new}
        return np.array([new.index(name) if name in new else -1 for name in names], dtype=np.intp)

    def forget(self, name: str) -> None:
        """All that a source says has jumped: its errors are other ones."""
        if name in self._information.names:
            at = self._information.names.index(name)
            self._information.forget(at, np.ones(P, dtype=np.bool_))
            self._lasting.forget(at)
            self._applied[name] = Applied()
            self._estimate(self._how().site)

    def _restarted(self, at: int) -> None:
        """Its clock may be another; its place and heading are what they were."""
        which = np.zeros(P, dtype=np.bool_)
        which[[CLOCK, DRIFT]] = True
        self._information.forget(at, which)
        self._lasting.forget(at)

    def _how(self) -> Treated:
        names, config = self._information.names, self._intake.config
        count = len(names)
        value, common, shift = np.zeros((count, P)), np.zeros((count, P, P)), np.zeros((2, 2, count))
        xy = [config.space.index(axis) for axis in ("x", "y")]
        sites = np.zeros((2, count))
        for at, name in enumerate(names):
            sites[:, at] = self._standing(name)[1]
            applied = self._applied.get(name)
            if applied is not None and applied.on:
                value[at], common[at] = applied.value, applied.covariance
            elif (stated := shift_of(self._intake, self._intake.sources[name])) is not None:
                shift[..., at] = stated[np.ix_(xy, xy)]
        return Treated(sites, value, common, shift)

    def _take(self, part: Compared, rows: Rows, sites: Floats) -> None:
        """Add what the rows say, each as its source's errors last, and less where it is far from what is expected."""
        group, tracks = part.group, rows.tracks
        if not len(part.row):
            return
        if self._known is None:
            self._estimate(sites)
        assert self._known is not None
        expected = self._residual(part, self._known.posterior.mean)
        factor = 1.0 / self._lasting.ratio[group.source]
        self._information.add(robust(group, expected, factor))
        self._estimate(sites)
        certain = self._certain(part)
        residual = self._residual(part, self._known.posterior.mean)
        ids, updated = tracks.id[part.row], tracks.updated[part.row]
        before = self._lasting.ratio
        self._lasting.learn(replace(group, weight=group.weight * factor), ids, updated, residual, certain)
        self._information.reweigh(before, self._lasting.ratio)
        v = part.velocity[:, group.group]
        what = (np.ones(len(part.row)), v[0], v[1], v[0] ** 2, v[0] * v[1], v[1] ** 2)
        self._seen = self._seen + np.stack(
            [np.bincount(group.source, one, minlength=len(self._seen)) for one in what], axis=1
        )

    def _residual(self, part: Compared, mean: Floats) -> Floats:
        group = part.group
        return np.asarray(group.z - sum(group.H[:, k] * mean[group.source, k] for k in range(P)))

    def _certain(self, part: Compared) -> Bools:
        """The rows (M,) of targets of which all errors are so well known that what stays of them hardly looks like an
        error that lasts: what a fit leaves is short of them as much as they are uncertain."""
        assert self._known is not None
        common = _common(part, self._known.posterior)
        vague = common[0, 0] + common[1, 1] > CERTAIN * (part.own[0, 0] + part.own[1, 1])
        group = part.group
        return np.asarray(np.bincount(group.group, vague, minlength=len(group.start))[group.group] == 0)

    def _estimate(self, sites: Floats) -> None:
        names, info = self._information.names, self._information
        sigma = np.array([self._standing(name)[0] for name in names]).reshape(-1, P)
        reference = np.array([self._intake.config.source(name).reference for name in names], dtype=np.bool_)
        label = connected(info.shared)
        if self._known is not None:
            before = self._known.posterior
            self._weights = gauge_weights(sigma, label, before.mean, before.variance)
        posterior = info.posterior(sigma, gauge(sigma, label, reference, self._weights))
        if not posterior.sound:  # what no data can do, and absurd ones might
            self._information, self._weights = Information(names), np.ones(sigma.shape)
            posterior, label = self._information.posterior(sigma, np.zeros((0, *sigma.shape))), np.arange(len(names))
        self._known = _Known(sigma, label, reference, posterior, sites)

    def _standing(self, name: str) -> tuple[Floats, Floats]:
        """How large the errors of a source may be (7,), and its place (2,); kept while it says the same of itself."""
        source = self._intake.sources[name]
        kept = self._standings.get(name)
        if kept is None or kept[0] is not source.info or kept[1] is not source.place:
            here = prior_sigma(self._intake, source), site_of(self._intake, source)
            kept = self._standings[name] = source.info, source.place, *here
        return kept[2:]

    def _weigh(self, part: Compared) -> None:
        """How large the errors, and what stays of them, are beside those that the rows have of their own: (S, 3), mean
        squares; last the errors beside what the source says of its own, before it is treated."""
        if not len(part.row) or self._known is None:
            return
        group = part.group
        off = sum(group.H[:, k] * self._known.posterior.mean[group.source, k] for k in range(P))
        common = _common(part, self._known.posterior)
        inverse = group.weight
        square = sum(off[i] * inverse[i, j] * off[j] for i in (0, 1) for j in (0, 1)) / 2.0
        stays = sum(common[i, j] * inverse[j, i] for i in (0, 1) for j in (0, 1)) / 2.0
        count = np.bincount(group.source, minlength=len(self._effect))
        there = count > 0
        said = np.array([self._intake.treatment(name).inflation[0] for name in self._information.names])[group.source]
        for column, value in enumerate((square, stays, square * said)):
            new = np.bincount(group.source, np.asarray(value), minlength=len(count))[there] / count[there]
            old = self._effect[there, column]
            self._effect[there, column] = np.where(old > 0, old + 0.2 * (new - old), new)

    def _told(self, at: int) -> telling.Told:
        assert self._known is not None
        mean, covariance = self._known.posterior.of(at)
        shares = bool((self._known.label == self._known.label[at]).sum() > 1)
        return telling.Told(mean, covariance, self._known.sigma[at], self._seen[at], shares)

    def _decide(self, journal: Journal) -> None:
        if self._known is None:
            return
        corrects = self._intake.config.registration == "correct"
        for at, name in enumerate(self._information.names):
            told, before = self._told(at), self._applied.get(name, Applied())
            after, what = decide(before, told, self._effect[at], self._intake.config.supervision_errors, corrects)
            if after.on and halved(self._known.label, self._known.reference, at):  # which half of it is right?
                both = after.covariance + np.outer(after.value, after.value)
                after = replace(after, covariance=both, loose=True)
            self._applied[name] = after
            if what:
                words = telling.note(told, after.on, after.found, corrects)
                journal.event(
                    {"kind": "registration", "source": name, "applied": after.on, **telling.numbers(told), "why": words}
                )

    def correction(self, name: str) -> tuple[int, Correction | None]:
        """What is to be done with a source from the next step on: its clock, ns, and what is taken off its states."""
        applied = self._applied.get(name)
        if applied is None or not applied.on or self._known is None:
            return 0, None
        site = self._known.sites[:, self._information.names.index(name)]
        bias = Bias(self._intake.config.space, site, applied.value, applied.covariance, applied.loose)
        return round(applied.value[CLOCK] * 1e9), bias

    def same(self) -> dict[int, int]:
        """{global track: the older one that it is the same target as}, though nothing links them."""
        return self._unlinked.same()

    def told(self, name: str) -> tuple[bool, bytes]:
        """Whether anything is taken off a source, and what the last event said of it."""
        applied = self._applied.get(name, Applied())
        return applied.on, applied.told.tobytes()

    def size(self, name: str) -> float:
        """Mean square of the error of a source beside those that it says its tracks have of their own."""
        names = self._information.names
        return float(self._effect[names.index(name), 2]) if name in names else 0.0

    def halves(self, name: str) -> bool:
        """Whether its error is told as half of a difference to one other."""
        names, known = self._information.names, self._known
        return known is not None and name in names and halved(known.label, known.reference, names.index(name))

    def told_only(self, name: str) -> bool:
        """Whether its error is certain and matters, and nothing is taken off."""
        applied = self._applied.get(name, Applied())
        return applied.found and not applied.on

    def health(self, name: str) -> dict[str, Any]:
        """What the status says of a source."""
        if self._known is None or name not in self._information.names:
            return {}
        at = self._information.names.index(name)
        told, applied = self._told(at), self._applied.get(name, Applied())
        corrects = self._intake.config.registration == "correct"
        return {
            "bias": telling.entry(told),
            "bias_gauge": gauge_words(self._information.names, at, self._known.label, self._known.reference),
            "bias_applied": applied.on,
            "bias_note": telling.note(told, applied.on, applied.found, corrects),
        }

    def estimate(self, name: str) -> tuple[Floats, Floats]:
        """The errors of a source: mean (7,) and covariance (7, 7). KeyError where it is in no estimate."""
        if self._known is None or name not in self._information.names:
            raise KeyError(name)
        return self._known.posterior.of(self._information.names.index(name))

    def lasts(self, name: str) -> float:
        """By what the information of a source is divided, since its errors last. ValueError where it is in none."""
        return float(self._lasting.ratio[self._information.names.index(name)])

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns."""
        self._time = min(self._time, time)
        self._lasting.rebase(time)

    def packed(self) -> dict[str, Any]:
        """As plain values."""
        return {
            "frame": repr(self._frame),
            "information": self._information.packed(),
            "lasting": self._lasting.packed(),
            "seen": to_bytes(self._seen),
            "effect": to_bytes(self._effect),
            "weights": to_bytes(self._weights),
            "epochs": dict(self._epochs),
            "applied": {name: one.packed() for name, one in sorted(self._applied.items())},
            "unlinked": self._unlinked.packed(),
            "step": self._step,
            "time": self._time,
        }

    def restore(self, packed: Mapping[str, Any]) -> None:
        """From what `packed` gave; not what is in another frame."""
        self._begin()
        if not packed or packed["frame"] != repr(self._frame):
            return
        self._information = Information.unpacked(packed["information"])
        self._lasting = Lasting.unpacked(packed["lasting"])
        like = np.zeros(0)
        self._seen = from_bytes(packed["seen"], like).reshape(-1, SEEN)
        self._effect = from_bytes(packed["effect"], like).reshape(-1, 3)
        self._weights = from_bytes(packed["weights"], like).reshape(-1, P)
        self._epochs = {str(name): int(epoch) for name, epoch in packed["epochs"].items()}
        self._applied = {str(name): Applied.unpacked(one) for name, one in packed["applied"].items()}
        self._unlinked.restore(packed["unlinked"])
        self._step, self._time = int(packed["step"]), int(packed["time"])
        if self._works and self._information.names and set(self._information.names) <= set(self._intake.sources):
            self._estimate(self._how().site)


def _common(part: Compared, posterior: Posterior) -> Floats:
    """H Sigma H' (2, 2, M) of the rows."""
    group = part.group
    each = np.stack([posterior.of(at)[1] for at in range(len(posterior.mean))])[group.source]
    out = np.zeros((2, 2, len(part.row)))
    for i in (0, 1):
        along = sum(group.H[i, k] * each[:, k].T for k in range(P))
        for j in (0, 1):
            out[i, j] = sum(along[m] * group.H[j, m] for m in range(P))
    return out
