"""A recorded mission fused again: by its step logs, bit for bit or under other rules."""

from fusion_service.review.replay.run import Replay, run_replay

__all__ = ["Replay", "run_replay"]
