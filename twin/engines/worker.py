"""Worker processes that run one task at a time, and a thread-safe pool of them.

A survey runs compiled code, which can crash its process or hang without a way to interrupt it. Each task therefore runs
in a worker process that can be killed and replaced.
"""

import math
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Generic, Literal, NamedTuple, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")

#: Environment of a worker: one thread per library, as there is one worker per core. With LP_NUM_THREADS=0, Mesa renders
#: in the calling thread.
SINGLE_THREADED = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "LP_NUM_THREADS": "0",
}


OUT_OF_TIME = "the time of all tasks was used up"  #: failure of a task that `TaskLimits.end_s` stopped or prevented


class TaskLimits(NamedTuple):
    """Maximum run time of a task [s], and largest number of retries if its process ends or is killed."""

    timeout_s: float = 3600.0
    retries: int = 2
    end_s: float = math.inf  #: time [s since the epoch] at which running tasks are stopped, and no more are started


class Outcome(NamedTuple, Generic[Task, Result]):
    task: Task
    result: Result | None  #: result of the function; None if the task failed
    failure: str  #: reason of the failure; "" if the task did not fail
    attempts: int


class Reply(NamedTuple):
    #: "done" if the function returned a value; "raised" if it raised an exception; "timeout" if it ran too long;
    #: "killed" if the process ended or was killed
    kind: Literal["done", "raised", "timeout", "killed"]
    value: Any = None  #: the returned value, for the kind "done"
    reason: str = ""  #: why there is no value; "" for the kind "done"


class Worker:
    """One worker process, pinned to a CPU core if one is given."""

    def __init__(self, core: int | None = None) -> None:
        self.core = core
        self._pipe, child_end = multiprocessing.Pipe()
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 (lives as long as the process)
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", f"from twin.engines import worker; worker.main({child_end.fileno()}, {core})"],
            env=os.environ | SINGLE_THREADED | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            pass_fds=[child_end.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            stderr=self._output,
            start_new_session=True,  # Ctrl-C reaches only the main process, which closes its workers itself
        )
        child_end.close()

    def run(self, request: bytes, timeout_s: float) -> Reply:
        """Sends a pickled (function, task) to the process, which it kills after the timeout; returns the reply."""
        try:
            self._pipe.send_bytes(request)
            if self._pipe.poll(timeout_s):
                return pickle.loads(self._pipe.recv_bytes())
        except (EOFError, OSError):
            self.kill()
            return Reply("killed", reason=self._exit_reason())
        self.kill()
        return Reply("timeout", reason=f"did not finish within {timeout_s:g} s")

    def kill(self) -> None:
        """Kills the process if it still exists. Thread-safe; a concurrent `run` returns a reply of kind "killed"."""
        self._process.kill()
        self._process.wait()

    def close(self) -> None:
        """Kills the process and closes the pipe to it; to be called only by the thread that uses this worker."""
        self.kill()
        self._pipe.close()

    def _exit_reason(self) -> str:
        code = self._process.returncode
        how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"terminated with exit status {code}"
        self._output.seek(0)
        lines = self._output.read().decode(errors="replace").split("\n\n")[0].strip().splitlines()
        return f"worker process was {how}" + (f": {lines[-1]}" if lines else "")


class WorkerPool:
    """Thread-safe pool of worker processes, one per concurrent task; idle workers are reused.

    The first workers are pinned to the CPU cores `cores`; further ones are not pinned.
    """

    def __init__(self, cores: Sequence[int | None] = ()) -> None:
        self._free_cores = list(cores)
        self._idle: list[Worker] = []
        self._busy: set[Worker] = set()
        self._lock, self._closed = threading.Lock(), False

    def close(self) -> None:
        """Kills all workers; concurrent calls of `run` return a failure."""
        with self._lock:
            self._closed = True
            idle, self._idle = self._idle, []
            busy = list(self._busy)
        for worker in idle:
            worker.close()
        for worker in busy:
            worker.kill()  # its own thread closes the pipe: closing it twice could close a file of another thread

    def run(self, function: Callable[[Task], Result], task: Task, limits: TaskLimits) -> Outcome[Task, Result]:
        """Runs a task on an idle or a new worker.

        The task is retried, at most `limits.retries` times, if its process ends or is killed, but not after an
        exception or a timeout.
        """
        request = pickle.dumps((function, task))
        attempts = 0
        while True:
            left_s = limits.end_s - time.time()
            attempts += left_s > 0
            reply = self._run_once(request, min(limits.timeout_s, left_s)) if left_s > 0 else Reply("timeout")
            if reply.kind == "timeout" and left_s <= limits.timeout_s:
                return Outcome(task, None, OUT_OF_TIME, attempts)
            if reply.kind != "killed" or attempts > limits.retries or self._closed:
                return Outcome(task, reply.value, reply.reason, attempts)

    def _run_once(self, request: bytes, timeout_s: float) -> Reply:
        with self._lock:
            if self._closed:
                return Reply("killed", reason="the worker pool is closed")
            worker = self._idle.pop() if self._idle else Worker(self._free_cores.pop(0) if self._free_cores else None)
            self._busy.add(worker)
        reply = worker.run(request, timeout_s)
        with self._lock:
            self._busy.discard(worker)
            reusable = reply.kind == "done" and not self._closed
            if reusable:
                self._idle.append(worker)
            else:
                self._free_cores.append(worker.core)
        if not reusable:
            worker.close()  # even after an exception, which may leave the process in an undefined state
        return reply


def describe_exception(error: BaseException) -> str:
    """Returns one line of text on an exception: its type, its message, and the file and line that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    source = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    message = " ".join(str(error).split())
    return f"{type(error).__name__}{': ' if message else ''}{message}{source}"


def main(pipe: int, core: int | None) -> None:
    """Main loop of the worker process: answers each pickled (function, task) with a `Reply`, until the pipe closes."""
    if core is not None:
        os.sched_setaffinity(0, {core})
    threading.Thread(target=_exit_with_parent, args=(os.getppid(),), daemon=True).start()
    connection = Connection(pipe)
    while True:
        try:
            request = connection.recv_bytes()
        except (EOFError, OSError):
            return
        try:
            function, task = pickle.loads(request)
            reply = pickle.dumps(Reply("done", function(task)))
        except BaseException as error:  # every failure becomes a reply; the process must survive
            reply = pickle.dumps(Reply("raised", reason=describe_exception(error)))
        connection.send_bytes(reply)


def _exit_with_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)
