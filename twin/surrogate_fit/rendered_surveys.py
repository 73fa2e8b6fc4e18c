"""Flies rendered surveys, compares their image measurements with the surrogate's, and fits the error model."""

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from twin import survey
from twin.core.timing import Stopwatch
from twin.core.user_files import read_json
from twin.errors import SurveyAborted, TwinError
from twin.scenario.model import Scenario
from twin.session.assembly import image_vision, navigator_with
from twin.surrogate.coverage import QUANTITIES, Range, survey_conditions
from twin.surrogate.error_model import ErrorModel
from twin.surrogate.error_model_file import FittedErrorModel
from twin.surrogate.matchability import Matchability
from twin.surrogate.vision import SurrogateVision
from twin.surrogate_fit.comparison_vision import ComparisonVision
from twin.surrogate_fit.fit import SurveyStatistics, fit_error_model, misfit
from twin.world.mission import prepare
from twin.world.rendered_world import RenderedWorld

_FILE = "surrogate_comparison.json"
_MIN_SURVEYS = 2
_MAX_LOST = 0.2  # largest fraction of lost frames, and of failed links, of a survey to which the model is fitted
#: Cramér-Rao bound [px] above which no survey is flown: at 0.17 px, 86 % of the frames were lost.
_MAX_BOUND_PX = 0.5
_NEVER_PX = 1e3  # Cramér-Rao bound that no survey has
_BOUND = "bound_px"
_CONDITION = "condition_"  # prefix of the names of the conditions in the statistics
#: Statistics of a complete survey.
_NEEDED = ("consecutive_product_images", "mosaic_error_px", "f2f_interval_px", "match_reported_px")


def fit_to_surveys(surveys: Sequence[SurveyStatistics], compared: ErrorModel) -> FittedErrorModel:
    """Returns the error model fitted to complete rendered surveys; raises TwinError if fewer than two are."""
    # lost surveys may remove the upper limit of the range of the Cramér-Rao bound
    complete = [s for s in surveys if _is_complete(s)]
    if len(complete) < _MIN_SURVEYS:
        raise TwinError("fit-surrogate", f"{len(complete)} surveys are complete", f"at least {_MIN_SURVEYS}")
    fitted = fit_error_model(complete, compared)
    ranges = _fitted_range(complete, [s for s in surveys if _is_lost(s)])
    largest_px = max(s.median(_BOUND) for s in complete)
    return FittedErrorModel(fitted, len(complete), largest_px, misfit(complete, fitted, compared), ranges)


def comparison_model(model: ErrorModel) -> ErrorModel:
    """Returns an error model that matches every point, to compare images in turbid water with the surrogate."""
    return model._replace(match_half_px=_NEVER_PX)


def _fitted_range(complete: Sequence[SurveyStatistics], lost: Sequence[SurveyStatistics]) -> dict[str, Range]:
    values = {name: [x for s in complete for x in s.samples.get(_CONDITION + name, ())] for name in QUANTITIES}
    ranges = {name: (min(found), max(found)) for name, found in values.items() if found}
    lost_px = [x for s in lost for x in s.samples.get(_CONDITION + _BOUND, ())]
    if _BOUND in ranges and max(lost_px, default=0.0) > ranges[_BOUND][1]:
        ranges[_BOUND] = (ranges[_BOUND][0], np.inf)
    return ranges


def _is_complete(statistics: SurveyStatistics) -> bool:
    """Returns whether a survey has links and a map, is not lost, and has the same pixels as the surrogate."""
    if not all(name in statistics.samples for name in _NEEDED) or "known" not in statistics.classes:
        return False
    images, surrogate = statistics.samples["binning"]
    return images == surrogate and not _is_lost(statistics)


def _is_lost(statistics: SurveyStatistics) -> bool:
    """Returns whether a survey lost more than 20 % of its frames or of its links."""
    samples = statistics.samples
    return any(float(np.mean(samples.get(name, 0.0))) > _MAX_LOST for name in ("frame_lost", "link_failed"))


def all_statistics(
    surveys: Sequence[tuple[Scenario, Path]], compared: ErrorModel, jobs: int = 1
) -> Iterator[SurveyStatistics]:
    """Yields the `survey_statistics` of scenarios with their folders, in `jobs` processes."""
    scenarios, folders = [scenario for scenario, _ in surveys], [folder for _, folder in surveys]
    one = partial(survey_statistics, compared=compared)
    if jobs == 1:
        yield from map(one, scenarios, folders)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        yield from pool.map(one, scenarios, folders)


def survey_statistics(scenario: Scenario, folder: Path, compared: ErrorModel) -> SurveyStatistics:
    """Returns the statistics of a rendered survey's comparison with the surrogate; flies it unless they are saved."""
    # none where the Cramér-Rao bound exceeds `_MAX_BOUND_PX`; raises ScenarioError if the survey cannot be flown
    identity = {"scenario_hash": scenario.fingerprint(), "model": repr(compared)}
    with suppress(TwinError):
        saved = read_json(folder / _FILE)
        if isinstance(saved, dict) and saved | identity == saved:
            return SurveyStatistics(*saved["statistics"])
    statistics = _flown(scenario, folder, compared)
    if statistics.samples:
        (folder / _FILE).write_text(json.dumps(identity | {"statistics": statistics}), encoding="utf-8")
    return statistics


def _flown(scenario: Scenario, folder: Path, compared: ErrorModel) -> SurveyStatistics:
    mission, stopwatch = prepare(scenario), Stopwatch()
    matchability = Matchability(scenario, mission.illumination, mission.terrain, mission.plan.area.at_fractions)
    conditions = survey_conditions(mission, matchability)
    if conditions[_BOUND][1] > _MAX_BOUND_PX:
        return SurveyStatistics({}, {})
    folder.mkdir(parents=True, exist_ok=True)
    with RenderedWorld(mission, stopwatch) as world:

        def true_pose():
            return world.world_from_camera

        surrogate = SurrogateVision(mission, compared, true_pose, Stopwatch())
        vision = ComparisonVision(image_vision(mission, folder, stopwatch), surrogate, true_pose)
        with navigator_with(mission, vision, stopwatch) as navigator:
            with suppress(SurveyAborted):
                survey.fly(mission, world, navigator, lambda *_: None)
                navigator.build_map(navigator.finish(), mission.grid, lambda _: None)
    samples = vision.statistics | {_CONDITION + name: list(values) for name, values in conditions.items()}
    return SurveyStatistics(samples, vision.classes)
