"""Findings about the planned path and the asked area, and the aborts while a survey is flown."""

import functools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from twin.core import geometry
from twin.core.links import Link, Links
from twin.core.quality import EpipolarError, EstimationQuality, Finding
from twin.core.records import ElevationMap, Estimate, Frame, SurveyResult, Trajectory
from twin.core.timing import Stopwatch
from twin.errors import SurveyAborted
from twin.estimate.alignment import _mean_chi2
from twin.estimate.stereo_vision import StereoVision
from twin.scenario.file import load_scenario
from twin.session.assembly import make_navigator
from twin.session.conclusion import status
from twin.session.flown_survey import plugin_notes
from twin.session.monitor import SurveyMonitor
from twin.session.survey_check import (
    calibration_notes,
    off_course_limit_m,
    survey_findings,
    with_altimeter_scale,
)
from twin.world.mission import prepare


@functools.cache
def mission(*overrides):
    return prepare(load_scenario("reef", ["imaging.fidelity=surrogate", "plan.tracks=1", *overrides]))


def result_at(positions):
    """Returns a result without keyframes whose path consists of these positions (n, 3)."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions
    path = Trajectory(np.arange(len(positions)) / 30.0, poses)
    none = np.zeros(0, np.int64)
    return SurveyResult(path, path, path, none, none, np.zeros((0, 6, 6)))


def elevation(fraction):
    """Returns a map in which this fraction of the columns of the asked area has heights."""
    grid = mission().grid
    x, y = np.meshgrid(*grid.centres())
    asked = mission().plan.inside_area(x, y)
    columns = np.flatnonzero(asked.any(axis=0))
    height = np.zeros((grid.rows, grid.cols), np.float32)
    height[:, columns[round(fraction * len(columns)) :]] = np.nan
    return ElevationMap(grid, height, np.ones_like(height), np.zeros((*height.shape, 3), np.uint8))


def checks(result, heights, reference):
    return [finding.check for finding in survey_findings(mission(), result, heights, reference)]


def test_plugins_of_the_same_name_have_a_note_each():
    scenario = load_scenario(
        "reef", ["control.plugin=other:Package", "estimate.plugin=other:Package"], allow_plugins=True
    )
    assert [note.split(" by ")[0].split(" of ")[0] for note in plugin_notes(scenario)] == [
        "The vehicle was steered", "The trajectories are those"
    ]  # fmt: skip


def test_a_survey_on_its_path_that_maps_the_area_has_no_findings():
    path = np.zeros((90, 3))
    assert checks(result_at(path), elevation(0.95), path) == []


def test_an_area_without_a_cell_centre_is_not_checked():
    tiny, path = mission("plan.area_m=[0.01, 0.01]"), np.zeros((90, 3))
    height = np.zeros((tiny.grid.rows, tiny.grid.cols), np.float32)
    heights = ElevationMap(tiny.grid, height, np.ones_like(height), np.zeros((*height.shape, 3), np.uint8))
    assert survey_findings(tiny, result_at(path), heights, path) == []


def test_an_area_with_a_tenth_missing_is_a_finding():
    path = np.zeros((90, 3))
    assert checks(result_at(path), elevation(0.85), path) == ["area_mapped"]
    assert checks(result_at(path), None, path) == ["area_mapped"]


def test_only_a_lasting_departure_from_the_path_is_a_finding():
    limit_m = off_course_limit_m(mission())
    assert limit_m == pytest.approx(0.25 * min(mission().plan.request.footprint_m))
    for n_frames, expected in ((20, []), (40, ["off_course"])):
        path = np.zeros((90, 3))
        path[30 : 30 + n_frames, 1] = 1.1 * limit_m
        assert checks(result_at(path), elevation(1.0), np.zeros((90, 3))) == expected
    assert off_course_limit_m(mission("control.off_course_m=0.02")) == 0.02


@pytest.mark.parametrize("gradient", [0.0, 0.3])
def test_the_altimeter_gives_the_scale_of_depths(gradient):
    """Oracle: a plane of gradient g at the distance h below is h / (cos a + g sin a) away within half a beam a."""
    flown, half = mission("navigation.altimeter_beam_deg=8"), np.deg2rad(4)
    x, y = np.meshgrid(*flown.grid.centres())
    height_m = (gradient * x).astype(np.float32)
    heights = ElevationMap(flown.grid, height_m, np.ones_like(height_m), np.zeros((*height_m.shape, 3), np.uint8))
    positions = np.array([[-0.5, 0.0, 2.0], [0.0, 0.1, 2.2], [0.4, 0.0, 2.1]])
    poses = np.array([geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, p) for p in positions])
    path, angle = Trajectory(np.arange(3.0), poses), min(half, np.arctan(gradient))
    true_m = (positions[:, 2] - gradient * positions[:, 0]) / (np.cos(angle) + gradient * np.sin(angle))
    true_m *= 1 + 0.003 * np.array([1.0, -1.0, 0.0])

    def found(scale):
        quality = EstimationQuality(altimeter_m=dict(enumerate(true_m / scale)))
        result = replace(result_at(positions), final=path, quality=quality)
        return with_altimeter_scale(flown, result, heights).quality.depth_scale

    for scale in (1.03, 0.97):
        by_altimeter = found(scale)
        assert by_altimeter.estimate == pytest.approx(scale, abs=1e-3) and by_altimeter.sensors == "the altimeter"
        assert by_altimeter.sigma == pytest.approx(0.003 / 3**0.5 * scale, rel=0.02)


def test_without_readings_or_a_map_the_altimeter_gives_no_scale():
    read, path = EstimationQuality(altimeter_m={0: 2.0, 1: 2.0}), np.zeros((2, 3))
    result = replace(result_at(path), quality=read)
    assert with_altimeter_scale(mission(), result, None) is result
    assert with_altimeter_scale(mission(), result, elevation(0.0)) is result
    unread = result_at(path)
    assert with_altimeter_scale(mission(), unread, elevation(1.0)) is unread


def test_removed_rectification_errors_are_reported():
    error = EpipolarError(np.array([1e-3, 0, 0, 0]), np.full(4, 1e-5), np.array([1e-3, 0, 0, 2e-3]))
    result = replace(result_at(np.zeros((1, 3))), quality=EstimationQuality(epipolar=error))
    rig = mission().rig
    (note,) = calibration_notes(result, rig)
    assert "pitch of +0.057 deg" in note and f"{2e-3 * rig.focal_px:+.2f} px" in note
    rotated = replace(result, quality=EstimationQuality(epipolar=error._replace(removed=np.array([1e-3, 0, 0, 0]))))
    stated, exact = replace(rig, yaw_sigma_rad=4e-4), replace(rig, yaw_sigma_rad=0.0)
    assert calibration_notes(rotated, stated) == [] and len(calibration_notes(rotated, exact)) == 1
    assert len(calibration_notes(rotated, replace(rig, yaw_sigma_rad=3e-4))) == 1
    assert len(calibration_notes(result, stated)) == 1
    untouched = replace(result, quality=EstimationQuality(epipolar=error._replace(removed=np.zeros(4))))
    assert calibration_notes(untouched, mission().rig) == []


def test_a_survey_whose_position_is_lost_is_aborted():
    monitor = SurveyMonitor(mission(), SimpleNamespace(log=lambda *_, **__: None), lambda _: None)
    frame = Frame(0, 0.0, np.zeros((2, 2, 3), np.uint8), None)
    half_m = 0.5 * min(mission().plan.request.footprint_m)

    def estimate(sigma_m):
        return Estimate(1.0, np.eye(4), np.eye(4), np.zeros(6), sigma_m, "ok")

    monitor(estimate(0.9 * half_m), frame)
    with pytest.raises(SurveyAborted, match="standard deviation of the position"):
        monitor(estimate(1.1 * half_m), frame)


def test_a_survey_without_vision_is_aborted_after_it_has_held_station():
    frame = Frame(0, 0.0, np.zeros((2, 2, 3), np.uint8), None)
    lost, ok = (Estimate(1.0, np.eye(4), np.eye(4), np.zeros(6), 0.0, status) for status in ("lost", "ok"))
    second = round(mission().rig.frame_rate_hz)

    def fly(estimates):
        events = []
        log = SimpleNamespace(log=lambda event, **fields: events.append((event, fields.get("action"))))
        monitor = SurveyMonitor(mission(), log, lambda _: None)
        for estimate in estimates:
            monitor(estimate, frame)
            monitor.actions(estimate)
        return events

    assert ("action", "hold") in fly([lost] * (5 * second))
    with pytest.raises(SurveyAborted, match="vision lost at"):
        fly([lost] * (7 * second))
    with pytest.raises(SurveyAborted, match="stopped for 60 s in total"):
        fly(([lost] * (5 * second) + [ok] * second) * 15)
    with pytest.raises(SurveyAborted, match="vision lost at"):  # a few frames match by chance
        fly(([lost] * second + [ok]) * 7)


def test_findings_degrade_a_survey_and_an_abort_outranks_them():
    finding = Finding("points", 20.0, 60.0, "one stereo pair in ten has 20 matched points or fewer")
    expected = {("", ()): "complete", ("", (finding,)): "degraded", ("vision lost", (finding,)): "aborted"}
    for (abort, findings), name in expected.items():
        identity = status(abort, findings)
        assert identity["status"] == name
        assert identity["reason"] == (abort or "; ".join(f.sentence for f in findings))


def test_the_chi_square_of_links_is_that_of_their_own_covariances():
    links = Links(Link(0, k, np.eye(4), 3 * np.eye(6), 0.8, 100, shared_by=3) for k in (1, 2))
    assert _mean_chi2(links, np.array([2.0, 4.0])) == pytest.approx(3 * 3.0 / 6)


@pytest.mark.long
def test_the_threads_that_store_images_end_with_the_estimators(tmp_path, monkeypatch):
    closed = []
    monkeypatch.setattr(StereoVision, "close", lambda self: closed.append(self))
    rendered = prepare(load_scenario("quickstart"))
    with make_navigator(rendered, SimpleNamespace(), tmp_path, Stopwatch()) as navigator:
        assert closed == []
    assert closed == [navigator.vision]
