"""What one step of a centre gives."""

from __future__ import annotations

from collections.abc import Callable

from schemas import GlobalTracks, Status, StepLog

__all__ = ["StepResult"]


class StepResult:
    """What one step gives. tracks: as they are published, which may be a delta; picture: all of them; status: made when
    it is asked for, or the centre goes on, as it is after the step: that it can wait is worth a twentieth of it."""

    __slots__ = ("_status", "_telling", "log", "picture", "tracks")

    def __init__(
        self, tracks: GlobalTracks, log: StepLog, telling: Callable[[], Status], picture: GlobalTracks
    ) -> None:
        self.tracks, self.log, self.picture = tracks, log, picture
        self._telling: Callable[[], Status] | None = telling
        self._status: Status | None = None

    @property
    def status(self) -> Status:
        """What the centre tells of itself."""
        telling, self._telling = self._telling, None
        if telling is not None:
            self._status = telling()
        if self._status is None:
            raise ValueError("no status could be made of this step")
        return self._status

    def settle(self) -> None:
        """Make the status, where that has not been done: what it tells of is about to change."""
        if self._telling is not None:
            self._status = self.status
