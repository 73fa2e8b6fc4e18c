"""Parallel processing of an image in bands of rows; the result does not depend on the number of bands."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

THREADS = 2  # with more threads, synchronization costs more than it gains: an image takes milliseconds
LEAST_ROWS = 32  # smallest band; for fewer rows, starting a thread costs more than the work


def in_row_bands(work: Callable[[int, int], None], n_rows: int, rows_per_row: int = 1) -> None:
    """Runs `work(first_row, end_row)` over all rows, in parallel if the image is large and processors are available.

    Args:
        work: processes rows first_row to end_row - 1; its kernels release the GIL.
        n_rows: number of rows.
        rows_per_row: number of image rows that each processed row represents.

    Raises:
        Exception: any exception that `work` raises in any band.
    """
    if n_rows * rows_per_row < THREADS * LEAST_ROWS or _n_processors() < THREADS:
        work(0, n_rows)
        return
    cuts = [n_rows * k // THREADS for k in range(THREADS + 1)]
    others = [_thread_pool(os.getpid()).submit(work, *band) for band in zip(cuts[1:], cuts[2:], strict=False)]
    try:
        work(cuts[0], cuts[1])
    finally:
        for other in others:
            other.result()


@cache
def _thread_pool(process: int) -> ThreadPoolExecutor:
    """Returns the pool of threads that work in addition to the calling thread; each forked process has its own pool."""
    return ThreadPoolExecutor(THREADS - 1, thread_name_prefix=f"bands-{process}")


@cache
def _n_processors() -> int:
    """Returns the number of processors that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
