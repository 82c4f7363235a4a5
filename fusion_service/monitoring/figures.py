"""What of a status, a recorder and a hub is a metric: names by the conventions of Prometheus, with units in them.

A status may come from the bus, and names in it from anybody: what is no number is left out, texts are cut, and of each
label no more than `MOST_NAMED` values are told; `fusion_sources_unnamed` counts the rest.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from typing import Any, NamedTuple

from fusion_service.source_words import state_of
from schemas import Status

__all__ = ["METRICS", "MOST_NAMED", "Metric", "Sample", "label", "recorder_samples", "status_samples"]

MOST_NAMED = 1000
"""Sources that are told by name."""
MOST_WORDS = 100
"""Reasons, and kinds of tracks, that are told."""
LONGEST = 64
"""Characters of a label."""
STATES = ("trusted", "watch", "inflated", "union", "out")


class Metric(NamedTuple):
    """kind: "counter" (its name ends with _total) or "gauge"; labels: names, in order."""

    kind: str
    labels: tuple[str, ...]
    help: str


class Sample(NamedTuple):
    """A value of the metric `name`, with the values of its labels."""

    name: str
    labels: tuple[str, ...]
    value: float


_C, _S = ("centre",), ("centre", "source")
METRICS: dict[str, Metric] = {
    "fusion_build_info": Metric("gauge", ("version", "process"), "1; the version of the process that is asked"),
    "fusion_ready": Metric("gauge", (), "1 where /readyz says so"),
    "fusion_centre_info": Metric("gauge", ("centre", "road"), "1; what small matrices are computed by"),
    "fusion_status_timestamp_seconds": Metric("gauge", _C, "when the newest status was made"),
    "fusion_uptime_seconds": Metric("gauge", _C, "for which the centre has run"),
    "fusion_step_number": Metric("gauge", _C, "of the newest step, over restarts"),
    "fusion_steps_per_second": Metric("gauge", _C, "since the status before"),
    "fusion_received_messages_per_second": Metric("gauge", _C, "that came in"),
    "fusion_received_bytes_per_second": Metric("gauge", _C, "that came in"),
    "fusion_step_last_seconds": Metric("gauge", _C, "that the newest step took"),
    "fusion_step_mean_seconds": Metric("gauge", _C, "that a step took since the start"),
    "fusion_step_max_seconds": Metric("gauge", _C, "that a step took at most since the start"),
    "fusion_steps_failed_total": Metric("counter", _C, "steps that raised, and were made again"),
    "fusion_steps_skipped_total": Metric("counter", _C, "steps that were not made, for want of time"),
    "fusion_turns_failed_total": Metric("counter", _C, "turns of the loop that raised"),
    "fusion_checkpoints_unsaved_total": Metric("counter", _C, "checkpoints and notes that could not be written"),
    "fusion_clock_behind_total": Metric("counter", _C, "steps that waited for a clock that was set back"),
    "fusion_busy_seconds": Metric("gauge", _C, "for which the loop has been at one thing; 0: it turns"),
    "fusion_overload_seconds": Metric("gauge", _C, "for which more has come than can be worked off; 0: it does not"),
    "fusion_picture_latency_seconds": Metric("gauge", _C, "from the time of a picture until it went out"),
    "fusion_queue_messages": Metric("gauge", _C, "that wait between bus and centre"),
    "fusion_queue_capacity_messages": Metric("gauge", _C, "that can wait there"),
    "fusion_queue_high_water_messages": Metric("gauge", _C, "that waited there at most"),
    "fusion_pending_messages": Metric("gauge", _C, "that wait for their step"),
    "fusion_missed_messages_total": Metric("counter", _C, "messages that the bus lost for good"),
    "fusion_overtaken_scans_total": Metric("counter", _C, "scans that newer ones made needless, when it was behind"),
    "fusion_refused_total": Metric("counter", ("centre", "reason"), "messages or tracks refused"),
    "fusion_dropped_total": Metric("counter", _S, "messages dropped unread (queue, flow)"),
    "fusion_tracks": Metric("gauge", ("centre", "status"), "global tracks"),
    "fusion_memory_max_bytes": Metric("gauge", _C, "resident memory of the centre's process at most"),
    "fusion_notes": Metric("gauge", _C, "sentences in the status that an operator should read"),
    "fusion_term": Metric("gauge", _C, "under which the process holds the centre's name"),
    "fusion_standby": Metric("gauge", ("centre", "state"), "processes that stand by: there, and ready to take over"),
    "fusion_sources": Metric("gauge", _C, "that are known"),
    "fusion_sources_alive": Metric("gauge", _C, "that are there, and not stale"),
    "fusion_sources_unnamed": Metric("gauge", _C, "of which nothing is told by name"),
    "fusion_source_alive": Metric("gauge", _S, "1 where its liveliness token is there"),
    "fusion_source_stale": Metric("gauge", _S, "1 where it is silent for too long"),
    "fusion_source_muted": Metric("gauge", _S, "1 by an order, or the config"),
    "fusion_source_state": Metric("gauge", ("centre", "source", "state"), "1 for how it is treated"),
    "fusion_source_tracks": Metric("gauge", _S, "local tracks that it has"),
    "fusion_source_messages_total": Metric("counter", _S, "messages taken of it"),
    "fusion_source_rate_per_second": Metric("gauge", _S, "messages with tracks that come"),
    "fusion_source_declared_period_seconds": Metric("gauge", _S, "between messages, as it declares"),
    "fusion_source_clock_ahead_seconds": Metric("gauge", _S, "by which its clock is ahead of the centre's"),
    "fusion_source_offset_seconds": Metric("gauge", _S, "from the time of its data until they came, newest message"),
    "fusion_source_last_timestamp_seconds": Metric("gauge", _S, "of its newest data"),
    "fusion_source_lost_total": Metric("counter", _S, "messages missing in its numbers"),
    "fusion_source_repeats_total": Metric("counter", _S, "messages that came again"),
    "fusion_source_reordered_total": Metric("counter", _S, "messages that came after newer ones"),
    "fusion_source_refused_total": Metric("counter", ("centre", "source", "reason"), "refused of it"),
    "fusion_source_refusal_timestamp_seconds": Metric("gauge", ("centre", "source", "reason"), "of its last refusal"),
    "fusion_source_doubts": Metric("gauge", _S, "things that are doubtful in what it sends"),
    "fusion_recorder_messages_total": Metric("counter", (), "messages recorded"),
    "fusion_recorder_bytes_total": Metric("counter", (), "bytes of messages recorded"),
    "fusion_recorder_rows_total": Metric("counter", (), "rows written, of messages and drawing"),
    "fusion_recorder_undecodable_total": Metric("counter", ("reason",), "messages kept raw that could not be read"),
    "fusion_recorder_undrawn_total": Metric("counter", ("reason",), "tracks or messages recorded, but not drawn"),
    "fusion_recorder_part_bytes": Metric("gauge", (), "of the file that is being written"),
    "fusion_recorder_disk_free_bytes": Metric("gauge", (), "where it writes"),
    "fusion_recorder_tick_timestamp_seconds": Metric("gauge", (), "when what came was last handed to the disk"),
    "fusion_hub_links": Metric("gauge", (), "connections that there are"),
    "fusion_hub_links_opened_total": Metric("counter", (), "connections made since the start"),
}
"""Every metric that any process serves."""

_OF_STEPS = (
    ("fusion_step_last_seconds", "last"),
    ("fusion_step_mean_seconds", "mean"),
    ("fusion_step_max_seconds", "max"),
    ("fusion_steps_failed_total", "failed"),
    ("fusion_steps_skipped_total", "skipped"),
    ("fusion_checkpoints_unsaved_total", "unsaved"),
    ("fusion_clock_behind_total", "behind"),
    ("fusion_picture_latency_seconds", "latency"),
)
_OF_QUEUE = (
    ("fusion_queue_messages", "waiting"),
    ("fusion_queue_capacity_messages", "capacity"),
    ("fusion_queue_high_water_messages", "high_water"),
    ("fusion_pending_messages", "pending"),
    ("fusion_missed_messages_total", "missed"),
    ("fusion_overtaken_scans_total", "overtaken"),
)
_OF_RATES = (
    ("fusion_steps_per_second", "steps"),
    ("fusion_received_messages_per_second", "messages"),
    ("fusion_received_bytes_per_second", "bytes"),
)
_OF_SOURCE = (
    ("fusion_source_alive", "alive"),
    ("fusion_source_stale", "stale"),
    ("fusion_source_muted", "muted"),
    ("fusion_source_tracks", "tracks"),
    ("fusion_source_messages_total", "messages"),
    ("fusion_source_rate_per_second", "rate"),
    ("fusion_source_declared_period_seconds", "declared_period"),
    ("fusion_source_clock_ahead_seconds", "clock"),
    ("fusion_source_offset_seconds", "offset"),
    ("fusion_source_lost_total", "gaps"),
    ("fusion_source_repeats_total", "repeats"),
    ("fusion_source_reordered_total", "reordered"),
)


def label(text: object) -> str:
    """A value of a label: what can be encoded, and is not too long."""
    return str(text)[:LONGEST].encode("utf-8", "replace").decode("utf-8")


def status_samples(status: Status) -> Iterator[Sample]:
    """The metrics of a centre by its status; no two of one name and labels."""
    seen: set[tuple[str, tuple[str, ...]]] = set()
    for one in _of_centre(status):
        if one[:2] not in seen and math.isfinite(one.value):
            seen.add(one[:2])
            yield one


def recorder_samples(
    messages: int, size: int, rows: int, undecodable: Mapping[str, int], undrawn: Mapping[str, int]
) -> Iterator[Sample]:
    """Of a recorder, as it counts."""
    for name, value in (("messages", messages), ("bytes", size), ("rows", rows)):
        yield Sample(f"fusion_recorder_{name}_total", (), float(value))
    for name, counts in (("undecodable", undecodable), ("undrawn", undrawn)):
        yield from _by_word(f"fusion_recorder_{name}_total", (), counts)


def _of_centre(status: Status) -> Iterator[Sample]:
    centre = (label(status.source),)
    yield Sample("fusion_centre_info", (*centre, label(status.road or "")), 1.0)
    yield Sample("fusion_status_timestamp_seconds", centre, status.sent / 1e9)
    yield Sample("fusion_uptime_seconds", centre, status.uptime)
    yield Sample("fusion_step_number", centre, float(status.step))
    steps = status.step_time
    tables: tuple[tuple[tuple[tuple[str, str], ...], Mapping[str, Any]], ...] = (
        (_OF_STEPS, steps),
        (_OF_QUEUE, status.queue),
        (_OF_RATES, status.rates),
    )
    for table, said in tables:
        yield from _numbers(table, centre, said)
    for name, key in (
        ("turns_failed_total", "failed_turns"),
        ("busy_seconds", "busy"),
        ("overload_seconds", "overload"),
    ):
        yield Sample(f"fusion_{name}", centre, _number(steps.get(key)) or 0.0)
    yield from _by_word("fusion_refused_total", centre, status.refused)
    yield from _by_word("fusion_dropped_total", centre, status.dropped, MOST_NAMED)
    yield from _by_word("fusion_tracks", centre, status.tracks)
    yield from _by_word("fusion_standby", centre, status.standby or {})
    for name, value in (("memory_max_bytes", status.memory), ("term", status.term)):
        if value is not None:
            yield Sample(f"fusion_{name}", centre, float(value))
    yield Sample("fusion_notes", centre, float(len(status.notes or ())))
    yield from _of_sources(centre, status.sources)


def _of_sources(centre: tuple[str], sources: Mapping[str, Mapping[str, Any]]) -> Iterator[Sample]:
    rest = sources.get("*", {})
    named = [(name, said) for name, said in sources.items() if name != "*"]
    more = (_number(rest.get("more")) or 0.0) + max(len(named) - MOST_NAMED, 0)
    alive = sum(said.get("alive") is True and said.get("stale") is not True for _, said in named)
    yield Sample("fusion_sources", centre, len(named[:MOST_NAMED]) + more)
    yield Sample("fusion_sources_alive", centre, float(alive))
    yield Sample("fusion_sources_unnamed", centre, more)
    for name, said in named[:MOST_NAMED]:
        labels = (*centre, label(name))
        yield from _numbers(_OF_SOURCE, labels, said)
        if last := _number(said.get("last")):
            yield Sample("fusion_source_last_timestamp_seconds", labels, last / 1e9)
        if (state := state_of(said)) in STATES:
            yield Sample("fusion_source_state", (*labels, state), 1.0)
        if isinstance(refused := said.get("refused"), Mapping):
            yield from _by_word("fusion_source_refused_total", labels, refused, 20)
        if isinstance(doubts := said.get("doubts"), (list, tuple)):
            yield Sample("fusion_source_doubts", labels, float(len(doubts)))
        refusal = said.get("last_refusal")
        if isinstance(refusal, Mapping) and (when := _number(refusal.get("time"))):
            reason = label(refusal.get("reason"))
            yield Sample("fusion_source_refusal_timestamp_seconds", (*labels, reason), when / 1e9)


def _numbers(table: Iterable[tuple[str, str]], labels: tuple[str, ...], said: Mapping[str, Any]) -> Iterator[Sample]:
    for name, key in table:
        if (value := _number(said.get(key))) is not None:
            yield Sample(name, labels, value)


def _by_word(name: str, labels: tuple[str, ...], counts: Mapping[str, Any], most: int = MOST_WORDS) -> Iterator[Sample]:
    for word, count in islice(counts.items(), most):
        if (value := _number(count)) is not None:
            yield Sample(name, (*labels, label(word)), value)


def _number(value: Any) -> float | None:
    """A finite number, or a truth as 0 or 1; None for anything else."""
    if not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None
