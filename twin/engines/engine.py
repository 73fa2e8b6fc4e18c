"""Engines that run many tasks in parallel: their interface, and the engine of this machine."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from itertools import islice
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from twin.engines.worker import TaskLimits, WorkerPool

Task = TypeVar("Task")
Result = TypeVar("Result")


class Outcome(NamedTuple, Generic[Task, Result]):
    """Outcome of one task."""

    task: Task  #: the task
    result: Result | None  #: result of the function; None if the task failed
    failure: str  #: reason of the failure; "" if the task did not fail
    attempts: int  #: number of attempts


class Engine(Protocol):
    """Runs a function on many tasks in parallel."""

    def run_many(
        self, function: Callable[[Task], Result], tasks: Iterable[Task], limits: TaskLimits
    ) -> Iterator[Outcome[Task, Result]]:
        """Runs `function` on every task and yields the outcomes in order of completion.

        A task fails if it raises an exception, runs longer than `limits.timeout_s`, or loses its process more than
        `limits.retries` times. A failed task does not affect the others.

        Args:
            function: function of one task. The workers must be able to import it by name, as well as the classes of
                the tasks and results.
        """
        ...


class LocalEngine:
    """Engine that runs tasks in worker processes on this machine, each pinned to a CPU core.

    One thread per worker process waits for its results.

    Args:
        jobs: largest number of worker processes.
    """

    def __init__(self, jobs: int):
        cores = sorted(os.sched_getaffinity(0))
        self.jobs, self.pool = jobs, WorkerPool([cores[k % len(cores)] for k in range(jobs)])

    def run_many(
        self, function: Callable[[Task], Result], tasks: Iterable[Task], limits: TaskLimits
    ) -> Iterator[Outcome[Task, Result]]:
        """Runs `function` on every task; see `Engine.run_many`."""
        waiting, running = iter(tasks), dict[Future[Any], Any]()
        with ThreadPoolExecutor(self.jobs) as threads:
            try:
                while True:
                    for task in islice(waiting, 2 * self.jobs - len(running)):
                        running[threads.submit(self.pool.run, function, task, limits)] = task
                    if not running:
                        return
                    for future in wait(running, return_when=FIRST_COMPLETED).done:
                        reply, attempts = future.result()
                        yield Outcome(running.pop(future), reply.value, reply.reason, attempts)
            finally:
                if running:  # interrupted: a thread ends only after its worker has been killed
                    self.pool.close()


def default_jobs() -> int:
    """Returns the number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0))
