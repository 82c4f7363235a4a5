"""The whole job with no clock, no thread, no socket: events in, one step at a time, pictures and logs out."""

from fusion_service.centre.centre import Centre, StepResult
from fusion_service.centre.checkpoint import CheckpointError
from fusion_service.centre.clock import MessageClock, WallClock
from fusion_service.centre.era import ClockSet, NewEra
from fusion_service.centre.fusion import FusionCentre
from fusion_service.centre.intake import Event, Order, Refused, SourceFound, SourceLost
from fusion_service.centre.intensity import IntensityCentre
from fusion_service.centre.making import make_centre

__all__ = [
    "Centre",
    "CheckpointError",
    "ClockSet",
    "Event",
    "FusionCentre",
    "IntensityCentre",
    "MessageClock",
    "NewEra",
    "Order",
    "Refused",
    "SourceFound",
    "SourceLost",
    "StepResult",
    "WallClock",
    "make_centre",
]
