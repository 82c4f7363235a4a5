"""What an analyst can mend: a recording, a track or a file that is not as a command needs it.

ValueError
  ReviewError     one line: what, where, and how to mend it
"""

from __future__ import annotations

__all__ = ["ReviewError"]


class ReviewError(ValueError):
    """A recording, or what was asked of it, is not as it must be; the message says how to mend it, in one line."""
