"""Studies and surveys that take no time: errors by a known law of turbidity, altitude and seed."""

import numpy as np

from twin.study.engine import Outcome
from twin.study.flight import row_of
from twin.study.study_file import load_study
from twin.study.worker import describe

STUDY = """
scenario = "quickstart"
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
    """The study of a text, with (old, new) changes."""
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    file = folder / "study.toml"
    file.write_text(text)
    return load_study(file)


def fly(survey):
    """Map errors grow with turbidity; in the murkiest water vision is lost."""
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
    """What a full disk does to a survey."""
    return row_of(survey, "failed", "[Errno 28] No space left on device")


def crash_in_murk(survey):
    """A program that breaks in murky water."""
    if survey.values["water.turbidity"] > 10:
        raise ZeroDivisionError("no contrast")
    return fly(survey)


class Here:
    """Runs tasks one after another in this process; stops as by Ctrl-C before the task of this number."""

    def __init__(self, stop_before=None):
        self.stop_before, self.flown = stop_before, []

    def run_many(self, function, tasks, limits):
        for task in tasks:
            if len(self.flown) == self.stop_before:
                raise KeyboardInterrupt
            self.flown.append(task.key)
            try:
                yield Outcome(task, function(task), "", 1)
            except ArithmeticError as error:
                yield Outcome(task, None, describe(error), 1)
