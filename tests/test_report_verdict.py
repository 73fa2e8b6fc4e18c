"""First lines and badge of a report: each limit of a survey is a sentence on the page, console and recording."""

import copy
import functools
import json
import re

import pytest
from judge_synthetic import evaluated, survey, write_folder

from twin.app import console
from twin.judge.metrics import EvaluationInput, evaluate, unevaluated
from twin.judge.verdict import NEES_BOUNDS, metric_warnings, nees_bounds
from twin.report import headline, number_formats
from twin.report.headline import badge, first_lines
from twin.report.run_folder import load_run
from twin.report.survey_page import write_report
from twin.scenario.file import load_scenario
from twin.scenario.idealisations import idealisations


@functools.cache
def good():
    """Returns the metrics of a good survey."""
    metrics = evaluated(*survey())
    metrics["consistency"]["nees_position_mean"], metrics["map"]["sigma_ratio"], metrics["reason"] = 3.0, 1.0, ""
    metrics |= {"warnings": metric_warnings(metrics)}
    return metrics | {"warning": " ".join(metrics["warnings"])}


def changed(**changes):
    """Returns the metrics of a good survey with changes; a dictionary changes single entries of its section."""
    metrics = copy.deepcopy(good())
    for key, value in changes.items():
        metrics[key] = metrics[key] | value if isinstance(value, dict) else value
    return metrics | {"warnings": [*changes.get("warnings", ()), *metric_warnings(metrics)]}


def missed(name="map.le90_area_m", value=None, limit=0.02):
    return {"require": {name: {"value": value, "limit": limit, "passed": False}}}


#: Changes of the metrics of a good survey; text and level of the badge; sentences.
CASES = {
    "good": (dict(), "complete", "good", []),
    "aborted": (
        dict(status="aborted", reason="vision lost at 3.0 s"),
        "aborted", "bad", ["The survey was aborted: vision lost at 3.0 s."],
    ),
    "degraded": (
        dict(status="degraded", reason="the row residuals are 3 px"),
        "degraded", "bad", ["The survey is degraded: the row residuals are 3 px."],
    ),
    "aborted and missed": (
        dict(status="aborted", reason="interrupted; map skipped", **missed("map.completeness_area", None, 0.9)),
        "aborted, requirement missed", "bad",
        ["The survey was aborted: interrupted; map skipped.",
         "Requirement missed: mapped part of the asked area is unknown, at least 90 % is required."],
    ),
    "missed": (
        dict(**missed("map.le90_m", 0.031)), "complete, requirement missed", "bad",
        ["Requirement missed: height error on 90 % of the mapped cells (LE90) is 0.031 m, at most 0.02 m is required."],
    ),
    "holes": (
        dict(map={"completeness_area": 0.81, "le90_area_m": None}, **missed()),
        "complete, requirement missed", "bad",
        ["Requirement missed: height error on 90 % of the asked area (LE90) is infinite (only 81 % of the asked area "
         "has a height), at most 0.02 m is required."],
    ),
    "NEES": (
        dict(consistency={"nees_position_mean": 8.71}), "complete, with warnings", "warn",
        ["The position covariances are too small: the mean NEES is 8.71, where 3 is expected and 2 to 5 accepted."],
    ),
    "sigma": (
        dict(map={"sigma_ratio": 0.41}), "complete, with warnings", "warn",
        ["The sigmas of the map are too large: the RMS of error / sigma is 0.41, where 1 is expected and 0.5 to 2 "
         "accepted."],
    ),
    "saturation": (
        dict(vision={"saturated_median": 0.123}), "complete, with warnings", "warn",
        ["The images are saturated: the median share of saturated values is 12.3 % (more than 1 %)."],
    ),
    "surrogate": (
        dict(warnings=["The surrogate extrapolates: too murky."]), "complete, with warnings", "warn",
        ["The surrogate extrapolates: too murky."],
    ),
    "ideal": (
        dict(idealisations=["The cameras are ideal: no port."]), "complete", "good",
        ["The cameras are ideal: no port."],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_sentences_and_badge_follow_from_the_metrics(case):
    changes, text, level, sentences = CASES[case]
    metrics = changed(**changes)
    assert first_lines(metrics) == sentences
    assert badge(metrics) == (text, level)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_folder(tmp_path_factory.mktemp("verdict") / "run")


@pytest.mark.parametrize("case", ["good", "degraded", "holes", "surrogate"])
def test_the_report_starts_with_the_badge_and_the_sentences(folder, monkeypatch, case):
    monkeypatch.setattr("twin.report.survey_page.draw_all", lambda *_: dict.fromkeys(FIGURES))
    changes, text, level, sentences = CASES[case]
    page = write_report(folder, changed(**changes)).read_text()
    header = page[page.index("<header>") : page.index("</header>")]
    assert f'<span class="badge {level}">{text}</span>' in header
    assert re.findall("<li>(.*)</li>", header) == sentences
    style = page[: page.index("</style>")]
    assert f".badge.{level} {{ color: var(--{level}" in style or level == "good"


FIGURES = (
    "plan_view path_errors stereo_quality coverage mosaic elevation sections error network".split()
)  # fmt: skip


@pytest.mark.parametrize("case", ["good", "aborted", "degraded", "holes", "surrogate"])
def test_the_console_starts_with_the_badge_and_the_sentences(capsys, case):
    changes, text, _, sentences = CASES[case]
    console.print_metrics(changed(**changes))
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == f"synthetic, seed 7: {text}"
    assert printed[1 : 1 + len(sentences)] == [f"- {sentence}" for sentence in sentences]


def test_the_recording_contains_the_sentences(folder, monkeypatch):
    from twin.report import recording

    logged = {}

    class Log:
        def log(self, path, entity, **_):
            logged[path] = entity

    changes, text, _, sentences = CASES["degraded"]
    metrics = changed(**changes)
    run = load_run(folder, metrics)
    recording.log_scene(Log(), run)
    summary = logged["summary"].text.as_arrow_array()[0].as_py()
    assert summary.startswith(f"# synthetic: {text}\n\n- {sentences[0]}\n")


def test_an_unfinished_run_has_a_red_badge():
    assert badge(None) == ("unfinished", "bad")


def test_metrics_of_older_runs_keep_their_warning():
    older = {key: value for key, value in good().items() if key not in ("warnings", "idealisations")}
    older["map"] = {key: value for key, value in good()["map"].items() if not key.endswith(("area", "area_m"))}
    older["warning"] = "surrogate: too murky"
    assert first_lines(older) == ["surrogate: too murky"] and badge(older).level == "warn"
    assert headline.headline(older, {}) and headline.key_figures(older)


def test_the_summary_says_how_well_the_scale_of_the_heights_was_tested():
    tested = changed(self_check={"depth_scale": 0.98, "depth_scale_sigma": 0.0074})
    untested = changed(self_check={"depth_scale": None, "depth_scale_sigma": None})
    assert "tested the scale along the optical axis to 0.7 %: below that" in headline.headline(tested, {})
    assert "No reading tested the scale" in headline.headline(untested, {})


def test_the_sentence_on_the_observed_floor_names_the_map_where_no_area_was_asked_for():
    asked, observed = good(), changed(map={"completeness_area": None})
    assert " of the asked area; " in headline.headline(asked, {}) and " It covers " in headline.headline(asked, {})
    assert " The map covers " in headline.headline(observed, {}) and " It covers " not in headline.headline(
        observed, {}
    )


def test_a_replay_lists_only_figures_that_it_has():
    metrics = changed(map=dict.fromkeys(good()["map"])) | {"replay": {"dataset": "euroc"}}
    labels = [figure.label for figure in headline.key_figures(metrics)]
    assert "Position error, final" in labels and not [label for label in labels if label.startswith("Map")]


def test_the_altitude_of_a_plan_is_given_above_what_it_refers_to():
    plane, floor = (
        headline.conditions({"plan": {"altitude_m": 2.0, "height": height}}) for height in ("plane", "floor")
    )
    assert plane.startswith("2 m above the reference plane") and floor.startswith("2 m above the smoothed floor")


def test_an_unfinished_replay_has_no_conditions():
    assert headline.headline(None, {"replay": {}}) == "This replay is unfinished: it has no metrics.json."


def test_every_map_statistic_is_reported_with_completeness():
    metrics = changed(map={"completeness": 0.876, "completeness_area": 0.765})
    for figure in headline.key_figures(metrics):
        if figure.label.startswith(("Map", "Sigma")):
            assert "87.6 %" in figure.meaning or "76.5 %" in figure.meaning, figure.label
    for sentence in headline.headline(metrics, {}).split(". "):
        if "LE90" in sentence:
            assert "87.6 %" in sentence or "76.5 %" in sentence


def test_a_map_with_too_many_holes_has_an_infinite_le90_in_the_text():
    metrics = changed(map={"completeness_area": 0.5, "le90_area_m": None})
    assert "LE90 of its heights over this area is infinite" in headline.headline(metrics, {})
    assert number_formats.area_le90({"completeness_area": None, "le90_area_m": None}) == number_formats.DASH


@pytest.mark.parametrize(
    ("value", "n"), [(1.99, 1), (2.0, 0), (5.0, 0), (5.01, 1), (None, 0)]
)  # fmt: skip
def test_the_bounds_of_nees_are_two_and_five(value, n):
    assert len(changed(consistency={"nees_position_mean": value})["warnings"]) == n


@pytest.mark.parametrize(("value", "n"), [(0.5, 1), (0.7, 0), (7.5, 0), (7.7, 1)])
def test_nees_is_accepted_up_to_what_few_independent_errors_allow(value, n):
    expected = {"nees_position_mean": value, "nees_position_low": 0.64, "nees_position_high": 7.6}
    assert len(changed(consistency=expected)["warnings"]) == n


def test_many_independent_errors_do_not_narrow_the_bounds_of_nees():
    assert nees_bounds({"nees_position_low": 2.9, "nees_position_high": 3.1}) == NEES_BOUNDS


@pytest.mark.parametrize(("value", "n"), [(0.49, 1), (0.5, 0), (2.0, 0), (2.01, 1), (None, 0)])
def test_the_bounds_of_the_sigma_ratio_are_a_half_and_two(value, n):
    assert len(changed(map={"sigma_ratio": value})["warnings"]) == n


def test_the_metrics_join_all_warnings():
    result, elevation, truth, rig = survey()
    metrics = evaluate(EvaluationInput(result, elevation, truth, rig, warnings=["One."], idealisations=["Two."]))
    assert metrics["warnings"][0] == "One." and metrics["warning"] == " ".join(metrics["warnings"])
    assert metrics["idealisations"] == ["Two."]


def test_metrics_that_were_not_evaluated_have_the_same_keys_and_meet_no_requirement():
    result, elevation, truth, rig = survey()
    identity = {"name": "one", "seed": 3, "status": "aborted", "reason": "interrupted; evaluation skipped"}
    given = EvaluationInput(result, elevation, truth, rig, identity=identity, require={"map.le90_m": 1.0})
    empty, whole = unevaluated(given), evaluate(given)
    assert list(empty) == list(whole)
    assert {key: empty[key] for key in identity} == identity
    assert empty["timing"] == whole["timing"] and empty["map"]["le90_m"] is None
    assert empty["require"]["map.le90_m"] == {"value": None, "limit": 1.0, "passed": False}
    json.dumps(empty, allow_nan=False)


IDEAL = load_scenario("reef", ["rig.model=ideal", "imaging.shadows=false"])
REAL = [
    "rig.model=ideal", "calibration_error.baseline_error=0.01", 'port.kind="flat"', "sensor.motion_blur=true",
    "snow.density_per_m3=10", "current.gust_mps=0.05", "current.velocity_mps=[0.1, 0.0, 0.0]",
    "waves.height_m=0.2", "waves.depth_m=10",
]  # fmt: skip


def test_a_scenario_with_ideal_cameras_names_what_it_idealises():
    assert idealisations(IDEAL) == [
        "The cameras are ideal: no calibration error, no port, no motion blur.",
        "The water is ideal: no marine snow, no current, no waves.",
        "The light is ideal: no shadows of the lamps.",
    ]


def test_a_scenario_with_every_effect_idealises_nothing():
    assert idealisations(load_scenario("reef", REAL)) == []


@pytest.mark.parametrize("key", ["absorption", "scattering"])
def test_water_whose_given_coefficients_are_zero_is_ideal(key):
    given = {"absorption": "[0.1,0.1,0.1]", "scattering": "[0.1,0.1,0.1]", key: "[0,0,0]"}
    values = [f"water.{name}_per_m={value}" for name, value in given.items()]
    assert idealisations(load_scenario("reef", [*REAL, *values])) == [f"The water is ideal: no {key}."]


@pytest.mark.parametrize("override", [*REAL[1:6], "waves.height_m=0.2"])
def test_each_effect_removes_its_own_phrase(override):
    without = idealisations(load_scenario("reef", [other for other in REAL if other != override]))
    assert len(without) == 1 and without[0].count("no ") == 1


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ('water.jerlov="clear"', "The water is ideal: no absorption, no scattering."),
        ("water.turbidity=0", "The water is ideal: no scattering."),
        (
            'imaging.fidelity="surrogate"',
            "No images were rendered: visual measurements are sampled",
        ),
        ("sun.illuminance_lx=1000", "The light is ideal: no caustics."),
        ("map.restore=true", "The restored colours are ideal: no error of water, lamps, vignetting and exposure."),
    ],
)
def test_further_idealisations_are_named(override, sentence):
    (found,) = idealisations(load_scenario("reef", [*REAL, override]))
    assert found.startswith(sentence)


@pytest.mark.parametrize("override", ['imaging.fidelity="surrogate"', "map.orthomosaic=false"])
def test_without_an_orthomosaic_of_images_no_colours_are_restored(override):
    found = idealisations(load_scenario("quickstart", [*REAL, "map.restore=true", override]))
    assert not any("restored" in sentence for sentence in found)


def test_a_kinematic_vehicle_is_ideal():
    calm = [override for override in REAL if not override.startswith(("current", "waves"))]
    found = idealisations(load_scenario("reef", [*calm, 'vehicle.dynamics="kinematic"']))
    assert found == ["The water is ideal: no current, no waves.", "The vehicle is ideal: no forces, no inertia."]


def test_an_area_without_the_centre_of_a_cell_is_named():
    empty = changed(map={"completeness_area": None, "le90_area_m": None})
    meaning = {figure.label: figure.meaning for figure in headline.key_figures(empty)}["Map LE90, asked area"]
    assert meaning == "the asked area contains no cell centre"
