"""A study and surveys that take no time: the map error is a known function of turbidity, altitude and seed."""

import numpy as np

from twin.engines.worker import Outcome, describe_exception
from twin.studies.flight import row_of
from twin.studies.study_file import load_study

STUDY = """
scenario = "reef"
seek = "water.turbidity"
show = ["map.le90_m"]

[vary]
water.turbidity = { log_uniform = [1.0, 40.0] }
plan.altitude_m = { uniform = [1.6, 2.4] }

[[together]]
keys = ["water.jerlov", "sun.illuminance_lx"]
rows = [["IB", 20.0], ["III", 0.0]]

[sampling]
method = "lhs"
samples = 12

[require]
probability = 0.8
"map.le90_m" = 0.02
"""
LOST = "vision lost at 2.0 s: too few points matched"


def study_of(folder, text=STUDY, *changes):
    """Returns the study of a TOML text, with (old, new) replacements."""
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    file = folder / "study.toml"
    file.write_text(text)
    return load_study(file)


def fly(survey):
    """Returns a row whose map error is proportional to turbidity; at a turbidity above 25 the survey is aborted."""
    turbidity, altitude_m = survey.values["water.turbidity"], survey.values["plan.altitude_m"]
    noise = float(np.exp(0.1 * np.random.default_rng(survey.seed).standard_normal()))
    if turbidity > 25:
        return row_of(survey, "aborted", LOST) | {"map.le90_m": None}
    error_m = 0.001 * turbidity * altitude_m / 2 * noise
    limit_m = survey.scenario.require["map.le90_m"]
    verdict = {"value": error_m, "limit": limit_m, "passed": error_m <= limit_m}
    return row_of(survey, "complete", "") | {
        "map.le90_m": error_m,
        **{f"require.map.le90_m.{name}": value for name, value in verdict.items()},
    }


def fail(survey):
    """Returns the row of a survey that failed because the disk is full."""
    return row_of(survey, "failed", "[Errno 28] No space left on device")


def crash_in_turbid_water(survey):
    """Raises an exception at a turbidity above 10."""
    if survey.values["water.turbidity"] > 10:
        raise ZeroDivisionError("no contrast")
    return fly(survey)


class SerialEngine:
    """Engine that runs tasks one after another in this process, and raises `reason` before a given task."""

    def __init__(self, stop_before=None, reason=KeyboardInterrupt):
        self.stop_before, self.reason, self.flown = stop_before, reason, []

    def run_many(self, function, tasks, limits):
        for task in tasks:
            if len(self.flown) == self.stop_before:
                raise self.reason
            self.flown.append(task.key)
            try:
                yield Outcome(task, function(task), "", 1)
            except ArithmeticError as error:
                yield Outcome(task, None, describe_exception(error), 1)
