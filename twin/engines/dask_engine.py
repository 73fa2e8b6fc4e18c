"""Engine that runs tasks on a Dask cluster, which is either already running or started as SLURM jobs."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from typing import Any

import dask.config
from distributed import Client, Future, KilledWorker, WorkerPlugin, as_completed, get_worker

from twin.engines.worker import Outcome, Result, Task, TaskLimits, WorkerPool, describe_exception
from twin.errors import EngineLostError, TwinError

_CONNECT_TIMEOUT_S = 20
_QUEUED_PER_THREAD = 8  # keeps every worker busy without submitting all tasks (up to 100,000) at once
_MIN_QUEUED = 64
_REFRESH_S = 2.0
_WITHOUT_WORKERS_S = 300.0  # tasks are given up after this time without any worker, if there was one before
_MAX_LOST_WORKERS = 3  # in SLURM jobs, a task fails if more Dask workers than this are lost while they run it


@contextmanager
def connect_scheduler(address: str) -> Iterator[DaskEngine]:
    """Yields an engine that runs tasks on a running Dask scheduler; raises TwinError if that does not respond."""
    try:
        client = Client(address, timeout=_CONNECT_TIMEOUT_S)
    except (OSError, ValueError) as error:
        allowed = "the address of a running scheduler, e.g. tcp://host:8786"
        raise TwinError("--scheduler", f"{address} does not respond: {error}", allowed) from None
    with client:
        yield DaskEngine(client)


@contextmanager
def start_slurm_jobs(jobs: int) -> Iterator[DaskEngine]:
    """Yields an engine that runs tasks on `jobs` new SLURM jobs; raises TwinError if dask-jobqueue is missing."""
    try:
        from dask_jobqueue.slurm import SLURMCluster
    except ImportError:
        needed = "pip install 'seabed-twin[cluster]'"
        raise TwinError("--scheduler", "slurm needs dask-jobqueue, which is not installed", needed) from None
    with dask.config.set({"distributed.scheduler.allowed-failures": _MAX_LOST_WORKERS}):
        given = dask.config.get("jobqueue.slurm")
        cluster = SLURMCluster(cores=given.get("cores") or 1, processes=1, memory=given.get("memory") or "4GB")
        cluster.scale(jobs=jobs)
        with cluster, Client(cluster) as client:
            yield DaskEngine(client)


class DaskEngine:
    """Engine that runs tasks on a Dask cluster; each Dask worker runs them in a pool of processes, one per thread."""

    def __init__(self, client: Client):
        self.client = client
        self._queued, self._updated_s = 0, -math.inf
        client.register_plugin(_WorkerPoolPlugin())

    def run_many(
        self, function: Callable[[Task], Result], tasks: Iterable[Task], limits: TaskLimits
    ) -> Iterator[Outcome[Task, Result]]:
        """See `Engine.run_many`; resubmits the tasks of a lost worker.

        Raises EngineLostError if the connection is lost, or all workers for `_WITHOUT_WORKERS_S`.
        """
        waiting, running = iter(tasks), dict[Any, tuple[Task, Future]]()
        arriving = as_completed(with_results=True, raise_errors=False)

        def submit() -> None:
            for task in islice(waiting, max(0, self._queue_size() - len(running))):
                future = self.client.submit(_run_task, function, task, limits, pure=False)
                running[future.key] = task, future
                arriving.add(future)

        submit()
        with _cancelled_without_workers(self.client, running) as lost:
            for future, result in arriving:
                yield _outcome(running.pop(future.key)[0], future, result, lost)
                future.release()
                submit()

    def _queue_size(self) -> int:
        if time.monotonic() - self._updated_s > _REFRESH_S:
            threads: Any = self.client.nthreads()
            self._queued = max(_MIN_QUEUED, _QUEUED_PER_THREAD * sum(threads.values()))
            self._updated_s = time.monotonic()
        return self._queued


class _WorkerPoolPlugin(WorkerPlugin):
    name = "twin-worker-pool"

    def setup(self, worker: Any = None) -> None:
        self.pool = WorkerPool()

    def teardown(self, worker: Any = None) -> None:
        self.pool.close()


def _run_task(function: Callable[[Task], Result], task: Task, limits: TaskLimits) -> Outcome[Task, Result]:
    plugin: Any = get_worker().plugins[_WorkerPoolPlugin.name]
    return plugin.pool.run(function, task, limits)


@contextmanager
def _cancelled_without_workers(client: Client, running: dict[Any, tuple[Any, Future]]) -> Iterator[threading.Event]:
    """Cancels the running tasks if all workers are lost for `_WITHOUT_WORKERS_S`; yields an event that is set then."""
    lost, ended = threading.Event(), threading.Event()

    def watch() -> None:
        seen_s = math.inf
        while not lost.is_set():
            now_s = time.monotonic()
            seen_s = now_s if client.nthreads() else seen_s
            if now_s - seen_s > _WITHOUT_WORKERS_S:
                lost.set()
                client.cancel([future for _, future in list(running.values())], force=True)
            elif ended.wait(_REFRESH_S):
                return

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield lost
    finally:
        ended.set()
        thread.join()


def _outcome(task: Any, future: Future, result: Any, lost: threading.Event) -> Outcome:
    if future.status == "finished":
        return result
    if future.status != "error":
        problem = f"all workers were lost for {_WITHOUT_WORKERS_S:g} s" if lost.is_set() else "the connection was lost"
        raise EngineLostError("--scheduler", problem, "a running scheduler with workers; continue with --resume")
    error: Any = result[1] if isinstance(result, tuple) else future.exception()
    if isinstance(error, KilledWorker):
        return Outcome(task, None, "the Dask workers that ran the task were lost", error.allowed_failures + 1)
    return Outcome(task, None, describe_exception(error), 1)
