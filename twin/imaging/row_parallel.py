"""An image in bands of rows, one to each of two processors: a band's pixels do not depend on how the image is cut."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

THREADS = 2  # more of them wait for one another: the work of an image takes milliseconds
LEAST_ROWS = 32  # of a band; for less, waking a thread costs more than it does


def in_row_bands(work: Callable[[int, int], None], n_rows: int, pixels: int = 1) -> None:
    """Runs `work(first_row, end_row)` over all rows, side by side where there are processors; its kernels free the GIL.

    Args:
        pixels: rows of the image that each of these stands for.
    Raises:
        Exception: what `work` raised in any band.
    """
    if n_rows * pixels < THREADS * LEAST_ROWS or _processors() < THREADS:
        work(0, n_rows)
        return
    cuts = [n_rows * k // THREADS for k in range(THREADS + 1)]
    others = [_helpers(os.getpid()).submit(work, *band) for band in zip(cuts[1:], cuts[2:], strict=False)]
    try:
        work(cuts[0], cuts[1])
    finally:
        for other in others:
            other.result()


@cache
def _helpers(process: int) -> ThreadPoolExecutor:
    """Threads beside the caller's own; a process that was forked off has none of its parent's."""
    return ThreadPoolExecutor(THREADS - 1, thread_name_prefix=f"bands-{process}")


@cache
def _processors() -> int:
    """How many processors this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
