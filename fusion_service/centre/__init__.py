"""The whole job with no clock, no thread, no socket: events in, one step at a time, pictures and logs out."""

from fusion_service.centre.arrival import ArrivalClock
from fusion_service.centre.centre import Centre
from fusion_service.centre.checkpoint import CheckpointError, Glance, glance
from fusion_service.centre.clock import MessageClock, WallClock
from fusion_service.centre.era import ClockSet, NewEra
from fusion_service.centre.events import Event, Refused, Skipped, SourceFound, SourceLost
from fusion_service.centre.fusion import FusionCentre
from fusion_service.centre.intensity import IntensityCentre
from fusion_service.centre.judging import Outcome, View, judge
from fusion_service.centre.making import make_centre
from fusion_service.centre.naming import LocalKey
from fusion_service.centre.pictures import is_picture_of, source_of
from fusion_service.centre.result import StepResult
from fusion_service.centre.whereabouts import Whereabouts
from fusion_service.order import NEEDED, WHAT, LocalId, Order, order_of, read_order

__all__ = [
    "NEEDED",
    "WHAT",
    "ArrivalClock",
    "Centre",
    "CheckpointError",
    "ClockSet",
    "Event",
    "FusionCentre",
    "Glance",
    "IntensityCentre",
    "LocalId",
    "LocalKey",
    "MessageClock",
    "NewEra",
    "Order",
    "Outcome",
    "Refused",
    "Skipped",
    "SourceFound",
    "SourceLost",
    "StepResult",
    "View",
    "WallClock",
    "Whereabouts",
    "glance",
    "is_picture_of",
    "judge",
    "make_centre",
    "order_of",
    "read_order",
    "source_of",
]
