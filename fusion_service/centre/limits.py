"""What one centre holds at most, whatever is sent.

Memory, measured with 20 sources of 10,000 tracks each (4 components, every target by all): 1.0 GB resident, 1.2 GB at
most in a step, of which Python and its libraries are 0.2; with half as many tracks 0.6. A queued component is 0.3 kB.
"""

from __future__ import annotations

__all__ = [
    "MAX_COMPONENTS",
    "MAX_EVENTS",
    "MAX_ORDERS",
    "MAX_QUEUED",
    "MAX_SOURCES",
    "MAX_TOTAL",
    "MAX_TRACKS",
]

MAX_SOURCES = 1000
MAX_TRACKS = 50_000
"""Local tracks of one source."""
MAX_TOTAL = 200_000
"""Local tracks of all sources."""
MAX_QUEUED = 50_000
"""Messages that wait for a step."""
MAX_COMPONENTS = 1_000_000
"""Components in them."""
MAX_EVENTS = 10_000
MAX_ORDERS = 1000
"""Orders of one step."""
