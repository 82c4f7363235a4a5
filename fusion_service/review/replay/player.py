"""One variant of a replay: its centre, which is given events and makes steps."""

from __future__ import annotations

import time
from collections.abc import Iterable

from fusion_service.centre import Centre, Event, StepResult, make_centre
from fusion_service.centre.inputs import Input
from fusion_service.centre.retracing import step_again
from fusion_service.config import CentreConfig
from fusion_service.review.replay.variants import Variant
from schemas.messages import TENTATIVE

__all__ = ["Player"]


class Player:
    """One variant: its centre, and how far it has come. steps: made; number: of the last; tracks: ids that were ever
    confirmed; seconds: of fusion; span: times of the first and the last step, ns."""

    def __init__(self, variant: Variant) -> None:
        self.variant = variant
        self.config: CentreConfig | None = None
        self.centre: Centre | None = None
        self.steps = self.number = 0
        self.tracks: set[int] = set()
        self.seconds = 0.0
        self.span = [0, 0]

    def begin(self, config: CentreConfig, checkpoint: bytes | None, generation: int | None, epoch: int) -> str:
        """Make the centre anew; why it begins without the checkpoint, empty if it does not."""
        self.config = config
        self.centre, fault = make_centre(config, checkpoint, generation=generation, epoch=epoch)
        return fault

    def handle(self, event: Event, received: int) -> None:
        """Give the centre an event for its next step."""
        if self.centre is not None:
            begin = time.perf_counter()
            self.centre.handle(event, received)
            self.seconds += time.perf_counter() - begin

    def step(self, events: Iterable[Event], inputs: Iterable[Input], at: int) -> StepResult | str:
        """The step at `at` ns, or why there is none."""
        centre = self.centre
        if centre is None:
            return "there is no centre to make it"
        begin = time.perf_counter()
        try:
            result = step_again(centre, events, inputs, at)
        except Exception as error:  # a recording may hold anything
            return f"{type(error).__name__}: {error}"
        self.seconds += time.perf_counter() - begin
        self.steps, self.number = self.steps + 1, result.tracks.step
        self.tracks.update(result.tracks.ids[result.tracks.status != TENTATIVE].tolist())
        self.span = [min(self.span[0] or at, at), max(self.span[1], at)]
        return result
