"""Work that is always cut into the same two halves, and done on both cores while somebody waits for it.

A refinement runs beside the tracker and has one core then. When the tracker comes to the window at which it is to land
it waits, and its core is free. The halves are the same either way, and so are the results, to the bit.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Part = TypeVar("Part")


def _never() -> bool:
    return False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Halves:
    """Where the second half is done.

    Attributes:
        is_awaited: asked before each piece of work: is the other core free?
    """

    is_awaited: Callable[[], bool] = _never

    def both(self, work: Callable[[int, int], Part], middle: int, end: int) -> tuple[Part, Part]:
        """Return `work(0, middle)` and `work(middle, end)`."""
        if not self.is_awaited():
            return work(0, middle), work(middle, end)
        with ThreadPoolExecutor(1, thread_name_prefix="second half") as pool:
            second = pool.submit(work, middle, end)
            return work(0, middle), second.result()


ONE_CORE = Halves()


def middle_of(first: NDArray[np.int64]) -> int:
    """Return the part before which about half of the items lie; part k has items `first[k]` to `first[k + 1]`."""
    return int(np.searchsorted(first, first[-1] // 2))
