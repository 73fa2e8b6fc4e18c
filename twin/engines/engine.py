"""Engines that run many tasks in parallel: their interface, and the engine of this machine."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import closing, contextmanager
from importlib.util import find_spec
from itertools import islice
from typing import Any, Protocol

from twin.engines.worker import Outcome, Result, Task, TaskLimits, WorkerPool
from twin.errors import TwinError

SLURM = "slurm"  #: scheduler that stands for new SLURM jobs


class Engine(Protocol):
    """Runs a function on many tasks in parallel."""

    def run_many(
        self, function: Callable[[Task], Result], tasks: Iterable[Task], limits: TaskLimits
    ) -> Iterator[Outcome[Task, Result]]:
        """Runs `function` on every task and yields the outcomes in order of completion.

        A task fails if it raises an exception, runs longer than `limits.timeout_s`, or loses its process more than
        `limits.retries` times. A failed task does not affect the others. The workers must be able to import the
        function by name, as well as the classes of the tasks and results.
        """
        ...


class LocalEngine:
    """Engine that runs tasks in `jobs` worker processes on this machine, each pinned to a CPU core."""

    def __init__(self, jobs: int):
        cores = sorted(os.sched_getaffinity(0))
        self.jobs, self.pool = jobs, WorkerPool([cores[k % len(cores)] for k in range(jobs)])

    def run_many(
        self, function: Callable[[Task], Result], tasks: Iterable[Task], limits: TaskLimits
    ) -> Iterator[Outcome[Task, Result]]:
        waiting, running = iter(tasks), set[Future[Any]]()
        with ThreadPoolExecutor(self.jobs) as threads:
            try:
                while True:
                    for task in islice(waiting, 2 * self.jobs - len(running)):
                        running.add(threads.submit(self.pool.run, function, task, limits))
                    if not running:
                        return
                    done, running = wait(running, return_when=FIRST_COMPLETED)
                    yield from (future.result() for future in done)
            finally:
                if running:  # interrupted: a thread ends only after its worker has been killed
                    self.pool.close()


@contextmanager
def open_engine(jobs: int | None = None, scheduler: str | None = None) -> Iterator[Engine]:
    """Yields an engine; the workers that it started are stopped when the context ends.

    It has `jobs` (default: one per core) processes on this machine or, with the scheduler "slurm", SLURM jobs; any
    other scheduler is the address of a running Dask scheduler, e.g. tcp://host:8786, whose workers must have this
    package. Raises TwinError if the scheduler does not answer, or a package that it needs is not installed.
    """
    jobs = jobs or default_jobs()
    if not scheduler:
        engine = LocalEngine(jobs)
        with closing(engine.pool):
            yield engine
        return
    if find_spec("distributed") is None:
        raise TwinError("--scheduler", "Dask is not installed", "pip install 'seabed-twin[cluster]'")
    from twin.engines import dask_engine

    slurm = scheduler == SLURM
    with dask_engine.start_slurm_jobs(jobs) if slurm else dask_engine.connect_scheduler(scheduler) as engine:
        yield engine


def default_jobs() -> int:
    """Returns the number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0))
