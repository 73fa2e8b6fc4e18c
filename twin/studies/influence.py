"""Influence of what a study varies: the results of the surveys at the two ends of a key."""

from typing import NamedTuple

import numpy as np

from twin.studies import statistics
from twin.studies.analysis import StudyAnalysis

_LEAST_EXPLAINED = 0.05  # of the variance; less is hardly distinguishable from chance


class KeyEnd(NamedTuple):
    """Surveys at one end of a key."""

    values: str  #: smallest and largest value of the key in them
    passed: float  #: fraction that passed
    median: float | None  #: of the first metric, over the completed ones; None without one


class Influence(NamedTuple):
    key: str
    explained: float  #: fraction of the variance of pass or fail, or else of the first metric, that the key explains
    ends: tuple[KeyEnd, KeyEnd]  #: smallest and largest values; of a text, those of which fewest and most passed


def influences(analysis: StudyAnalysis) -> list[Influence]:
    """Returns the influence of each varied key that has a clear one, the largest first; see `explained_variance`."""
    if not analysis.evaluated.any():
        return []
    chosen, found, metric = np.asarray(analysis.evaluated), [], next(iter(analysis.metrics), "")
    passed = analysis.passed[chosen].astype(float)
    values = np.where(analysis.included(metric), analysis.numbers(metric), np.nan)[chosen]
    result = passed if np.ptp(passed) else values
    for key in analysis.keys:
        groups, names = analysis.key_groups(key, chosen)
        members = [groups == k for k in range(len(names))]
        if analysis.key_numbers(key) is None:
            members.sort(key=lambda one: passed[one].mean())
        ends = [KeyEnd(names[groups[one][0]], passed[one].mean(), _median(values[one])) for one in members]
        known = np.isfinite(result)
        found.append(Influence(key, statistics.explained_variance(groups[known], result[known]), (ends[0], ends[-1])))
    return sorted((one for one in found if one.explained > _LEAST_EXPLAINED), key=lambda one: -one.explained)


def _median(values: statistics.Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None
