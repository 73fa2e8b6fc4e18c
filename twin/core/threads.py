"""Threads of linear algebra: several slow down operations on small matrices, and may change the last bits."""

from __future__ import annotations

from contextlib import AbstractContextManager

from threadpoolctl import threadpool_limits


def one_blas_thread() -> AbstractContextManager[object]:
    """Returns a context in which the loaded libraries of linear algebra use one thread."""
    return threadpool_limits(1, "blas")
