"""The clocks of `fusion_service.centre`, under the path that programs outside the repository know them by."""

from fusion_service.centre.clock import MessageClock, WallClock

__all__ = ["MessageClock", "WallClock"]
