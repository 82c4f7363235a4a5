"""What can go wrong with the bus."""

from __future__ import annotations

from fusion_service.errors import FusionError, Stopped

__all__ = ["BusError", "BusStopped"]


class BusError(FusionError):
    """What the user can mend about the bus, in one line."""


class BusStopped(Stopped, BusError):
    """`stop` was set while waiting for the hub."""
