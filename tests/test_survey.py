"""Whole (small) surveys: closed loop, separation of truth and estimate, aids, partial runs."""

import json
import os
import platform
import weakref
from pathlib import Path

import numpy as np
import pytest

from twin import survey
from twin.core import records
from twin.core.interrupts import StageGuard
from twin.core.timing import Stopwatch
from twin.errors import ScenarioError
from twin.report import run_writer
from twin.scenario import file as scenario_file
from twin.session.assembly import image_vision, navigator_with
from twin.world import rendered_world
from twin.world.mission import prepare

SMALL = [
    "terrain.size_m=[5.0, 4.0]",
    "rig.image_width_px=192",
    "rig.image_height_px=144",
    "rig.frame_rate_hz=15",  # half as much to render
    "plan.area_m=[0.8, 0.5]",
    "plan.altitude_m=1.8",
    "control.hold_s=0.4",
]
TRAJECTORIES = ("truth", "f2f", "online", "final")


def fly(out: Path, *overrides: str, progress=lambda _: None, report=False) -> survey.RunResult:
    """Flies a small survey; report and recording, which take longer than the flight, are written where asked for."""
    scenario = scenario_file.load_scenario("reef", [*SMALL, *overrides])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("twin.report.survey_page.surface_picture", lambda *_: None)
        return survey.run(scenario, out, progress, outputs=run_writer.OPTIONAL_OUTPUTS if report else ())


def image_navigator(mission, folder):
    stopwatch = Stopwatch()
    return navigator_with(mission, image_vision(mission, folder, stopwatch), stopwatch)


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    return fly(tmp_path_factory.mktemp("flown"), report=True)


def test_a_survey_by_vision_ends_complete_with_an_accurate_path_and_map(flown):
    m = flown.metrics
    assert flown.status == m["status"] == "complete"
    assert m["trajectory"]["final"]["ate_rmse_m"] < 0.01
    assert m["control"]["cross_track_rmse_m"] < 0.05
    assert m["map"]["nmad_m"] < 0.01
    assert m["map"]["completeness"] > 0.9
    assert m["orthomosaic"]["ce90_px"] < 1.5 and m["orthomosaic"]["pixel_m"] < m["map"]["cell_m"]
    assert m["orthomosaic"]["matched"] > 0.5 and m["orthomosaic"]["colour_difference_median"] is None


def test_the_run_folder_contains_every_documented_file(flown):
    names = (
        "scenario.resolved.toml env.json metrics.json report.html run.rrd log.jsonl posegraph.g2o mesh.glb mosaic.tif"
    )
    rasters = [f"dem{s}.tif" for s in ("", "_sigma", "_truth", "_error")]
    for name in [*names.split(), *rasters, *(f"trajectory_{t}.tum" for t in TRAJECTORIES), "keyframes"]:
        assert (flown.folder / name).exists(), name
    assert not list((flown.folder / "keyframes").glob("*.npy"))  # disparities, which only the survey itself needs
    assert json.loads((flown.folder / "metrics.json").read_text()) == flown.metrics


def test_the_texture_of_the_floor_is_freed_before_the_report(tmp_path, monkeypatch):
    """It is the largest part of the memory, and the report takes as much again."""
    textures, alive, opened, finish = [], [], rendered_world.RenderedWorld.__init__, run_writer.RunFolder.finish

    def open_and_refer(world, mission, stopwatch):
        opened(world, mission, stopwatch)
        textures.append(weakref.ref(mission.terrain.texture))
        alive.append(textures[0]() is not None)

    def look_and_finish(folder, record, guard):
        alive.append(textures[0]() is not None)
        return finish(folder, record, guard)

    monkeypatch.setattr(rendered_world.RenderedWorld, "__init__", open_and_refer)
    monkeypatch.setattr(run_writer.RunFolder, "finish", look_and_finish)
    assert fly(tmp_path / "run").metrics["orthomosaic"]["matched"] is not None  # the last that needs the texture
    assert alive == [True, False]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can return memory")
def test_memory_that_was_freed_is_returned_before_a_report_is_written(tmp_path):
    """The C library keeps what lies below a block in use: 60 MB of a survey, to which the report would add its own."""
    folder = run_writer.RunFolder(tmp_path / "run", scenario_file.load_scenario("reef", SMALL))
    blocks = [bytes(2000) for _ in range(40_000)]
    last, kept_mb = blocks.pop(), []
    del blocks
    for _ in range(2):
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        kept_mb.append(pages * os.sysconf("SC_PAGE_SIZE") / 1e6)
        folder._attempt(StageGuard(), "report", lambda: None)
    folder.__exit__()
    assert kept_mb[0] - kept_mb[1] > 60
    assert len(last) == 2000


def test_the_resolved_scenario_flies_the_same_survey(flown):
    again = scenario_file.load_scenario(flown.folder / "scenario.resolved.toml")
    assert again.fingerprint() == flown.metrics["scenario_hash"]


@pytest.mark.long
def test_one_seed_gives_byte_identical_trajectories_and_map(flown, tmp_path):
    again = fly(tmp_path / "again")
    for name in [*(f"trajectory_{t}.tum" for t in TRAJECTORIES), "dem.tif", "dem_sigma.tif"]:
        assert (again.folder / name).read_bytes() == (flown.folder / name).read_bytes(), name


def first_frame(*overrides):
    """Returns the first keyframe of a survey: images and readings."""
    mission = prepare(scenario_file.load_scenario("reef", [*SMALL, *overrides]))
    with rendered_world.RenderedWorld(mission, Stopwatch()) as world:
        return world.observe(next(step for step in mission.planned_frames(1) if step.keyframe))


def test_another_seed_gives_another_floor_and_another_noise():
    frame, other = first_frame(), first_frame("seed=7")
    assert np.abs(frame.left.astype(float) - other.left).mean() > 10  # noise alone: two grey levels
    assert frame.readings.pressure_z_m != other.readings.pressure_z_m


class Recorder:
    """A navigator that records the frames and the alignments that it is asked for."""

    def __init__(self, navigator):
        self.navigator, self.frames = navigator, []

    def update(self, frame, track):
        self.frames.append((frame, track))
        return self.navigator.update(frame, track)

    def align_track(self, track):
        self.frames.append((None, track))
        self.navigator.align_track(track)


def test_estimates_from_recorded_frames_do_not_depend_on_the_truth(tmp_path):
    """Frames are recorded in one world and replayed with every truth (floor, poses, map) replaced by another."""
    scenario = scenario_file.load_scenario("reef", [*SMALL, "plan.area_m=[0.3, 0.5]"])
    mission, stopwatch = prepare(scenario), Stopwatch()
    recorder = Recorder(image_navigator(mission, tmp_path / "first"))
    with rendered_world.RenderedWorld(mission, stopwatch) as world:
        survey.fly(mission, world, recorder, lambda *_: None)
    first = recorder.navigator.finish()

    elsewhere = scenario_file.load_scenario("reef", [*SMALL, "plan.area_m=[0.3, 0.5]", "terrain.kind=flat", "seed=9"])
    other = prepare(elsewhere)
    assert not np.array_equal(other.terrain.height_m, mission.terrain.height_m)
    navigator = image_navigator(other, tmp_path / "second")
    for frame, track in recorder.frames:
        navigator.align_track(track) if frame is None else navigator.update(frame, track)
    second = navigator.finish()
    for name in ("f2f", "online", "final"):
        assert getattr(first, name).world_from_camera.tobytes() == getattr(second, name).world_from_camera.tobytes()


def test_frames_contain_only_images_their_exposure_time_readings_and_the_choice_of_keyframes():
    fields = {"index", "time_s", "left", "right", "readings", "keyframe", "exposure"}
    assert set(records.Frame.__dataclass_fields__) == fields
    assert set(records.Readings.__dataclass_fields__) == {
        "pressure_z_m", "ahrs_rpy_rad", "dvl_mps", "usbl_m", "altitude_m", "beacons", "imu", "up", "late",
    }  # fmt: skip


def test_sensors_that_do_not_aid_do_not_reach_the_estimators():
    assert first_frame("navigation.aiding=[]").readings == records.Readings()


@pytest.mark.long
def test_every_aid_reaches_position_and_alignment(tmp_path):
    aids = [
        'navigation.aiding=["dvl", "usbl", "beacons"]',
        "navigation.usbl_sigma_m=0.0001",
        "navigation.usbl_interval_s=0.01",
        "beacons=[{position_m=[0.0, 0.0, 0.8]}]",
    ]
    mission = prepare(scenario_file.load_scenario("reef", [*SMALL, "plan.area_m=[0.6, 0.5]", *aids]))
    navigator, estimates = image_navigator(mission, tmp_path), []
    with rendered_world.RenderedWorld(mission, Stopwatch()) as world:
        survey.fly(mission, world, navigator, lambda estimate, _: estimates.append(estimate))
        true = world.truth().trajectory
    result = navigator.finish()
    nodes = navigator.network.nodes
    assert [node.dvl_displacement is not None for node in nodes] == [False] + [True] * (len(nodes) - 1)
    assert sum(len(node.readings.beacons) for node in nodes) > 3
    sigma_m = [estimates[row].sigma_m for row in result.keyframe_rows]
    assert max(sigma_m) < np.sqrt(3) * 1.01e-4  # no worse than the fix just taken
    for path in (result.online, result.final):
        assert np.sqrt(((path.positions - true.positions) ** 2).sum(axis=1).mean()) < 4e-3


@pytest.mark.long
def test_mosaic_and_alignment_can_be_left_out(tmp_path):
    keys = "rig.model=ideal", "estimate.use_ga=false", "estimate.use_f2m=false", "plan.area_m=[0.3, 0.5]"
    result = fly(tmp_path / "run", *keys)
    assert result.status == "complete"
    assert result.metrics["trajectory"]["final"]["ate_rmse_m"] < 0.05
    assert result.metrics["timing"]["stages"]["ga"]["count"] == 0


def stop_at(share, error):
    def progress(now):
        if now.stage == "survey" and now.share > share:
            raise error

    return progress


@pytest.mark.long
def test_an_interrupted_survey_reports_its_reason_and_keeps_partial_results(tmp_path, monkeypatch):
    monkeypatch.setattr("twin.report.survey_page.draw_all", lambda *_: {})  # figures take longer than the flight
    stop = stop_at(0.5, KeyboardInterrupt())
    result = fly(tmp_path / "run", "plan.area_m=[0.3, 0.5]", progress=stop, report=True)
    assert (result.status, result.metrics["reason"]) == ("aborted", "interrupted")
    path = records.Trajectory.load(result.folder / "trajectory_final.tum")
    assert 20 < len(path) < 400
    assert result.metrics["map"]["completeness"] > 0.5
    assert (result.folder / "report.html").exists()


@pytest.mark.long
def test_a_nan_in_the_physics_aborts_with_the_reason(tmp_path, monkeypatch):
    command = survey.make_pilot

    def mad(*given):
        sane, count = command(*given), 0

        def steer(estimate, reference):
            nonlocal count
            count += 1
            return sane(estimate, reference) * (np.nan if count > 60 else 1.0)

        return steer

    monkeypatch.setattr(survey, "make_pilot", mad)
    result = fly(tmp_path / "run")
    assert result.status == "aborted"
    assert "physics diverged at 4" in result.metrics["reason"]


@pytest.mark.long
def test_lost_vision_aborts_the_survey_with_a_reason(tmp_path):
    result = fly(tmp_path / "run", "water.jerlov=9C", "water.turbidity=20")
    assert result.status == "aborted"
    assert result.metrics["reason"].startswith("vision lost at ")
    assert "in water Jerlov 9C (Solonenko & Mobley 2015), turbidity 20: " in result.metrics["reason"]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "plan.area_m=[30.0, 0.5]",
            "plan.area_m: 30 x 0.5 m is larger than the terrain (allowed: up to 5.00 x 4.00 m)",
        ),
        ("plan.speed_mps=2.0", "plan.speed_mps: 2: too fast for the thrusters (allowed: up to 0.7"),
        ("plan.altitude_m=0.7", "plan.altitude_m: 0.7: the cameras come within "),
        ('require."map.le91_m"=0.1', "map.le91_m: no such metric, did you mean"),
        ("terrain.texture_file=x.png", "terrain.texture_file: has no effect on a generated floor"),
    ],
)
def test_an_impossible_survey_is_rejected_before_anything_is_written(tmp_path, override, message):
    with pytest.raises(ScenarioError) as refused:
        fly(tmp_path / "run", override)
    assert message in str(refused.value)
    assert not (tmp_path / "run").exists()


@pytest.mark.long
def test_a_failed_alignment_is_reported_and_partial_results_are_kept(tmp_path, monkeypatch):
    def fail(*_):
        raise np.linalg.LinAlgError("not every pose is held")

    monkeypatch.setattr("twin.estimate.network.align", fail)
    result = fly(tmp_path / "run", "plan.area_m=[0.3, 0.5]")
    assert (result.status, result.metrics["reason"]) == (
        "aborted",
        "global alignment failed: not every pose is held",
    )
    assert result.metrics["trajectory"]["online"]["ate_rmse_m"] < 0.05


@pytest.mark.long
def test_a_full_disk_in_the_background_is_reported_and_partial_results_are_kept(tmp_path, monkeypatch):
    """Links are measured in the background: an error is raised when they are collected."""

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("twin.estimate.link_selection.inflate_for_shared_noise", full)
    result = fly(tmp_path / "run", "plan.area_m=[0.3, 0.5]", "estimate.use_ga=false")
    assert (result.status, result.metrics["reason"]) == ("aborted", "[Errno 28] No space left on device")
    assert result.metrics["trajectory"]["online"]["ate_rmse_m"] < 0.05
