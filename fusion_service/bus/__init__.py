"""The bus: the only folder that imports zenoh, and only when a bus is opened."""

from typing import TYPE_CHECKING, Any

from fusion_service.bus.endpoint import DEFAULT_ENDPOINT, check_endpoint
from fusion_service.bus.inbox import Inbox

if TYPE_CHECKING:
    from fusion_service.bus.security import Security, SecurityError, read_security
    from fusion_service.bus.session import Bus, BusError, BusStopped, Publisher, open_bus

__all__ = [
    "DEFAULT_ENDPOINT",
    "Bus",
    "BusError",
    "BusStopped",
    "Inbox",
    "Publisher",
    "Security",
    "SecurityError",
    "check_endpoint",
    "open_bus",
    "read_security",
]
SECURITY = ("Security", "SecurityError", "read_security")


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name in SECURITY:
        from fusion_service.bus import security

        return getattr(security, name)
    from fusion_service.bus import session

    return getattr(session, name)
