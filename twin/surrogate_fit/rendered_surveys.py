"""Flies rendered surveys, compares their image measurements with the surrogate's, and fits the error model."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from twin import survey
from twin.core.timing import Stopwatch
from twin.errors import SurveyAborted, TwinError
from twin.scenario.model import Scenario
from twin.session.assembly import image_vision, navigator_with
from twin.surrogate.coverage import QUANTITIES, Range, survey_conditions
from twin.surrogate.error_model import ErrorModel
from twin.surrogate.error_model_file import FittedErrorModel
from twin.surrogate.surrogate_world import surrogate_vision
from twin.surrogate_fit.comparison import ComparisonVision
from twin.surrogate_fit.fit import SurveyStatistics, fit_error_model, log_misfit
from twin.world.mission import prepare
from twin.world.rendered_world import RenderedWorld

_FILE = "surrogate_comparison.json"
_MIN_SURVEYS = 2
_CONDITION = "condition_"  # prefix of the names of the conditions in the statistics


def fit_to_surveys(surveys: Sequence[SurveyStatistics], compared: ErrorModel) -> FittedErrorModel:
    """Returns the error model fitted to rendered surveys.

    Args:
        surveys: statistics of each survey; surveys without link or map statistics, e.g. aborted ones, are ignored.
        compared: error model of the surrogate with which the surveys were compared.

    Raises:
        TwinError: fewer than two surveys have complete statistics.
    """
    complete = [s for s in surveys if "consecutive_product_images" in s and _has_map(s)]
    if len(complete) < _MIN_SURVEYS:
        raise TwinError("fit-surrogate", f"{len(complete)} surveys are complete", f"at least {_MIN_SURVEYS}")
    fitted = fit_error_model(complete, compared)
    return FittedErrorModel(fitted, len(complete), log_misfit(complete, compared, fitted), _fitted_range(complete))


def _fitted_range(surveys: Sequence[SurveyStatistics]) -> dict[str, Range]:
    """Returns the smallest and the largest value of each condition of the surveys, by name of `QUANTITIES`."""
    values = {name: [x for s in surveys for x in s.get(_CONDITION + name, ())] for name in QUANTITIES}
    return {name: (min(found), max(found)) for name, found in values.items() if found}


def _has_map(statistics: SurveyStatistics) -> bool:
    """Returns whether the statistics include errors of level cells of the map."""
    return any(f"map_error_{name}_images" in statistics for name in ("few", "many"))


def survey_statistics(scenario: Scenario, folder: Path, compared: ErrorModel) -> SurveyStatistics:
    """Returns the statistics of a rendered survey's comparison with the surrogate.

    Reads them from the folder if they were saved there for the same scenario and error model, else flies the survey.

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
    conditions = survey_conditions(mission, surrogate.scene.matchability)
    vision.statistics |= {_CONDITION + name: list(values) for name, values in conditions.items()}
    saved = {"scenario_hash": scenario.fingerprint(), "model": repr(compared), "statistics": vision.statistics}
    (folder / _FILE).write_text(json.dumps(saved), encoding="utf-8")
    return vision.statistics
