"""What an analyst can mend: a recording, a track or a file that is not as a command needs it.

ValueError
  ReviewError     one line: what, where, and how to mend it
    OrderError    an order that a centre refuses, and why
"""

from __future__ import annotations

__all__ = ["OrderError", "ReviewError"]


class ReviewError(ValueError):
    """A recording, or what was asked of it, is not as it must be; the message says how to mend it, in one line."""


class OrderError(ReviewError):
    """An order that a centre does not obey; the message says why, in one line."""
