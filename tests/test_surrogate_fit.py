"""Surrogate: the fit of its error model to surveys, and the file of the error model."""

import functools
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from twin import survey
from twin.core import geometry
from twin.core.timing import Stopwatch
from twin.errors import TwinError
from twin.scenario.file import load_scenario
from twin.session.assembly import navigator_with
from twin.surrogate import error_model_file
from twin.surrogate.error_model_file import FittedErrorModel
from twin.surrogate.height_errors import CellConditions, height_sigmas
from twin.surrogate.surrogate_world import SurrogateWorld
from twin.surrogate.vision import SurrogateVision
from twin.surrogate_fit import rendered_surveys
from twin.surrogate_fit.comparison_vision import RELIEF_GAIN, ComparisonVision, single_error_models
from twin.surrogate_fit.fit import SurveyStatistics, comparisons, fit_error_model, misfit
from twin.surrogate_fit.rendered_surveys import all_statistics, comparison_model, fit_to_surveys
from twin.world.mission import prepare

SHORT = [
    "rig.model=ideal",
    'imaging.fidelity="surrogate"',
    "plan.tracks=2",
    "plan.area_m=[2.4,1.2]",
    "control.hold_s=1.0",
]
MODEL = error_model_file.load().model
COMPARED = comparison_model(MODEL)
#: Error model of surveys to which models are fitted in these tests.
TRUE = MODEL._replace(
    efficiency=1.8, match_floor_px=0.02, flow_floor_px=0.05, stereo_relief_gain=0.7, relief_gain=0.4, lamp_growth=1.2,
    matched_share=0.7, match_half_px=0.12, match_bias_fraction=0.5, distance_growth=3.5, f2f_anticorrelation=0.4,
    mosaic_sigma_px=0.35, mosaic_error_ratio=2.0, depth_gain=3.0, depth_half_step=2.0, binned_factor=2.0,
    texture_scatter=1.0, lateral_sigma_px=0.2, relief_error_px=0.04, edge_error=0.5, edge_half_px=2.0,
    border_holes=80.0, map_half_px=0.2, survey_scatter=0.0,
)  # fmt: skip


@functools.cache
def mission(*sets):
    return prepare(load_scenario("reef", [*SHORT, *sets]))


def simulated(rng, model, level=0.0):
    """Returns statistics of a survey that follow an error model, with a scatter of 1 %.

    Args:
        level: logarithm of error / reported noise of this survey's map.
    """
    bound_px, parallax_px, lamps = 10 ** rng.uniform(-2, -0.7), rng.uniform(0, 0.06), rng.choice([0.0, 0.5, 1.0])
    n, distance, u = 4.0, np.repeat([0.1, 0.3, 0.9], 40), model.f2f_anticorrelation
    flow_px = float(model.difference_sigma_px(bound_px))
    match = model.match_sigma_px(bound_px, parallax_px) / COMPARED.match_sigma_px(bound_px, parallax_px)
    lamps2, relief2 = float(model.lamp_factor(lamps)) ** 2, (50 * distance * rng.uniform(0.2, 5)) ** 2
    growth = (1 + (model.distance_growth * distance) ** 2 / 2) / (1 + (COMPARED.distance_growth * distance) ** 2 / 2)
    by_relief = (model.relief_gain / RELIEF_GAIN) ** 2 * lamps2
    products = -0.3 * np.ones(20), 500 * np.ones(20)
    given = {
        "bound_px": bound_px, "stereo_parallax_px": parallax_px, "lamp_share": lamps,
        "match_reported_px": model.match_sigma_px(bound_px, parallax_px), "f2f_reported_px": flow_px,
        "point_fraction": model.point_fraction(bound_px), "f2f_error_px": flow_px, "f2f_interval_frames": n,
        "f2f_interval_px": flow_px * np.sqrt((1 + (n - 1) * (1 - u) ** 2) / (n * (1 + u**2))),
        "mosaic_reported_px": model.mosaic_sigma_px,
        "mosaic_error_px": model.mosaic_sigma_px * model.mosaic_error_ratio, "link_distance": distance,
        "link_nees_patches": np.ones(120), "link_nees_relief": relief2,
        "link_nees_images": match**2 * lamps2 + by_relief * relief2, "link_reported_ratio": match * np.sqrt(growth),
        "link_matched": model.point_fraction(bound_px) * model.rematched(bound_px) / COMPARED.matched_share,
        "consecutive_product_patches": products[0], "consecutive_product_relief": products[1],
        "consecutive_product_images": match**2 * lamps2 * model.match_bias_fraction / 0.8 * products[0]
        + by_relief * products[1],
    }  # fmt: skip
    exact = ("bound_px", "stereo_parallax_px", "lamp_share", "link_distance", "f2f_interval_frames")
    noise = {name: 1.0 if name in exact else np.exp(0.01 * rng.standard_normal()) for name in given}
    samples = {name: list(np.atleast_1d(value) * noise[name]) for name, value in given.items()}
    return SurveyStatistics(samples, map_classes(rng, model, bound_px, lamps, level))


def map_classes(rng, model, bound_px, lamps, level):
    rows = {"level": [], "edge": [], "known": []}
    binned = float(bound_px > 0.1)
    for views, step in ((1.0, 0.0), (2.0, 0.5), (4.0, 2.0), (9.0, 4.0), (20.0, 1.0)):
        for kind, roughness_px, edge_m, border_px in (
            ("level", 0.0, 0.0, 100.0), ("level", 0.05, 0.0, 100.0), ("edge", 0.5, 0.02, 100.0),
            ("known", 1.5, 0.0, 100.0), ("known", 0.0, 0.0, 100.0), ("known", 0.0, 0.0, 2.0),
        ):  # fmt: skip
            conditions = CellConditions(
                bound_px, 1.3 * bound_px, 0.1, roughness_px, edge_m, rng.choice([0.0, 0.02]), views, step, border_px,
                border_px / 240, 0.4, lamps, binned,
            )  # fmt: skip
            sigmas = height_sigmas(model, CellConditions(*(np.array([x]) for x in conditions)))
            total, noise = float(sigmas.total_m()[0]), float(sigmas.noise_m[0])
            values = {
                "level": [total * np.exp(level), noise, float(sigmas.scatter[0])], "edge": [total],
                "known": [float(sigmas.known[0])],
            }  # fmt: skip
            rows[kind].append([*values[kind], *conditions])
    return rows


@pytest.mark.long
def test_the_fit_recovers_the_error_model_that_surveys_follow():
    surveys = [simulated(np.random.default_rng(k), TRUE) for k in range(30)]
    fitted = fit_error_model(surveys, COMPARED)
    for name in set(TRUE._fields) - {"survey_scatter"}:
        assert getattr(fitted, name) == pytest.approx(getattr(TRUE, name), rel=0.15), name
    assert fitted.survey_scatter < 0.02
    found = misfit(surveys, fitted, COMPARED)
    assert max(found.values()) < 0.15 and found["level_error_m"] < 0.05


def test_parameters_that_no_survey_determines_keep_the_values_of_the_compared_model():
    surveys = [simulated(np.random.default_rng(k), TRUE) for k in range(4)]
    without = [s._replace(classes={"known": s.classes["known"]}) for s in surveys]
    fitted = fit_error_model(without, COMPARED)
    for name in ("edge_error", "lateral_sigma_px", "relief_error_px", "survey_scatter", "depth_gain"):
        assert getattr(fitted, name) == pytest.approx(getattr(COMPARED, name), rel=1e-3), name


@pytest.mark.long
def test_the_fit_finds_the_scatter_between_surveys():
    """40 surveys: the scatter from median absolute values has a relative standard error of about 0.2."""
    rng = np.random.default_rng(1)
    surveys = [simulated(rng, TRUE, level=0.2 * rng.standard_normal()) for _ in range(40)]
    assert fit_error_model(surveys, COMPARED).survey_scatter == pytest.approx(0.2, rel=0.4)


@pytest.mark.long
def test_a_few_gross_links_do_not_determine_the_bias_of_keyframes():
    surveys = [simulated(np.random.default_rng(k), TRUE) for k in range(20)]
    gross = surveys[0].samples | {"consecutive_product_images": [-50.0] * 3}
    biases = [
        fit_error_model(some, COMPARED).match_bias_fraction
        for some in (surveys, [*surveys, surveys[0]._replace(samples=gross)])
    ]
    assert biases[1] == pytest.approx(biases[0], rel=0.3)


@pytest.mark.parametrize(("bias_fraction", "relief_gain"), [(0.0, 0.0), (0.8, 0.0), (0.6, 10.0)])
def test_sampled_links_separate_keyframe_bias_from_relief(bias_fraction, relief_gain):
    """60 paths of eleven keyframes: the correlation has a standard error of 0.03. This reef is smooth."""
    poses, at = [tilted(0.04 * k, 0.02 * k, 2.0) for k in range(11)], [0]
    model = COMPARED._replace(match_bias_fraction=bias_fraction, relief_gain=relief_gain, lamp_growth=0.0)
    vision = SurrogateVision(mission(), model, lambda: poses[at[0]], Stopwatch())
    found = {name: [] for name in ("images", "patches", "relief")}
    for seed in range(60):
        vision._link_start["state"]["key"][0] = seed
        vision._rng = np.random.default_rng(seed)
        vision._relief_noise = np.random.default_rng([seed, 1]).standard_normal(vision._relief_noise.shape)
        for at[0], pose in enumerate(poses):
            vision.observe_stereo(None, at[0])
            vision.add_to_mosaic(at[0], pose)
        for name, one in {"images": model, **single_error_models(model)}.items():
            errors = [error_of_link(vision, k, k + 1, one) for k in range(10)]
            found[name].append(np.mean([e[3:] @ f[3:] for e, f in pairwise(errors)]))
    images, patches, relief = (np.mean(found[name]) for name in ("images", "patches", "relief"))
    predicted = bias_fraction / 0.8 * patches + (relief_gain / RELIEF_GAIN) ** 2 * relief
    assert images == pytest.approx(predicted, abs=0.25 * abs(patches) + 0.1 * abs(predicted))


def tilted(x, y, z):
    return geometry.pose(geometry.rotation_from_rpy(np.pi - 0.15, 0.1, 0.7), np.array([x, y, z]))


def error_of_link(vision, i, j, model):
    later, earlier = vision._keyframes[j], vision._keyframes[i]
    link = vision.sample_links(SimpleNamespace(number=j, yaw_rad=0.0), [SimpleNamespace(number=i)], model)[0]
    return geometry.log(geometry.inverse(geometry.inverse(earlier.pose) @ later.pose) @ link.a_from_b)


@pytest.mark.long
def test_the_fit_recovers_the_error_model_of_surveys_with_other_errors_than_the_compared_one():
    """A surrogate takes the place of the images. Bias fraction and relief gain need longer paths than these."""
    waters = [['water.jerlov="I"'], ['water.jerlov="III"'], ["lamps=[]", "sun.illuminance_lx=2000"]]
    true = TRUE._replace(matched_share=MODEL.matched_share, match_half_px=0.3, stereo_relief_gain=0.4357)
    surveys = [compare_survey(mission(*water), true, seed) for seed, water in enumerate(waters)]
    found = fit_to_surveys(surveys, COMPARED)
    fitted, bound_px = found.model, found.largest_bound_px
    assert fitted.match_sigma_px(bound_px, 0.01) == pytest.approx(true.match_sigma_px(bound_px, 0.01), rel=0.05)
    assert fitted.difference_sigma_px(bound_px) == pytest.approx(true.difference_sigma_px(bound_px), rel=0.05)
    for name, tolerance in {
        "lamp_growth": 0.3, "f2f_anticorrelation": 0.2,
        "mosaic_sigma_px": 0.05, "mosaic_error_ratio": 0.2, "distance_growth": 0.3, "texture_scatter": 0.4,
        "border_holes": 0.3,
    }.items():  # fmt: skip
        assert getattr(fitted, name) == pytest.approx(getattr(true, name), rel=tolerance), name
    for s in surveys:
        for row in comparisons(s, fitted, COMPARED):
            if row.kind in ("level_error_m", "level_reported_m"):
                assert np.median(row.predicted - row.measured) == pytest.approx(0.0, abs=0.2), row.kind


class SimulatedImages:
    """Surrogate in place of vision by images: each stereo point has the covariance of a single match."""

    def __init__(self, vision):
        self._vision, self.binning = vision, vision.matchability.binning

    def __getattr__(self, name):
        return getattr(self._vision, name)

    def observe_stereo(self, frame, row):
        points, latest = self._vision.observe_stereo(frame, row), self._vision.latest
        return points._replace(cov=points.cov * latest.n_points / len(latest.points))


def compare_survey(flown, true, seed):
    """Returns the statistics of a survey whose measurements are sampled from the error model `true`."""
    world = SurrogateWorld(flown, Stopwatch(), FittedErrorModel(true, 2, 1.0, {}))

    def true_pose():
        return world.world_from_camera

    world.vision._rng, world.vision._link_start["state"]["key"][0] = np.random.default_rng(100 + seed), seed
    compared = SurrogateVision(flown, COMPARED, true_pose, Stopwatch())
    vision = ComparisonVision(SimulatedImages(world.vision), compared, true_pose)
    navigator = navigator_with(flown, vision, Stopwatch())
    survey.fly(flown, world, navigator, lambda *_: None)
    result = navigator.finish()
    vision.build_map(result, flown.grid, np.zeros((len(result.keyframe_rows), 6, 6)), lambda _: None)
    return SurveyStatistics(vision.statistics, vision.classes)


@pytest.mark.parametrize("jobs", [1, 3])
def test_the_statistics_of_surveys_come_in_their_order(jobs, monkeypatch):
    """With threads in place of processes; the first surveys take longest."""
    monkeypatch.setattr(rendered_surveys, "ProcessPoolExecutor", lambda n, mp_context: ThreadPoolExecutor(n))
    monkeypatch.setattr(rendered_surveys, "get_context", lambda method: None)

    def statistics(scenario, folder, compared):
        time.sleep(0.05 / (1 + scenario))
        return {"value": [scenario], "folder": [folder], "compared": [compared]}

    monkeypatch.setattr(rendered_surveys, "survey_statistics", statistics)
    found = list(all_statistics([(k, f"run{k}") for k in range(6)], "model", jobs))
    assert found == [{"value": [k], "folder": [f"run{k}"], "compared": ["model"]} for k in range(6)]


def test_a_survey_in_water_without_matches_is_not_flown(tmp_path):
    scenario = load_scenario("reef", ['water.jerlov="9C"', "water.turbidity=4", "plan.tracks=1"])
    assert rendered_surveys.survey_statistics(scenario, tmp_path / "run", MODEL) == SurveyStatistics({}, {})
    assert not (tmp_path / "run").exists()


def test_a_saved_file_of_another_kind_is_replaced(tmp_path, monkeypatch):
    monkeypatch.setattr(rendered_surveys, "_flown", lambda *_: SurveyStatistics({"noise": [1.0]}, {}))
    scenario = load_scenario("reef", ["plan.tracks=1"])
    for text in ("[]", "3", "not JSON"):
        (tmp_path / "surrogate_comparison.json").write_text(text)
        assert rendered_surveys.survey_statistics(scenario, tmp_path, MODEL).samples == {"noise": [1.0]}


@pytest.mark.parametrize(("lost_px", "limit_px"), [(0.3, np.inf), (0.05, 0.1)])
def test_the_bound_is_unlimited_if_the_most_turbid_survey_of_the_fit_was_lost(lost_px, limit_px):
    complete, lost = (SurveyStatistics({"condition_bound_px": [px, px]}, {}) for px in (0.1, lost_px))
    assert rendered_surveys._fitted_range([complete], [lost])["bound_px"] == (0.1, limit_px)


@pytest.mark.parametrize(("frames", "links", "is_lost"), [(0.1, 0.1, False), (0.3, 0.0, True), (0.0, 0.3, True)])
def test_a_survey_is_lost_if_many_frames_or_links_fail(frames, links, is_lost):
    flags = {name: [1.0] * round(10 * share) + [0.0] * round(10 - 10 * share) for name, share in
             (("frame_lost", frames), ("link_failed", links))}  # fmt: skip
    assert rendered_surveys._is_lost(SurveyStatistics(flags, {})) == is_lost


def test_every_point_is_matched_in_the_model_with_which_images_are_compared():
    """Otherwise there are no statistics where the surrogate loses vision and the images do not."""
    assert COMPARED.point_fraction(1.0) == pytest.approx(MODEL.matched_share)
    assert COMPARED.rematched(1.0) == pytest.approx(1.0)


def test_an_error_model_has_at_most_25_numbers_and_is_loaded_as_it_was_saved(tmp_path):
    assert len(MODEL) <= 25
    model = MODEL._replace(efficiency=1.031, f2f_anticorrelation=0.123)
    unlimited = FittedErrorModel(model, 7, 0.12, {"match_reported_px": 0.1}, {"bound_px": (0.01, np.inf)})
    for fitted in (unlimited, FittedErrorModel(model, 7, 0.12, {"match_reported_px": 0.1})):
        error_model_file.save(fitted, tmp_path / "model.toml")
        assert error_model_file.load(tmp_path / "model.toml") == fitted
    assert not unlimited.quantities_outside_fit({"bound_px": (1e5, 1e5)})
    assert fitted.quantities_outside_fit({"bound_px": (1e5, 1e5)})


def test_a_file_that_is_not_an_error_model_is_rejected(tmp_path):
    (tmp_path / "other.toml").write_text("n_surveys = 3\n")
    with pytest.raises(TwinError, match="imaging.error_model.*twin fit-surrogate"):
        error_model_file.load(tmp_path / "other.toml")
