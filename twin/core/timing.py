"""Stopwatch for the processing stages of a survey."""

import sys
import time
from array import array
from collections import defaultdict
from collections.abc import Callable, Generator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import Any

import numpy as np

#: Function, such as a `Stopwatch`, that takes the name of a stage and returns a context manager that times the stage.
StageTimer = Callable[[str], AbstractContextManager[None]]
STAGES = ("physics", "render", "optics", "f2f", "f2m", "stereo", "flow", "network", "ga", "map", "orthomosaic")


class Stopwatch:
    """Stopwatch that collects the durations of named stages: `with watch("f2f"): ...`; `now` is its clock [s]."""

    def __init__(self, now: Callable[[], float] = time.perf_counter) -> None:
        self._durations_s: dict[str, array[float]] = defaultdict(partial(array, "d"))
        self._now = now

    @contextmanager
    def __call__(self, stage: str) -> Generator[None]:
        start = self._now()
        try:
            yield
        finally:
            self._durations_s[stage].append(self._now() - start)

    def durations_ms(self, stage: str) -> list[float]:
        return [round(1e3 * duration_s, 3) for duration_s in self._durations_s.get(stage, ())]

    def summary(self) -> dict[str, dict[str, float | int | None]]:
        """Returns count, total [s], mean and 95th percentile [ms] (None for count 0) of all `STAGES`."""
        return {stage: _summary(self._durations_s.get(stage, ())) for stage in STAGES}


def timing_summary(simulated_s: float, wall_s: float, stopwatch: Stopwatch) -> dict[str, Any]:
    """Returns wall and simulated or recorded time [s], peak memory [MiB] (None on Windows), and times of the stages."""
    memory_mb = _peak_rss_mb()
    return {"wall_s": wall_s, "simulated_s": simulated_s, "peak_rss_mb": memory_mb, "stages": stopwatch.summary()}


def _peak_rss_mb() -> float | None:
    if sys.platform == "win32":
        return None
    import resource

    unit = 2**20 if sys.platform == "darwin" else 2**10  # of ru_maxrss
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def _summary(durations_s: Sequence[float]) -> dict[str, float | int | None]:
    if not durations_s:
        return {"count": 0, "mean_ms": None, "p95_ms": None, "total_s": 0.0}
    ms = np.array(durations_s) * 1e3
    mean_ms, p95_ms = float(ms.mean()), float(np.percentile(ms, 95))
    return {"count": len(ms), "mean_ms": mean_ms, "p95_ms": p95_ms, "total_s": float(ms.sum() / 1e3)}
