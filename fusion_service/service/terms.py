"""Terms and generations of ids, where several processes may hold one centre's name, one after the other.

A generation is 4 k + node: a node is the number, 0 to 3, of a process among those of one centre, and k is no less than
the seconds since 2020. So two that know nothing of each other, since the bus is split, never give an id of the same
generation. A term is the generation that a process took when it became active: of two that hold the name, the one of
the greater term is right; they are never equal.
"""

from __future__ import annotations

from collections.abc import Iterable

__all__ = ["MOST_GENERATION", "NODES", "free_node", "generation_after", "node_of"]

NODES = 4
MOST_GENERATION = 2**32 - 2**16
"""What is said to be above is not believed: there would be none left."""


def generation_after(last: int, node: int, seconds: int) -> int:
    """The next generation of `node` after `last`, whoever took that, and no less than that of `seconds` since 2020."""
    return max(last // NODES + 1, seconds) * NODES + node


def node_of(generation: int) -> int:
    """The node that took a generation."""
    return generation % NODES


def free_node(own: int, others: Iterable[int]) -> int:
    """`own` where no other has it, else the lowest that is free; `own` where none is."""
    taken = set(others)
    return own if own not in taken else next((one for one in range(NODES) if one not in taken), own)
