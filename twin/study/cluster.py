"""Tasks on the workers of a Dask cluster that is there, or on jobs of a SLURM cluster."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from typing import Any

import dask.config
from distributed import Client, Future, KilledWorker, WorkerPlugin, as_completed, get_worker

from twin.errors import TwinError
from twin.study.engine import Outcome, Result, Task
from twin.study.worker import Crew, Limits, Reply, describe

_REACH_S = 20  # for a scheduler to answer
_AHEAD = 8  # tasks waiting per thread: enough that no worker idles, few enough that a hundred thousand need no memory
_LEAST_AHEAD = 64
_ASK_S = 2.0
_MOST_LOST_WORKERS = 3  # under one task


@contextmanager
def connect(jobs: int, scheduler: str | None) -> Iterator[DaskEngine]:
    """An engine on a scheduler that is there, else on as many jobs of SLURM.

    Raises:
        TwinError: the scheduler does not answer, or what SLURM needs is not installed.
    """
    if scheduler is not None:
        with _client(scheduler) as client:
            yield DaskEngine(client)
        return
    with dask.config.set({"distributed.scheduler.allowed-failures": _MOST_LOST_WORKERS}):
        with _slurm(jobs) as cluster, Client(cluster) as client:
            yield DaskEngine(client)


def _client(address: str) -> Client:
    try:
        return Client(address, timeout=_REACH_S)
    except (OSError, ValueError) as error:
        raise TwinError("--scheduler", f"{address} does not answer: {error}", "as tcp://host:8786") from None


def _slurm(jobs: int) -> Any:
    """Jobs of one core each; queue, account, time and memory are those of Dask's own configuration."""
    try:
        from dask_jobqueue.slurm import SLURMCluster
    except ImportError:
        raise TwinError("--slurm", "dask-jobqueue is not installed", "pip install 'seabed-twin[cluster]'") from None
    given = dask.config.get("jobqueue.slurm")
    cluster = SLURMCluster(cores=given.get("cores") or 1, processes=1, memory=given.get("memory") or "4GB")
    cluster.scale(jobs=jobs)
    return cluster


class DaskEngine:
    """The workers of a Dask cluster, each with a crew of one process a thread."""

    def __init__(self, client: Client):
        self.client = client
        client.register_plugin(_CrewOfWorker())

    def run_many(
        self, function: Callable[[Task], Result], tasks: Iterable[Task], limits: Limits
    ) -> Iterator[Outcome[Task, Result]]:
        """See `Engine`; a task whose Dask worker was lost is given to another.

        Raises:
            TwinError: the scheduler is gone.
        """
        waiting, running, room = iter(tasks), {}, _Room(self.client)
        arriving = as_completed(with_results=True, raise_errors=False)

        def submit(count: int) -> None:
            for task in islice(waiting, count):
                future = self.client.submit(_attempt, function, task, limits, pure=False)
                running[future.key] = task
                arriving.add(future)

        submit(room())
        for future, result in arriving:
            yield _outcome(running.pop(future.key), future, result)
            future.release()
            submit(max(0, room() - len(running)))


class _CrewOfWorker(WorkerPlugin):
    """The crew of one Dask worker."""

    name = "twin-crew"

    def setup(self, worker: Any = None) -> None:
        self.crew = Crew()

    def teardown(self, worker: Any = None) -> None:
        self.crew.end()


def _attempt(function: Callable[[Any], Any], task: Any, limits: Limits) -> tuple[Reply, int]:
    """`Crew.work` as the task of a Dask worker."""
    plugin: Any = get_worker().plugins[_CrewOfWorker.name]
    return plugin.crew.work(function, task, limits)


class _Room:
    """How many tasks to have on a cluster, which may grow: asked for now and then, as asking takes a round trip."""

    def __init__(self, client: Client):
        self.client, self.tasks, self.asked = client, 0, -math.inf

    def __call__(self) -> int:
        if time.monotonic() - self.asked > _ASK_S:
            threads: Any = self.client.nthreads()
            self.tasks = max(_LEAST_AHEAD, _AHEAD * sum(threads.values()))
            self.asked = time.monotonic()
        return self.tasks


def _outcome(task: Any, future: Future, result: Any) -> Outcome:
    if future.status == "finished":
        reply, attempts = result
        return Outcome(task, reply.value, reply.reason, attempts)
    if future.status != "error":
        raise TwinError("scheduler", "it is gone", "one that stays; what is missing is flown with --resume")
    error: Any = result[1] if isinstance(result, tuple) else future.exception()
    if isinstance(error, KilledWorker):
        return Outcome(task, None, "the workers that tried it were lost", error.allowed_failures + 1)
    return Outcome(task, None, describe(error), 1)
