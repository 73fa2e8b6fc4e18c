"""Interface of the engines that run many tasks on worker processes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Generic, NamedTuple, Protocol, TypeVar

from twin.studies.worker import TaskLimits

Task = TypeVar("Task")
Result = TypeVar("Result")


class Outcome(NamedTuple, Generic[Task, Result]):
    """Outcome of one task.

    Args:
        task: the task.
        result: result of the function; None if the task failed.
        failure: reason of the failure; "" if the task did not fail.
        attempts: number of attempts.
    """

    task: Task
    result: Result | None
    failure: str
    attempts: int


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
