"""Ten odd studies: their file, how their surveys end, and whether they are interrupted.

`python tests/odd_studies.py` prints a table of the answers of `twin study`.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from study_surveys import SerialEngine, study_of

from twin.app import study_command
from twin.errors import ScenarioError
from twin.studies import runner, sentences
from twin.studies.flight import row_of
from twin.studies.progress import StudyProgress

STUDY = """
scenario = "reef"
show = ["map.le90_m"]

[vary]
plan.altitude_m = { uniform = [1.0, 3.0] }

[sampling]
method = "lhs"
samples = 240
paired = false

[require]
probability = 0.9
"map.le90_m" = 0.02
"""
RANGE, SAMPLES = "{ uniform = [1.0, 3.0] }", "samples = 240"
AS_GRID = ('"lhs"\nsamples = 240', '"grid"\nseeds = 40')


class OddStudy(NamedTuple):
    """An odd study: changes of the study file, rule for which surveys pass, and the survey at which Ctrl-C is pressed.

    `passes` returns None for a survey that cannot be planned.
    """

    changes: tuple[tuple[str, str], ...] = ()
    passes: Callable[[dict], bool | None] = lambda values: True
    stop_before: int | None = None


def in_two_ranges(values):
    """Returns whether the altitude is in one of two separate ranges."""
    return 1.6 <= values["plan.altitude_m"] <= 1.9 or values["plan.altitude_m"] >= 2.5


ODD_STUDIES = {
    "all refused": OddStudy(((RANGE, "{ uniform = [-3.0, -1.0] }"),)),
    "no survey can be planned": OddStudy(((SAMPLES, "samples = 8"),), lambda values: None),
    "half refused": OddStudy(((RANGE, "{ uniform = [-2.0, 2.0] }"),)),
    "non-monotonic": OddStudy((("samples = 240", "samples = 600"),), in_two_ranges),
    "one sample": OddStudy(((SAMPLES, "samples = 1"),)),
    "zero passes": OddStudy(((SAMPLES, "samples = 12"),), lambda values: False),
    "all pass": OddStudy(),
    "constant parameter": OddStudy(((RANGE, "{ choice = [2.0] }"), ("samples = 240", "samples = 60"))),
    "categorical parameter": OddStudy(
        ((f"plan.altitude_m = {RANGE}", 'water.jerlov = { grid = ["IB", "II", "III"] }'), AS_GRID),
        lambda values: values["water.jerlov"] == "IB",
    ),
    "duplicated values": OddStudy(((RANGE, "{ grid = [2.0, 2.0, 2.5] }"), AS_GRID)),
    "interrupted": OddStudy(stop_before=5),
}


def fly(passes):
    """Returns a function that flies a survey whose end is given by the rule `passes`."""

    def fly_survey(survey):
        passed = passes(survey.values)
        if passed is None:
            return row_of(survey, "refused", "plan.overlap_across: 0.99: too large (allowed: up to 0.95)")
        error_m = 0.01 if passed else 0.03
        verdict = {"value": error_m, "limit": 0.02, "passed": passed}
        limits = {f"require.map.le90_m.{name}": value for name, value in verdict.items()}
        return row_of(survey, "complete", "") | {"map.le90_m": error_m} | limits

    return fly_survey


def run(name, folder):
    """Runs an odd study in a folder; returns its result."""
    odd = ODD_STUDIES[name]
    study = study_of(folder, STUDY, *odd.changes)
    engine = SerialEngine(odd.stop_before)
    return runner.run_study(study, folder / "out", False, runner.Fleet(engine, StudyProgress(), fly(odd.passes)))


def answer_of(name, folder):
    """Returns the exit status and the sentences that `twin study` prints about an odd study."""
    try:
        result = run(name, folder)
    except ScenarioError as error:
        return 2, [line.replace(f"{folder}/", "") for line in error.lines]
    text = [sentences.headline(result.analysis), *sentences.answer_lines(result.analysis)]
    return study_command.exit_status(result), [line.replace(f"{folder}/", "") for line in text]


if __name__ == "__main__":
    runner.write_report = lambda analysis, page: None
    print("| study | exit status | answer |\n|---|---|---|")
    for name in ODD_STUDIES:
        with tempfile.TemporaryDirectory() as folder:
            status, lines = answer_of(name, Path(folder))
        print(f"| {name} | {status} | {' '.join(lines)} |")
