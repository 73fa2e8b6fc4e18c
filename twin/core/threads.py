"""Threads: row bands, pairs of images, the next item, one for linear algebra. Results do not depend on the bands."""

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from functools import cache
from typing import TypeVar

from threadpoolctl import threadpool_limits

Left = TypeVar("Left")
Right = TypeVar("Right")
Item = TypeVar("Item")

THREADS = 2  # with more threads, synchronization costs more than it gains: an image takes milliseconds
LEAST_ROWS = 32  # smallest band; for fewer rows, starting a thread costs more than the work
QUICK = 0.2  # rows of usual work for which a row of quick work stands: less than half a millisecond at 320 x 240


_state = threading.local()  # `whole` is set while this thread processes one image of a pair


def in_pair(left: Callable[[], Left], right: Callable[[], Right]) -> tuple[Left, Right]:
    """Returns the results of `left` and `right`, computed at the same time if there are enough processors.

    Neither may modify data that the other uses. Meanwhile, `in_row_bands` does not split images.
    """
    if _n_processors() < THREADS:
        return left(), right()
    other = _thread_pool(os.getpid()).submit(_whole, right)
    try:
        first = _whole(left)
    finally:
        wait([other])
    return first, other.result()


def _whole(work: Callable[[], Left]) -> Left:
    _state.whole = True
    try:
        return work()
    finally:
        _state.whole = False


def in_row_bands(work: Callable[[int, int], None], n_rows: int, rows_per_row: float = 1) -> None:
    """Runs `work(first_row, end_row)` over all rows, in parallel bands if the image is large and not one of a pair.

    The kernels in `work` release the GIL; each processed row stands for `rows_per_row` rows of the image.
    """
    small = n_rows * rows_per_row < THREADS * LEAST_ROWS
    if small or getattr(_state, "whole", False) or _n_processors() < THREADS:
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
    """Returns the threads that work in addition to the calling one; a forked process has its own."""
    return ThreadPoolExecutor(THREADS - 1, thread_name_prefix=f"bands-{process}")


@cache
def _n_processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def prefetched(items: Iterator[Item]) -> Iterator[Item]:
    end = object()
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(next, items, end)
        while (item := coming.result()) is not end:
            coming = pool.submit(next, items, end)
            yield item  # type: ignore[misc]


def one_blas_thread() -> AbstractContextManager[object]:
    """Returns a context with one thread of linear algebra: several are slow on small matrices, and change last bits."""
    return threadpool_limits(1, "blas")
