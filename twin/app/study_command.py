"""Commands `twin study` and `twin tune`."""

import json
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

from twin.app import console
from twin.app.outputs import file_stem, output_file
from twin.core.output_folder import sole_writer
from twin.engines.engine import open_engine
from twin.errors import ScenarioError, TwinError
from twin.planning.summary import run_time_s
from twin.report.number_formats import duration
from twin.scenario.file import read_tree
from twin.scenario.model import Scenario
from twin.studies import agreement, rendered_check, report, sentences
from twin.studies.conditions import in_sea_trial
from twin.studies.progress import study_progress
from twin.studies.rendered_check import RenderedCheck
from twin.studies.run_time import parsed_duration
from twin.studies.runner import Fleet, StudyResult, run_study
from twin.studies.study_file import Study, load_study
from twin.studies.surveys import samples, scenario_of_sample
from twin.tuning import rounds, tuning_report
from twin.tuning.candidates import rendered_of, tuning_config
from twin.tuning.rounds import TuningResult
from twin.world.mission import prepare

_CHECKED_SAMPLES = 20  # of a study, among which one that can be flown is looked for


class StudyOptions(NamedTuple):
    out: Path | None = None  #: folder to write; None: runs/study-NAME or runs/tune-NAME
    jobs: int | None = None  #: number of parallel surveys; None: one per core
    scheduler: str | None = None  #: where the surveys run (`open_engine`)
    resume: bool = False  #: run only the surveys whose results are missing in the folder, and those that failed
    live: bool = False  #: print a line for each finished survey
    #: study: number of surrogate surveys, those closest to the limits, that are also rendered; None: 0. Tune: most
    #: rendered surveys of a plan; None: `tune.verify` of the study file
    verify: int | None = None
    #: study: fly rendered what only the surrogate refuses; without it, these surveys have an unknown result
    render_refused: bool = False
    budget: str | None = None  #: time after which surveys are stopped, e.g. "2h"; None: no limit
    extrapolate: bool = False  #: fly surrogate surveys outside the fitted range of the error model
    allow_plugins: bool = False  #: fly plug-ins that study or scenario name as module:Class


@contextmanager
def _fleet(options: StudyOptions, scenarios: Iterator[Scenario]) -> Iterator[Fleet]:
    """Yields the workers; `scenarios` are some of those to fly, for the time that a survey needs at least."""
    if first := next(scenarios, None):
        console.note_first_use(first.imaging.fidelity)
        scenarios = chain([first], scenarios)
    end_s = time.time() + _budget_s(options.budget, scenarios) if options.budget else math.inf
    with open_engine(options.jobs, options.scheduler) as engine, study_progress(options.live, end_s) as progress:
        yield Fleet(engine, progress, end_s=end_s)


def _budget_s(budget: str, scenarios: Iterator[Scenario]) -> float:
    """Returns a budget [s]; raises TwinError if it is too small for the first scenario that can be flown."""
    budget_s = parsed_duration(budget, "--budget")
    for scenario in scenarios:
        with suppress(ScenarioError):
            needed_s = run_time_s(prepare(scenario))
            if budget_s < needed_s:
                problem = f"{duration(budget_s)} is too short for one survey, which takes about {duration(needed_s)}"
                raise TwinError("--budget", problem, "a longer time")
            break
    return budget_s


def _scenarios(study: Study) -> Iterator[Scenario]:
    """Yields the valid scenarios of the first samples of a study."""
    base = read_tree(study.scenario_file)
    for sample in islice(samples(study), _CHECKED_SAMPLES):
        with suppress(ScenarioError):
            yield scenario_of_sample(study, base, sample)


def fly_study(file: str, options: StudyOptions) -> tuple[StudyResult, RenderedCheck | None]:
    """Runs a study, checks it by rendered surveys if asked, writes the results; raises TwinError for invalid input."""
    study = load(file, options)
    folder = _folder(options, "study", study)
    with _fleet(options, _scenarios(study)) as fleet:
        result = run_study(study, folder, options.resume, fleet, options.render_refused)
        if not options.verify or result.interrupted:
            return result, None
        return result, rendered_check.check(result.analysis, options.verify, folder, fleet)


def fly_search(file: str, options: StudyOptions) -> tuple[TuningResult, Path]:
    """Optimises a plan as the study file defines; returns result and report folder; raises TwinError if invalid."""
    study = load(file, options)
    if options.verify is not None:
        config = tuning_config(study).model_copy(update={"verify": options.verify})
        study = study.model_copy(update={"tune": config})
    folder = _folder(options, "tune", study)
    with _fleet(options, _scenarios(rendered_of(study))) as fleet:
        result = rounds.tune(study, folder, options.resume, fleet)
    with sole_writer(folder, used=True):
        tuning_report.write_tuning_report(result, folder)
    return result, folder


def study(file: str, options: StudyOptions, as_json: bool = False) -> int:
    """Runs a study and prints its results, or only a summary as JSON; returns the exit status."""
    result, checked = fly_study(file, options)
    folder = result.page.parent
    for error in result.write_errors:
        console.print_error(f"{folder}: {error}; free some disk space and continue with --resume")
    if as_json:
        identity = {"name": result.analysis.study.name, "out": str(folder), "throughput": result.throughput}
        identity |= {} if checked is None else {"rendered_check": rendered_check.summary(checked)}
        print(json.dumps(report.summary(result.analysis, identity), indent=1))
    else:
        _print_result(result)
        if checked is not None:
            print(checked.sentence())
    if checked is None:
        return exit_status(result)
    return checked.exit_status if checked.interrupted else exit_status(result) or checked.exit_status


def tune(file: str, options: StudyOptions, as_json: bool = False) -> int:
    """Runs a search and prints its result; returns 130 if interrupted, 1 without a recommended plan, otherwise 0."""
    if options.render_refused:
        raise TwinError("--render-refused", "twin tune flies every plan that it recommends rendered", "twin study")
    result, folder = fly_search(file, options)
    if as_json:
        print(json.dumps(tuning_report.summary(result), indent=1))
    else:
        print(tuning_report.headline(result))
        for text in tuning_report.warnings(result):
            print(f"Warning: {text}")
        print(f"Report: {folder / 'tuning.html'}")
        if name := tuning_report.plan_file(result):
            print(f"Plan{'' if result.recommended else ', not shown'}: {folder / name}")
    return 130 if result.interrupted else 0 if result.recommended else 1


def load(file: str, options: StudyOptions) -> Study:
    study = load_study(file, options.allow_plugins)
    study = in_sea_trial(study) if study.sea_trial else study
    changes = {"imaging.extrapolate": True} if options.extrapolate else {}
    return study.model_copy(update={"set": study.set | changes})


def _folder(options: StudyOptions, command: str, study: Study) -> Path:
    folder = options.out or Path("runs") / f"{command}-{file_stem(study.name or command)}"
    output_file(folder / "study.html")
    return folder.absolute()


def _print_result(result: StudyResult) -> None:
    analysis = result.analysis
    print(sentences.headline(analysis))
    for line in sentences.answer_lines(analysis):
        print(f"- {line}")
    rows = [
        (sentences.words(one.name), *(sentences.metric_interval(one.name, i) for i in (one.median, one.bound)))
        for one in analysis.metric_summaries
    ]
    console.print_table(f"{analysis.study.name}: median and 95 % bound of the surveys", rows)
    if (compared := agreement.agreement(analysis)) is not None:
        console.print_table(agreement.verdict_line(compared), agreement.table(compared))
    if analysis.refusal_reasons:
        reasons = [(str(reason.surveys), reason.reason) for reason in analysis.refusal_reasons]
        samples = sentences.counted(len(analysis.refused_samples), "sample")
        console.print_table(f"{samples} cannot be flown: surveys, reason", reasons)
    for warning, count in analysis.warning_counts.items():
        print(f"Warning in {count} of {int((~analysis.duplicate).sum())} surveys: {warning}")
    if result.throughput.surveys:
        print(sentences.throughput(*result.throughput))
    if result.page.is_file():
        print(f"Report: {result.page}")


def exit_status(result: StudyResult) -> int:
    """Returns the exit status of a study.

    130 if interrupted; 2 if every survey was refused; 1 if too few surveys passed, none could be evaluated, surrogate
    and rendered surveys do not agree, or results could not be written; 0 otherwise.
    """
    if result.interrupted:
        return 130
    analysis = result.analysis
    if len(analysis.refused) and analysis.refused.all():
        return 2
    compared = agreement.agreement(analysis)
    disagrees = bool(analysis.study.compare) and (compared is None or not compared.agrees)
    return 1 if disagrees or analysis.requirement_missed or result.write_errors or not analysis.evaluated.any() else 0
