"""Tasks for workers: plain ones, and such that go wrong in every way."""

import os
import signal
import time
from pathlib import Path


def square(number):
    return number * number


def processor(_):
    return os.getpid(), os.sched_getaffinity(0)


def misbehave(task):
    """Does as the word says; `die once` leaves a mark at the path and survives the second time."""
    word, path = task
    if word == "raise":
        raise ValueError("the sea is closed")
    if word == "hang":
        time.sleep(600)
    if word == "die" or (word == "die once" and not Path(path).exists()):
        Path(path).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return word


def slow_square(number):
    time.sleep(0.2)
    return number * number
