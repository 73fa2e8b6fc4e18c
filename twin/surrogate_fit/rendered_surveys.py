"""Flies rendered surveys, compares their image measurements with the surrogate's, and fits the error model."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from twin import survey
from twin.core.timing import Stopwatch
from twin.errors import SurveyAborted, TwinError
from twin.scenario.model import Scenario
from twin.session.assembly import image_vision, navigator_with
from twin.surrogate.coverage import QUANTITIES, Range, survey_conditions
from twin.surrogate.error_model import ErrorModel
from twin.surrogate.error_model_file import FittedErrorModel
from twin.surrogate.matchability import Matchability
from twin.surrogate.surrogate_world import surrogate_vision
from twin.surrogate_fit.comparison import ComparisonVision
from twin.surrogate_fit.fit import SurveyStatistics, fit_error_model, log_misfit
from twin.world.mission import prepare
from twin.world.rendered_world import RenderedWorld

_FILE = "surrogate_comparison.json"
_MIN_SURVEYS = 2
_MAX_LOST = 0.2  # largest fraction of lost frames of a survey to which the model is fitted
#: Cramer-Rao bound [px] above which no survey is flown: at 0.26 px, three quarters of the frames were lost.
_MAX_BOUND_PX = 0.2
_CONDITION = "condition_"  # prefix of the names of the conditions in the statistics


def fit_to_surveys(surveys: Sequence[SurveyStatistics], compared: ErrorModel) -> FittedErrorModel:
    """Returns the error model fitted to rendered surveys.

    Args:
        surveys: statistics of each survey; surveys without link or map statistics, e.g. aborted ones, are ignored.
        compared: error model of the surrogate with which the surveys were compared.

    Raises:
        TwinError: fewer than two surveys have complete statistics.
    """
    complete = [s for s in surveys if _is_complete(s)]
    if len(complete) < _MIN_SURVEYS:
        raise TwinError("fit-surrogate", f"{len(complete)} surveys are complete", f"at least {_MIN_SURVEYS}")
    fitted = fit_error_model(complete, compared)
    return FittedErrorModel(fitted, len(complete), log_misfit(complete, compared, fitted), _fitted_range(complete))


def _fitted_range(surveys: Sequence[SurveyStatistics]) -> dict[str, Range]:
    """Returns the smallest and the largest value of each condition of the surveys, by name of `QUANTITIES`."""
    values = {name: [x for s in surveys for x in s.get(_CONDITION + name, ())] for name in QUANTITIES}
    return {name: (min(found), max(found)) for name, found in values.items() if found}


def _is_complete(statistics: SurveyStatistics) -> bool:
    """Returns whether a survey has links and a map, and lost few frames.

    A map of rough ground may have no level cells, and thus no statistics of height errors.
    """
    has_both = "consecutive_product_images" in statistics and "hole_known" in statistics
    return has_both and float(np.mean(statistics["frame_lost"])) <= _MAX_LOST


def all_statistics(
    surveys: Sequence[tuple[Scenario, Path]], compared: ErrorModel, jobs: int = 1
) -> Iterator[SurveyStatistics]:
    """Yields the statistics of rendered surveys in their order, flown in `jobs` processes; see `survey_statistics`.

    Args:
        surveys: description and run folder of each survey.
        compared: error model of the surrogate to compare with.
        jobs: number of processes; 1: the surveys are flown in this process.
    """
    scenarios, folders = [scenario for scenario, _ in surveys], [folder for _, folder in surveys]
    one = partial(survey_statistics, compared=compared)
    if jobs == 1:
        yield from map(one, scenarios, folders)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        yield from pool.map(one, scenarios, folders)


def survey_statistics(scenario: Scenario, folder: Path, compared: ErrorModel) -> SurveyStatistics:
    """Returns the statistics of a rendered survey's comparison with the surrogate.

    Reads them from the folder if they were saved there for the same scenario and error model, else flies the survey. A
    survey whose water is too turbid for any matches is not flown, and has no statistics.

    Args:
        scenario: description of the survey.
        folder: run folder of the survey.
        compared: error model of the surrogate to compare with.
    """
    return _load(scenario, folder, compared) or _fly(scenario, folder, compared)


def _load(scenario: Scenario, folder: Path, compared: ErrorModel) -> SurveyStatistics | None:
    """Returns the statistics saved in a folder; None if there are none for this scenario and error model."""
    try:
        saved = json.loads((folder / _FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    same = saved["scenario_hash"] == scenario.fingerprint() and saved["model"] == repr(compared)
    return saved["statistics"] if same else None


def _fly(scenario: Scenario, folder: Path, compared: ErrorModel) -> SurveyStatistics:
    """Flies a rendered survey, and saves and returns its statistics; they are incomplete if the survey was aborted."""
    mission, stopwatch = prepare(scenario), Stopwatch()
    matchability = Matchability(scenario, mission.illumination, mission.terrain, mission.plan.area.at_fractions)
    conditions = survey_conditions(mission, matchability)
    if conditions["bound_px"][1] > _MAX_BOUND_PX:
        return {}
    folder.mkdir(parents=True, exist_ok=True)
    with RenderedWorld(mission, stopwatch) as world:

        def true_pose():
            return world.world_from_camera

        surrogate = surrogate_vision(mission, compared, true_pose, Stopwatch())
        vision = ComparisonVision(image_vision(mission, folder, stopwatch), surrogate, true_pose)
        with navigator_with(mission, vision, stopwatch) as navigator:
            try:
                survey.fly(mission, world, navigator, lambda *_: None)
                result = navigator.finish()
                navigator.build_map(result, mission.grid, lambda _: None)
            except SurveyAborted:
                pass
    vision.statistics |= {_CONDITION + name: list(values) for name, values in conditions.items()}
    saved = {"scenario_hash": scenario.fingerprint(), "model": repr(compared), "statistics": vision.statistics}
    (folder / _FILE).write_text(json.dumps(saved), encoding="utf-8")
    return vision.statistics
