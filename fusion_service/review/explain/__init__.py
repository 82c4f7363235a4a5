"""Where a global track of a recording came from, in words and in a view."""

from fusion_service.review.explain.mission import read_mission
from fusion_service.review.explain.track_view import write_view
from fusion_service.review.explain.words import explanation, listing

__all__ = ["explanation", "listing", "read_mission", "write_view"]
