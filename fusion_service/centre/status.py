"""What a centre tells of itself after a step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fusion_service.centre import notes
from fusion_service.centre.intake import Intake
from fusion_service.centre.journal import Journal
from fusion_service.centre.sources import Source
from schemas import Status, StepLog

__all__ = ["step_status"]


def step_status(
    intake: Intake,
    journal: Journal,
    log: StepLog,
    tracks: dict[str, int],
    refused: dict[str, int],
    told: tuple[str, ...] | None = None,
    more: Mapping[str, dict[str, Any]] | None = None,
) -> Status:
    """Status after the step of `log`; tracks: how many there are of each kind; told: what an operator should know;
    more: what else there is to say of a source, by its name."""
    return Status(
        source=log.source,
        epoch=log.epoch,
        seq=log.seq,
        sent=log.time,
        time=log.time,
        step=log.step,
        uptime=0.0,
        rates={},
        queue={"pending": intake.pending()},
        refused=refused,
        dropped=dict(sorted(journal.dropped.items())),
        sources={
            name: _told(_health(source, intake, journal, log.time) | dict((more or {}).get(name, {})))
            for name, source in sorted(intake.sources.items())
        }
        | {name: one.said for name, one in sorted(intake.resting.items())},
        tracks=tracks,
        step_time={},
        notes=told,
    )


def _told(entry: dict[str, Any]) -> dict[str, Any]:
    """An entry whose note says also why there are no tracklets, where there is nothing that matters more."""
    why = entry.get("no_tracklets", "")
    return entry | {"note": entry["note"] or notes.no_tracklets(why)} if why else entry


def _health(source: Source, intake: Intake, journal: Journal, time: int) -> dict[str, Any]:
    return {
        "epoch": max(source.epoch, 0),
        "alive": source.alive,
        "stale": intake.is_stale(source, time),
        "muted": source.muted,
        "last": source.last,
        "offset": source.offset / 1e9,
        "messages": source.messages,
        "repeats": source.repeats,
        "gaps": source.gaps,
        "reordered": source.reordered,
        "tracks": len(source.tracks.id),
        "unused": dict(sorted(source.unused.items())),
        "note": source.why or notes.partial(source.space, intake.config),
        "refused": dict(sorted(journal.refused_of.get(source.name, {}).items())),
    }
