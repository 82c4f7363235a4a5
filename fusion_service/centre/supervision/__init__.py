"""What the centre learns of its sources from the targets that they share."""

from fusion_service.centre.supervision.supervisor import Supervisor

__all__ = ["Supervisor"]
