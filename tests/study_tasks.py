"""Tasks for worker processes: correct ones, and ones that fail in every possible way."""

import os
import signal
import time
from pathlib import Path


def square(number):
    return number * number


def process_and_cores(_):
    """Returns the id of the process and the CPU cores that it may use."""
    return os.getpid(), os.sched_getaffinity(0)


def misbehave(task):
    """Performs the named action; "die once" creates the file `path` and succeeds at the second attempt."""
    action, path = task
    if action == "raise":
        raise ValueError("the sea is closed")
    if action == "hang":
        time.sleep(600)
    if action == "die" or (action == "die once" and not Path(path).exists()):
        Path(path).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return action


def slow_square(number):
    time.sleep(0.2)
    return number * number
