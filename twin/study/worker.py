"""Processes that fly: each takes a function and its task and sends back what came of it; a crew hands them out.

A survey draws with OpenGL and computes in compiled code: it can take its process down, or hang where no exception
reaches it. So it runs in a process that can be killed and replaced, and the program that watches it lives on.
"""

from __future__ import annotations

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
from typing import Any, Literal, NamedTuple

#: One survey a core: what would share its work among all cores is told not to (0: Mesa draws in the calling thread).
THREADS = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "LP_NUM_THREADS": "0",
}


class Limits(NamedTuple):
    """How long a task may take [s], and how often it is tried again where its process died."""

    timeout_s: float = 3600.0
    retries: int = 2


class Reply(NamedTuple):
    """What came of a task: its result, or why there is none."""

    kind: Literal["done", "crashed", "hung", "killed"]
    value: Any = None
    reason: str = ""


class Worker:
    """One process that answers tasks, on the processor of this number where one is given."""

    def __init__(self, processor: int | None = None) -> None:
        self.processor = processor
        self._pipe, theirs = multiprocessing.Pipe()
        self._words = tempfile.TemporaryFile()  # noqa: SIM115 (lives as long as the process)
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"from twin.study import worker; worker.main({theirs.fileno()}, {processor})"],
            env=os.environ | THREADS | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=self._words,
            stderr=self._words,
            start_new_session=True,  # Ctrl-C is for the study, which ends its surveys itself
        )
        theirs.close()

    def ask(self, request: bytes, timeout_s: float) -> Reply:
        """What came of the task; a process that hung or died is gone afterwards."""
        try:
            self._pipe.send_bytes(request)
            if self._pipe.poll(timeout_s):
                return pickle.loads(self._pipe.recv_bytes())
        except (EOFError, OSError):
            self.kill()
            return Reply("killed", reason=self._death())
        self.kill()
        return Reply("hung", reason=f"did not end within {timeout_s:g} s")

    def kill(self) -> None:
        """Kills the process, if it is still there; any thread may, and one that asks is answered "killed"."""
        self._process.kill()
        self._process.wait()

    def end(self) -> None:
        """Kills the process and closes the pipe to it: for the one thread that holds this worker."""
        self.kill()
        self._pipe.close()

    def _death(self) -> str:
        """How the process died: the signal or the status, and its last words."""
        code = self._process.returncode
        how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"
        self._words.seek(0)
        words = self._words.read().decode(errors="replace").split("\n\n")[0].strip().splitlines()
        return f"its process was {how}" + (f": {words[-1]}" if words else "")


class Crew:
    """Worker processes kept from task to task; as many as are asked at a time, each on a processor of its own."""

    def __init__(self, processors: Sequence[int | None] = ()) -> None:
        self._free = list(processors)  # of which no worker has been made yet
        self._idle: list[Worker] = []
        self._busy: set[Worker] = set()
        self._lock, self._over = threading.Lock(), False

    def end(self) -> None:
        """Kills all workers; whoever waits for one is told so."""
        with self._lock:
            self._over = True
            idle, self._idle = self._idle, []
            busy = list(self._busy)
        for worker in idle:
            worker.end()
        for worker in busy:
            worker.kill()  # who asked it ends it: a pipe closed by two threads would close another's file

    def work(self, function: Callable[[Any], Any], task: Any, limits: Limits) -> tuple[Reply, int]:
        """The reply to a task, and the number of attempts: only a process that died is tried again."""
        request = pickle.dumps((function, task))
        attempts = 0
        while True:
            attempts += 1
            reply = self._ask(request, limits.timeout_s)
            if reply.kind != "killed" or attempts > limits.retries or self._over:
                return reply, attempts

    def _ask(self, request: bytes, timeout_s: float) -> Reply:
        with self._lock:
            if self._over:
                return Reply("killed", reason="the study is over")
            worker = self._idle.pop() if self._idle else Worker(self._free.pop(0) if self._free else None)
            self._busy.add(worker)
        reply = worker.ask(request, timeout_s)
        with self._lock:
            self._busy.discard(worker)
            kept = reply.kind == "done" and not self._over
            if kept:
                self._idle.append(worker)
            else:
                self._free.append(worker.processor)
        if not kept:
            worker.end()  # also after a crash: who knows what it left behind
        return reply


def describe(error: BaseException) -> str:
    """An exception in a line: kind, words, and the place in the program."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    words = " ".join(str(error).split())
    return f"{type(error).__name__}{': ' if words else ''}{words}{place}"


def main(pipe: int, processor: int | None) -> None:
    """The process that flies: answers each pickled (function, task) with a pickled `Reply`, until nobody listens."""
    if processor is not None:
        os.sched_setaffinity(0, {processor})
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    connection = Connection(pipe)
    while True:
        try:
            request = connection.recv_bytes()
        except (EOFError, OSError):
            return
        connection.send_bytes(_answer(request))


def _answer(request: bytes) -> bytes:
    try:
        function, task = pickle.loads(request)
        return pickle.dumps(Reply("done", function(task)))
    except BaseException as error:  # whatever it was, the next task gets its chance
        return pickle.dumps(Reply("crashed", reason=describe(error)))


def _end_with(parent: int) -> None:
    """Ends this process soon after the one that asked for it."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)
