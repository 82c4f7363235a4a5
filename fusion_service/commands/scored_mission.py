"""A recording scored for a command, with a progress bar."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from fusion_service.recording.scoring import Scoring
    from fusion_service.review.evaluation import Assessment
    from fusion_service.review.evaluation.logbook import Logbook
    from schemas import Truth

__all__ = ["Given", "need_rerun", "scored_mission"]


class Given(Protocol):
    """What a mission is scored against, in place of its own truth; names: of true objects that have some, by id."""

    @property
    def names(self) -> Mapping[int, str]: ...

    def messages(self, book: Logbook) -> list[Truth]: ...


def need_rerun() -> None:
    """`ReviewError` where recordings cannot be read."""
    from fusion_service.errors import ReviewError
    from fusion_service.recording.columns import import_rerun

    try:
        import_rerun()
    except ImportError as error:
        raise ReviewError(str(error)) from None


def scored_mission(
    path: Path,
    truth: Given,
    how: Scoring,
    stop: threading.Event,
    *,
    centres: Sequence[str] = (),
    rows: int = 0,
) -> Assessment:
    """The recording `path`, against `truth` in place of its own where there is any. centres: only these of it; rows:
    as of `assess`. Raises `ReviewError`, `Stopped`."""
    from fusion_service.errors import ReviewError, Stopped
    from fusion_service.progress import Progress
    from fusion_service.review.evaluation import assess
    from fusion_service.review.evaluation.logbook import Logbook

    with Progress(path.name) as bar:
        size = max(path.stat().st_size, 1) if path.is_file() else 1

        def showing(begin: float, share: float, scale: float) -> Callable[[float], None]:
            def show(done: float) -> None:
                if stop.is_set():
                    raise Stopped
                bar.show(begin + share * min(done / scale, 1.0))

            return show

        book = Logbook.read(path, showing(0.0, 0.3, size))
        if not book.traffic:
            raise ReviewError(f"{path} holds no tracks, so there is nothing to evaluate")
        chosen = [name for name in centres if name in book.centres]
        if centres and not chosen:
            there = ", ".join(book.centres) or "none"
            raise ReviewError(f"{path} has no centre {' or '.join(map(repr, centres))}; there are: {there}")
        return assess(
            book,
            c=how.cutoff,
            every=how.every,
            centres=chosen,
            truths=truth.messages(book),
            progress=showing(0.3, 0.7, 1.0),
            rows=rows,
            called=truth.names,
        )
