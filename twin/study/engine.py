"""Any number of tasks on the processes of this machine: each comes back, done or with the reason why not."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from importlib.util import find_spec
from itertools import islice
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from twin.errors import TwinError
from twin.study.worker import Crew, Limits

Task = TypeVar("Task")
Result = TypeVar("Result")


class Outcome(NamedTuple, Generic[Task, Result]):
    """What came of a task: its result and "", or None and the reason; and after how many attempts."""

    task: Task
    result: Result | None
    failure: str
    attempts: int


class Engine(Protocol):
    def run_many(
        self, function: Callable[[Task], Result], tasks: Iterable[Task], limits: Limits
    ) -> Iterator[Outcome[Task, Result]]:
        """Runs `function` on every task; outcomes come as they arrive, in no order.

        A task that raises, hangs longer than `limits.timeout_s` or kills its process more than `limits.retries` times
        has failed with its reason. No task takes another one down.

        Args:
            function: importable by name where it runs, as are the classes of tasks and results.
        """
        ...


class LocalEngine:
    """Processes of this machine, each watched by a thread of this one."""

    def __init__(self, jobs: int):
        cores = sorted(os.sched_getaffinity(0))
        self.jobs, self.crew = jobs, Crew([cores[k % len(cores)] for k in range(jobs)])

    def run_many(
        self, function: Callable[[Task], Result], tasks: Iterable[Task], limits: Limits
    ) -> Iterator[Outcome[Task, Result]]:
        """See `Engine`."""
        waiting, running = iter(tasks), dict[Future[Any], Any]()
        with ThreadPoolExecutor(self.jobs) as pool:
            try:
                while True:
                    for task in islice(waiting, 2 * self.jobs - len(running)):
                        running[pool.submit(self.crew.work, function, task, limits)] = task
                    if not running:
                        return
                    for future in wait(running, return_when=FIRST_COMPLETED).done:
                        reply, attempts = future.result()
                        yield Outcome(running.pop(future), reply.value, reply.reason, attempts)
            finally:
                if running:  # interrupted
                    self.crew.end()


def default_jobs() -> int:
    """One job a core that this process may use."""
    return len(os.sched_getaffinity(0))


@contextmanager
def connect(jobs: int | None = None, scheduler: str | None = None, slurm: bool = False) -> Iterator[Engine]:
    """The engine asked for; what was started for it ends with it.

    Args:
        jobs: local processes, or SLURM jobs; one a core where not given.
        scheduler: address of a Dask scheduler, as tcp://host:8786; its workers need this package.

    Raises:
        TwinError: the scheduler does not answer, or what it takes is not installed.
    """
    jobs = jobs or default_jobs()
    if scheduler or slurm:
        if find_spec("distributed") is None:
            name = "--slurm" if slurm else "--scheduler"
            raise TwinError(name, "Dask is not installed", "pip install 'seabed-twin[cluster]'")
        from twin.study import cluster

        with cluster.connect(jobs, scheduler) as engine:
            yield engine
        return
    engine = LocalEngine(jobs)
    try:
        yield engine
    finally:
        engine.crew.end()
