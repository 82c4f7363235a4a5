"""The road that small matrices go: NumPy alone ("plain"), or loops compiled by numba where it is installed.

    use("auto")        numba if it is there, else plain
    use("on"), use("off")
    road()             "plain", or "numba 0.68.1"

Both give the same bits, so a process may change from one to the other at any time, and nothing but speed depends on it.
The process begins on the plain road: who wants the other says so. The variable `FUSION_COMPILED` says it for whoever
says "auto".
"""

from fusion_service.compiled.either import either
from fusion_service.compiled.road import CHOICES, PLAIN, THREAD, begin, is_kept, road, use

__all__ = ["CHOICES", "PLAIN", "THREAD", "begin", "either", "is_kept", "road", "use"]
