"""Rows of the benchmark: processor time of all threads and that of a floor, measured in turn in one process."""

import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.errors import TwinError

N_ROUNDS = 5


class BenchmarkRow(NamedTuple):
    """Values of one stage, one per round, and those of its floor in the same rounds; no values: not measured."""

    name: str
    unit: str  #: of values and floors
    values: Sequence[float] | Array
    floor: str = ""  #: library call or limit to compare with, or why the row is not measured; "": none
    floors: Sequence[float] | Array = ()

    @property
    def spread(self) -> list[float]:
        """Returns median, minimum and maximum of the ratios to the floor, or of the values without a floor."""
        compared = np.divide(self.values, self.floors) if len(self.floors) else self.values
        return np.quantile(compared, [0.5, 0, 1]).tolist() if len(self.values) else []


def processor_ms(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return 1e3 * (time.process_time() - start)


def alternate(*works: Callable[[], object], n: int = N_ROUNDS) -> Array:
    """Returns the processor times (works, n) [ms], measured in turn after a first round, which loads compiled code."""
    return np.array([[processor_ms(work) for work in works] for _ in range(n + 1)])[1:].T


def child_ms(*arguments: str) -> float:
    """Returns the processor time of Python with these arguments [ms]; TwinError if it fails."""
    return _child(*arguments)[1]


def child_ms_and_peak_mb(code: str) -> tuple[float, float]:
    """Returns processor time [ms] and peak memory [MB], of Linux, of Python that runs `code`; TwinError if it fails."""
    # not `ru_maxrss`, which is at least the memory of the parent
    peak_kb, ms = _child("-c", f"{code}\nprint(open('/proc/self/status').read().split('VmHWM:')[1].split()[0])")
    return ms, float(peak_kb) / 1e3


def _child(*arguments: str) -> tuple[str, float]:
    """Returns the last word that Python with these arguments prints, and its processor time [ms]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with TemporaryDirectory(prefix="twin-") as cwd:  # for files that it writes
        done = subprocess.run([sys.executable, "-P", *arguments], capture_output=True, text=True, check=False, cwd=cwd)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        problem = f"ended with exit status {done.returncode}: {done.stderr.strip()[-200:]}"
        raise TwinError("bench", f"python {' '.join(arguments)[:80]} {problem}")
    ms = 1e3 * (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return (done.stdout.split() or [""])[-1], ms
