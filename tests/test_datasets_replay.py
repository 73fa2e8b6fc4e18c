"""Replay of a recorded data set: path, map and report without a simulator; swapped cameras, clocks, preview."""

import json
import re
import runpy
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import rasterio
import recorded_datasets as recorded
import seafloor_scene as scene
from recorded_datasets import RIG

import twin
from twin.core import geometry
from twin.core.records import HeightVariances, MapGrid, Trajectory
from twin.datasets import readers
from twin.errors import TwinError
from twin.estimate.first_pair import floor_plane, inspect_pair
from twin.exchange.geotiff import write_elevations
from twin.plugin import loading
from twin.recordings import opened_dataset, preview, replay
from twin.recordings.frames import RecordedFrames
from twin.recordings.replay import ReplayOptions, alignment_name, bayer_pattern, frame_numbers, open_dataset
from twin.report import recording, survey_page
from twin.report.run_folder import load_run

pytestmark = pytest.mark.long

N = 10
PATH = recorded.poses(N)


@pytest.fixture(scope="module")
def frames():
    return recorded.frames(PATH)


@pytest.fixture(scope="module")
def euroc(frames, tmp_path_factory):
    return recorded.write_euroc(tmp_path_factory.mktemp("euroc"), frames, PATH)


@pytest.fixture(scope="module")
def replayed(euroc, tmp_path_factory):
    return twin.replay(euroc, tmp_path_factory.mktemp("run"), ReplayOptions(outputs=()))


def test_a_finished_replay_is_resumed_with_the_same_data_and_options_only(replayed, euroc, tmp_path):
    files = {file: file.read_bytes() for file in replayed.folder.rglob("*") if file.is_file()}
    options = ReplayOptions(outputs=())
    again = twin.replay(euroc, replayed.folder, options, resume=True)
    assert (again.metrics, again.result) == (json.loads(json.dumps(replayed.metrics)), None)
    shutil.copytree(euroc, tmp_path / "other")
    for dataset, other in ((euroc, replace(options, frames=slice(0, 8))), (tmp_path / "other", options)):
        with pytest.raises(TwinError, match="has another run, which is finished"):
            twin.replay(dataset, replayed.folder, other, resume=True)
    with pytest.raises(TwinError, match="does not exist"):
        twin.replay(tmp_path / "none", replayed.folder, options, resume=True)
    assert {file: file.read_bytes() for file in replayed.folder.rglob("*") if file.is_file()} == files


def test_results_in_the_folder_of_the_data_are_no_inputs_of_a_replay(euroc, tmp_path, monkeypatch):
    dataset = tmp_path / "dataset"
    shutil.copytree(euroc, dataset)
    monkeypatch.setattr(replay, "Checkpoints", lambda out, identity, inputs, interval_s: list(inputs))
    options = ReplayOptions(outputs=())
    before = replay._checkpoints(open_dataset(dataset, options), options, "", dataset / "runs" / "1", None)
    for name in ("runs/0/env.json", "runs/0/trajectory.txt", "runs/1/scenario.resolved.toml"):
        (dataset / name).parent.mkdir(parents=True, exist_ok=True)
        (dataset / name).touch()
    after = replay._checkpoints(open_dataset(dataset, options), options, "", dataset / "runs" / "1", None)
    assert before and after == before


def test_the_replayed_path_and_map_are_accurate(replayed):
    assert replayed.metrics["timing"]["frames"] == N
    assert replayed.metrics["trajectory"]["final"]["ate_max_m"] < 0.003
    elevation = replayed.elevation
    world = geometry.inverse(elevation.map_from_world)
    true_from_world = PATH[0] @ geometry.inverse(replayed.result.final.world_from_camera[0]) @ world
    x, y = np.meshgrid(*elevation.grid.centres())
    known = np.isfinite(elevation.height_m)
    points = geometry.transform(true_from_world, np.column_stack([x[known], y[known], elevation.height_m[known]]))
    error_m = np.abs(points[:, 2] - recorded.hills().height_at(points[:, 0], points[:, 1]))
    assert np.percentile(error_m, 90) < 0.012
    assert abs(np.median(elevation.height_m[known])) < 0.03  # the plane of the map is that of the floor


def test_the_run_folder_is_that_of_a_survey(replayed):
    run = load_run(replayed.folder)
    assert run.finished and {"truth", "f2f", "online", "final"} <= run.trajectories.keys()
    assert {"dem", "dem_sigma", "mosaic"} <= run.rasters.keys() and "dem_truth" not in run.rasters
    aligned = run.trajectories["truth"].positions - run.trajectories["final"].positions
    assert np.abs(aligned).max() < 0.003
    np.testing.assert_array_equal(run.keyframes.map_from_world, replayed.elevation.map_from_world)
    page = survey_page.write_report(replayed.folder).read_text()
    assert "frames of recorded stereo data" in page and "reference plane" not in page
    assert "moved by the alignment of the replay" in page and "no transform is fitted" not in page
    assert "points to the bow" not in page
    assert recording.record_run(load_run(replayed.folder)).is_file()


def test_a_still_sequence_stays_in_place(tmp_path):
    """Each frame is compared with the one keyframe, so noise does not add up; measured: 0.3 mm over 60 frames."""
    still = np.repeat(PATH[:1], 20, axis=0)
    folder = recorded.write_folder(tmp_path / "set", recorded.frames(still))
    found = twin.replay(folder, tmp_path / "run", ReplayOptions(outputs=()))
    moved_m = np.linalg.norm(found.result.final.positions - found.result.final.positions[0], axis=1)
    assert found.status == "complete" and len(found.result.final) == 20 and moved_m.max() < 0.002


def test_a_still_sequence_of_a_real_pair_stays_in_place(outside_data, tmp_path):
    """Middlebury's Motorcycle, 60 times at 10 Hz with independent noise of 2 grey levels; required are 2 cm.

    Measured: 0.06 mm at depths of 2 to 5 m, as every frame is compared with the one keyframe.
    """
    rng, shape = np.random.default_rng(1), None
    for side in ("left", "right"):
        (tmp_path / "set" / side).mkdir(parents=True)
        image = cv2.imread(str(outside_data(f"motorcycle_{side}.png"))).astype(np.float32)
        shape = image.shape
        for k in range(60):
            noisy = np.clip(np.round(image + rng.normal(size=shape, scale=2.0)), 0, 255).astype(np.uint8)
            cv2.imwrite(str(tmp_path / "set" / side / f"{k:03d}.png"), noisy)
    write_motorcycle_calibration(tmp_path / "set" / "calibration.yaml", shape[:2])
    (tmp_path / "set" / "times.txt").write_text("".join(f"{k / 10:.1f}\n" for k in range(60)))
    found = twin.replay(tmp_path / "set", tmp_path / "run", ReplayOptions(outputs=()))
    moved_m = np.linalg.norm(found.result.final.positions - found.result.final.positions[0], axis=1)
    assert found.status == "complete" and len(moved_m) == 60
    assert moved_m.max() < 0.0003


def test_a_replay_without_a_tenth_of_its_frames_is_degraded(frames, tmp_path):
    folder = recorded.write_folder(tmp_path / "set", frames)
    for name in ("0003.png", "0004.png"):
        (folder / "left" / name).write_bytes(b"")
    found = twin.replay(folder, tmp_path / "run", ReplayOptions(outputs=())).metrics
    assert found["status"] == "degraded"
    assert found["reason"] == "2 of 10 frames of the data set could not be used, see replay.skipped"
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [line["check"] for line in log if line["event"] == "finding"] == ["frames_used"]


class Known:
    """Estimator of another package that knows the motion: the map must follow from its poses."""

    def __init__(self, setup):
        self.start, self.n = setup.start, 0

    def update(self, frame):
        self.n += 1
        return self.start @ geometry.inverse(PATH[0]) @ PATH[frame.index]

    def covariance(self):
        return None

    def finish(self):
        return None


class Broken(Known):
    def update(self, frame):
        return super().update(frame) if self.n < 4 else 1 / 0


def test_an_estimator_of_another_package_replays(euroc, tmp_path):
    options = ReplayOptions(outputs=(), estimator="test_datasets_replay:Known")
    found = twin.replay(euroc, tmp_path / "run", options)
    assert found.status == "complete" and found.metrics["trajectory"]["final"]["ate_max_m"] < 1e-6
    assert "those of the plug-in test_datasets_replay:Known" in found.metrics["warning"]
    assert len(found.result.keyframe_rows) >= 2 and len(found.result.links) == 0
    height_m = found.elevation.height_m[np.isfinite(found.elevation.height_m)]
    assert height_m.size > 1000 and np.ptp(np.percentile(height_m, [2, 98])) < 0.12  # hills of 0.1 m
    assert load_run(tmp_path / "run").scenario["estimate"]["plugin"] == "test_datasets_replay:Known"


def test_a_fault_of_an_estimator_of_another_package_is_named(euroc, tmp_path):
    with pytest.raises(TwinError, match="--estimator: nothing: no installed package registers this name"):
        twin.replay(euroc, tmp_path / "none", ReplayOptions(estimator="nothing"))
    assert not (tmp_path / "none").exists()
    options = ReplayOptions(outputs=(), estimator="test_datasets_replay:Broken")
    found = twin.replay(euroc, tmp_path / "run", options).metrics
    assert found["status"] == "aborted" and found["timing"]["frames"] == 4
    assert "--estimator test_datasets_replay:Broken: update raised ZeroDivisionError" in found["reason"]


def write_true_map(file, offset_m=0.0, grid=None):
    """Writes the true heights of the hills, higher by an offset, as `twin run` does."""
    grid = grid or MapGrid(-2.0, 2.0, 0.01, 400, 400)
    heights = recorded.hills().height_at(*np.meshgrid(*grid.centres())) + offset_m
    write_elevations(file, heights.astype(np.float32), grid, "true elevation [m]")
    return file


def test_with_true_heights_the_map_has_the_errors_that_the_floor_gives(euroc, replayed, tmp_path):
    """The offset of the truth appears as bias, as nothing is fitted to the heights."""
    assert replayed.metrics["map"]["le90_m"] is None
    found = twin.replay(euroc, tmp_path / "run", ReplayOptions(outputs=(), true_map=write_true_map(tmp_path / "t.tif")))
    lower = ReplayOptions(outputs=(), true_map=write_true_map(tmp_path / "low.tif", -0.1))
    offset = twin.replay(euroc, tmp_path / "low", lower).metrics["map"]
    elevation, errors = found.elevation, found.metrics["map"]
    x, y = np.meshgrid(*elevation.grid.centres())
    known = np.isfinite(elevation.height_m)
    true_from_map = (
        PATH[0] @ geometry.inverse(elevation.map_from_world @ found.result.final.world_from_camera[0])
    )  # fmt: skip
    points = geometry.transform(true_from_map, np.column_stack([x[known], y[known], elevation.height_m[known]]))
    vertical_m = points[:, 2] - recorded.hills().height_at(points[:, 0], points[:, 1])
    # along the axis of the map, tilted by t = 1 to 3 degrees: up to t times slope, 5 %, different
    assert errors["le90_m"] == pytest.approx(np.percentile(np.abs(vertical_m), 90), rel=0.05)
    assert errors["le90_m"] < 0.012
    assert offset["bias_m"] - errors["bias_m"] == pytest.approx(0.1, abs=0.001)
    assert errors["completeness"] is None and errors["sigma_ratio"] > 0
    run = load_run(tmp_path / "run")
    error_m = run.rasters["dem_error"].values
    assert np.nanpercentile(np.abs(error_m), 90) == pytest.approx(errors["le90_m"], rel=1e-6)
    page = survey_page.write_report(tmp_path / "run").read_text()
    assert "all cells with an estimated and a true height, moved by the alignment of the path" in page
    assert "The LE90 of the heights is" in page and "of the observed floor; NMAD" not in page


def test_true_heights_beside_the_true_poses_of_a_folder_are_used_with_these_poses_only(euroc, tmp_path):
    folder = tmp_path / "set"
    shutil.copytree(euroc, folder)
    write_true_map(folder / "mav0" / "state_groundtruth_estimate0" / "dem_truth.tif")
    opened = open_dataset(folder, ReplayOptions())
    assert opened.true_map is not None and opened.true_map.grid.rows == 400
    truth = Trajectory(opened.frames.start_s + opened.truth.times_s, opened.truth.world_from_camera)
    truth.save(tmp_path / "truth.tum")
    assert open_dataset(folder, ReplayOptions(truth=tmp_path / "truth.tum")).true_map is None


def test_true_heights_that_cannot_be_used_are_one_line(euroc, frames, tmp_path):
    given = write_true_map(tmp_path / "true.tif")
    folder = recorded.write_folder(tmp_path / "set", frames[:1])
    with pytest.raises(TwinError, match="--true-map: the data set has no true poses"):
        open_dataset(folder, ReplayOptions(true_map=given))
    (tmp_path / "text.tif").write_text("heights")
    layout = {"driver": "GTiff", "width": 4, "height": 4, "count": 3, "dtype": "uint8"}
    with rasterio.open(tmp_path / "rgb.tif", "w", transform=rasterio.Affine(1, 0, 0, 0, -1, 4), **layout) as file:
        file.write(np.zeros((3, 4, 4), np.uint8))
    nothing = write_true_map(tmp_path / "nothing.tif", np.nan)
    for file, message in (
        (tmp_path / "none.tif", "none.tif: does not exist"),
        (tmp_path / "text.tif", "text.tif: cannot be read"),
        (tmp_path / "rgb.tif", "rgb.tif: has 3 bands"),
        (nothing, "nothing.tif: has no heights"),
    ):
        with pytest.raises(TwinError, match=message):
            open_dataset(euroc, ReplayOptions(true_map=file))


def measured(tree, name=""):
    """Returns the names of the numbers in a tree of dictionaries and lists."""
    if isinstance(tree, dict | list):
        pairs = tree.items() if isinstance(tree, dict) else ((name, value) for value in tree)
        return {found for key, value in pairs for found in measured(value, key)}
    return set() if tree is None else {name}


def test_without_a_truth_there_is_no_error_but_consistency(frames, tmp_path):
    folder = recorded.write_folder(tmp_path / "set", frames)
    (folder / "left" / "0003.png").write_bytes(b"")
    found = twin.replay(folder, tmp_path / "run", ReplayOptions(outputs=())).metrics
    stated = [f"{cause}_error_m" for cause in HeightVariances._fields]
    for section in ("trajectory", "map", "consistency", "stages", "tracks"):
        assert not measured(found[section]) - {"cell_m", *stated}, section
    assert found["replay"]["skipped"] == {"left image: empty file": 1} and found["timing"]["frames"] == N - 1
    assert found["replay"]["network"]["links"] > 0 and found["self_check"]["link_chi2"] > 0
    assert not (tmp_path / "run" / "trajectory_truth.tum").exists()


def interrupt(*_):
    raise KeyboardInterrupt


def test_an_interrupt_before_the_first_frame_leaves_a_run_folder(euroc, tmp_path, monkeypatch):
    monkeypatch.setattr(replay, "_estimate", interrupt)
    found = twin.replay(euroc, tmp_path / "run", ReplayOptions(outputs=()))
    assert found.status == "aborted" and found.metrics["reason"] == "interrupted" and found.elevation is None
    assert found.metrics["timing"]["frames"] == 0 and found.metrics["trajectory"]["final"]["ate_max_m"] is None
    assert not found.metrics["warnings"]
    assert load_run(tmp_path / "run").finished


def test_an_interrupt_of_the_evaluation_ends_this_stage_only(euroc, replayed, tmp_path, monkeypatch):
    monkeypatch.setattr("twin.session.conclusion.evaluate", interrupt)
    found = twin.replay(euroc, tmp_path / "run", ReplayOptions(outputs=()))
    assert found.status == "aborted" and found.metrics["reason"] == "interrupted; evaluation skipped"
    assert found.elevation is not None and (tmp_path / "run" / "dem.tif").exists()
    assert found.metrics["timing"]["frames"] == N and found.metrics["trajectory"]["final"]["ate_max_m"] is None
    evaluated = replayed.metrics
    assert found.metrics.keys() == evaluated.keys()
    assert found.metrics["replay"].keys() == evaluated["replay"].keys()
    assert found.metrics["replay"]["network"].keys() == evaluated["replay"]["network"].keys()


def test_swapped_images_and_swapped_calibrations_are_named(frames, tmp_path):
    folder = recorded.write_folder(tmp_path / "set", frames[:1], swapped=True)
    with pytest.raises(TwinError, match="the left and the right images are swapped"):
        open_dataset(folder, ReplayOptions())
    turned = recorded.write_opencv(tmp_path / "turned.yaml", T=np.array([0.15, 0, 0]))
    with pytest.raises(TwinError, match=r"turned.yaml: the baseline is negative"):
        open_dataset(folder, ReplayOptions(calibration=turned))


def recorded_unrectified(frame, folder):
    """Writes a pair as two tilted cameras with distortion record it, and their calibration."""
    lens, tilts = np.array([-0.2, 0.05, 0.0, 0.0, 0.0]), [geometry.so3_exp(np.array([s, 0, 0])) for s in (0.03, -0.03)]
    images = []
    for image, tilt in zip((frame.left, frame.right), tilts, strict=True):
        pixels = np.indices(image.shape[:2])[::-1].reshape(2, 1, -1).T.astype(np.float32)
        at = cv2.undistortPoints(pixels, RIG.matrix, lens, R=tilt.T, P=RIG.matrix).reshape(*image.shape[:2], 2)
        images.append(cv2.remap(image, at, None, cv2.INTER_CUBIC))
    recorded.write_folder(folder, [replace(frame, left=images[0], right=images[1])])
    rotation = tilts[1] @ tilts[0].T
    shift = tilts[1] @ np.array([[-RIG.baseline_m], [0], [0]])
    recorded.write_opencv(folder / "calibration.yaml", D1=lens, D2=lens, R=rotation, T=shift)
    return folder


def test_swapped_images_of_an_unrectified_rig_are_named(frames, tmp_path):
    folder = recorded_unrectified(frames[0], tmp_path / "set")
    assert len(open_dataset(folder, ReplayOptions()).pair.points.xyz) > 100
    (folder / "left").rename(folder / "other")
    (folder / "right").rename(folder / "left")
    (folder / "other").rename(folder / "right")
    with pytest.raises(TwinError, match="the left and the right images are swapped"):
        open_dataset(folder, ReplayOptions())


def test_a_list_in_reverse_order_is_replayed_in_the_order_of_time(euroc, tmp_path):
    folder = tmp_path / "set"
    shutil.copytree(euroc, folder)
    for camera in ("cam0", "cam1"):
        file = folder / "mav0" / camera / "data.csv"
        header, *rows = file.read_text().splitlines()
        file.write_text("\n".join([header, *rows[::-1], ""]))
    opened, expected = (open_dataset(one, ReplayOptions()) for one in (folder, euroc))
    assert "reverse order" in opened.dataset.notes[-1]
    for found, given in zip(opened.frames, expected.frames, strict=True):
        assert found.time_s == given.time_s and np.array_equal(found.left, given.left)


def test_a_baseline_in_the_wrong_unit_is_asked_for_and_a_depth_of_another_scale_remarked(frames, tmp_path):
    folder = recorded.write_folder(tmp_path / "set", frames[:1])
    recorded.write_opencv(folder / "calibration.yaml", T=np.array([-150 / 25.4, 0, 0]))  # in inches
    with pytest.raises(TwinError, match=r"calibration.yaml: the baseline is 5.9.* m .*--baseline"):
        open_dataset(folder, ReplayOptions())
    opened = open_dataset(folder, ReplayOptions(baseline_m=RIG.baseline_m))
    assert opened.frames.rectification.rig.baseline_m == pytest.approx(RIG.baseline_m) and opened.depth_note == ""
    far = open_dataset(folder, ReplayOptions(baseline_m=RIG.baseline_m / 0.0254))
    table = {row[0]: row[1:] for row in preview.rows(far, preview.light_of(far))}
    assert "implausible under water" in table["depth"][1] and "--baseline" in table["depth"][1]


@pytest.mark.parametrize("damage", ["not a calibration", "negative baseline", "two files"])
def test_a_given_calibration_replaces_one_of_the_folder_that_cannot_be_used(frames, tmp_path, damage):
    folder = recorded.write_folder(tmp_path / "set", frames[:1])
    good = recorded.write_opencv(tmp_path / "good.yaml")
    if damage == "not a calibration":
        (folder / "calibration.yaml").write_text("a: [")
    elif damage == "negative baseline":
        recorded.write_opencv(folder / "calibration.yaml", T=np.array([0.15, 0, 0]))
    else:
        (folder / "calibration.yaml").rename(folder / "a.yaml")
        (folder / "b.yaml").write_text("a: 1")
    with pytest.raises(TwinError, match="not valid YAML|the baseline is negative|has several YAML files"):
        open_dataset(folder, ReplayOptions())
    assert open_dataset(folder, ReplayOptions(calibration=good)).frames.rectification.rig.baseline_m == RIG.baseline_m


def test_true_poses_of_the_body_are_kept_where_a_given_calibration_replaces_that_of_the_cameras(
    euroc, frames, tmp_path
):
    folder, good = tmp_path / "set", recorded.write_opencv(tmp_path / "good.yaml")
    shutil.copytree(euroc, folder)
    expected = open_dataset(euroc, ReplayOptions()).truth
    sensor = folder / "mav0" / "cam0" / "sensor.yaml"
    sensor.write_text(re.sub(r"distortion_model: .*", "distortion_model: fov", sensor.read_text()))
    with pytest.raises(TwinError, match="distortion model 'fov' is not supported"):
        open_dataset(folder, ReplayOptions())
    opened = open_dataset(folder, ReplayOptions(calibration=good))
    np.testing.assert_allclose(opened.truth.world_from_camera, expected.world_from_camera, atol=1e-9)
    sensor.write_text("a: [")  # the pose of the camera in the body is unknown, too
    opened = open_dataset(folder, ReplayOptions(calibration=good))
    assert opened.truth is None and "true poses" in opened.dataset.notes[0]


def test_a_given_truth_replaces_one_of_the_data_set_that_is_damaged(euroc, tmp_path):
    folder = tmp_path / "set"
    shutil.copytree(euroc, folder)
    (folder / "mav0" / "state_groundtruth_estimate0" / "data.csv").write_text("x,y\n")
    with pytest.raises(TwinError, match="data.csv:1: is not a line of numbers"):
        open_dataset(folder, ReplayOptions())
    expected = open_dataset(euroc, ReplayOptions())
    truth = Trajectory(expected.frames.start_s + expected.truth.times_s, expected.truth.world_from_camera)
    truth.save(tmp_path / "truth.tum")
    opened = open_dataset(folder, ReplayOptions(truth=tmp_path / "truth.tum"))
    np.testing.assert_allclose(opened.truth.positions, expected.truth.positions, atol=1e-6)


def test_a_truth_of_another_clock_is_refused_before_anything_is_computed(euroc, tmp_path):
    truth = recorded.trajectory(PATH)
    truth.times_s += 1e5
    truth.save(tmp_path / "truth.tum")
    with pytest.raises(TwinError, match=r"truth.tum: the truth is of another clock"):
        twin.replay(euroc, tmp_path / "run", ReplayOptions(truth=tmp_path / "truth.tum"))
    assert not (tmp_path / "run").exists()


def test_a_folder_without_calibration_or_with_uniform_images_is_one_line(tmp_path):
    blank = [frame_of(np.full((RIG.height_px, RIG.width_px, 3), 90, np.uint8))]
    folder = recorded.write_folder(tmp_path / "set", blank)
    with pytest.raises(TwinError, match="points of the first pair are matched"):
        open_dataset(folder, ReplayOptions())
    (folder / "calibration.yaml").unlink()
    with pytest.raises(TwinError, match="has no calibration"):
        open_dataset(folder, ReplayOptions())


def frame_of(image):
    return recorded.Frame(0, 0.0, image, image)


@pytest.mark.parametrize("name", ["sheet.png", "sheet"])
def test_the_preview_is_one_sheet_with_the_given_name(name, euroc, tmp_path):
    opened = open_dataset(euroc, ReplayOptions())
    light = preview.light_of(opened)
    file = preview.draw(opened, light, tmp_path / name)
    assert list(tmp_path.iterdir()) == [file]
    assert cv2.imread(str(file)).shape[1] > 1000
    table = {row[0]: row[1:] for row in preview.rows(opened, light)}
    assert int(table["matched points"][0]) > 100 and table["reader"][0] == "euroc"
    assert abs(float(table["row difference"][0].split()[0])) < 0.1


def test_the_preview_makes_the_light_of_the_cameras_even(frames, tmp_path):
    """Images with a bright middle, and a right camera that is half as bright, beside the same images in even light."""
    y, x = (np.linspace(-1, 1, n) for n in (RIG.height_px, RIG.width_px))
    fall_off = (1 - 0.35 * (x[None] ** 2 + y[:, None] ** 2))[..., None]

    def lit(image, factor):
        return np.asarray(np.round(image * (factor * fall_off)), np.uint8)

    pairs = [replace(f, left=lit(f.left, 1.0), right=None if f.right is None else lit(f.right, 0.5)) for f in frames]
    found = {
        name: preview.light_of(open_dataset(recorded.write_folder(tmp_path / name, images), ReplayOptions()))
        for name, images in (("even", frames), ("lit", pairs))
    }
    corners = {name: preview._corner_light(light.mean_left) for name, light in found.items()}
    assert corners["lit"] < 0.5 < 0.8 < corners["even"]
    assert found["lit"].mean_right.mean() == pytest.approx(found["lit"].mean_left.mean() / 2, rel=0.02)
    after = preview._corner_light(found["lit"].even_left.mean(axis=2))
    assert after == pytest.approx(preview._corner_light(found["even"].even_left.mean(axis=2)), abs=0.15)


@pytest.mark.parametrize("tilt_rad", [0.0, 0.35, 0.6])
def test_the_plane_of_the_map_is_that_of_a_tilted_floor(tilt_rad):
    """A camera that looks obliquely at a plane: the world has the plane at z = 0 and the camera at its true height."""
    rng, pose = np.random.default_rng(1), scene.down_camera(0, 0, 1.6, (0.0, tilt_rad, 0.0))
    left, right, _ = scene.stereo_pair(scene.plane(), RIG, pose, rng)
    pair = inspect_pair(recorded.Frame(0, 0.0, *(np.repeat(one[..., None], 3, axis=2) for one in (left, right))), RIG)
    plane = floor_plane(pair.points)
    assert plane.fitted and not pair.swapped
    assert plane.distance_m == pytest.approx(1.6, abs=0.02)
    assert np.arccos(-plane.normal[2]) == pytest.approx(tilt_rad, abs=0.02)
    np.testing.assert_allclose(plane.world_from_camera[:3, :3] @ plane.normal, [0, 0, 1], atol=1e-9)


def write_motorcycle_calibration(file, shape):
    """Writes the calibration of Middlebury's Motorcycle at quarter size, for images of a shape (rows, columns)."""
    left = np.array([[994.978, 0, 311.193], [0, 994.978, 254.877], [0, 0, 1]])
    right = left + [[0, 0, 31.086], [0, 0, 0], [0, 0, 0]]
    baseline = np.array([-0.193001, 0, 0])
    recorded.write_opencv(file, image_width=shape[1], image_height=shape[0], M1=left, M2=right, T=baseline)


def test_the_motorcycle_pair_is_matched_as_accurately_as_without_a_data_set(outside_data, tmp_path):
    """Limits of test_estimate_disparity; focal length, doffs and baseline of Middlebury 2014 at quarter size."""
    truth = np.load(outside_data("motorcycle_disp.npz"))["arr_0"]
    for side in ("left", "right"):
        (tmp_path / "set" / side).mkdir(parents=True)
        image = cv2.imread(str(outside_data(f"motorcycle_{side}.png")))
        cv2.imwrite(str(tmp_path / "set" / side / "0.png"), image)
    height, width = truth.shape
    write_motorcycle_calibration(tmp_path / "set" / "calibration.yaml", (height, width))
    opened = open_dataset(tmp_path / "set", ReplayOptions())
    error = np.abs(opened.pair.disparity.disparity_px - 31.086 - truth)
    known = np.isfinite(error)
    visible = np.isfinite(truth) & (np.arange(width) >= truth + 31.086)  # the shift loses the right image's margin
    assert known[visible].mean() >= 0.85
    assert (error[known] > 1).mean() <= 0.065
    assert 2 < np.median(opened.pair.points.xyz[:, 2]) < 5


def test_the_example_reader_of_the_documentation_reads_the_motorcycle_pair(outside_data, tmp_path, monkeypatch):
    file = Path(__file__).parent.parent / "docs" / "example_reader.py"
    example = runpy.run_path(str(file))["MiddleburyReader"]
    entry = SimpleNamespace(name="middlebury", value="example:MiddleburyReader", load=lambda: example)
    monkeypatch.setattr(loading, "entry_points", lambda group: [entry])
    for side, name in (("left", "im0.png"), ("right", "im1.png")):
        (tmp_path / name).write_bytes(outside_data(f"motorcycle_{side}.png").read_bytes())
    lines = ["cam0=[994.978 0 311.193; 0 994.978 254.877; 0 0 1]", "cam1=[994.978 0 342.279; 0 994.978 254.877; 0 0 1]"]
    (tmp_path / "calib.txt").write_text("\n".join([*lines, "doffs=31.086", "baseline=193.001", ""]))
    dataset, name = readers.read_dataset(tmp_path)
    frames = RecordedFrames(dataset, dataset.calibration)
    assert name == "middlebury" and len(list(frames)) == 1 and not frames.skipped
    assert frames.rectification.rig.baseline_m == pytest.approx(0.193001)
    shifted = cv2.imread(str(outside_data("motorcycle_right.png")))[:, 100, ::-1]  # by 31.086 px: the doffs
    np.testing.assert_allclose(frames.first_pair().right[:, 69].mean(), shifted.mean(), atol=1.5)
    (tmp_path / "calib.txt").write_text("cam0=[1 2 3]")
    with pytest.raises(TwinError, match=r"calib.txt: is not a calibration"):
        readers.read_dataset(tmp_path)


def test_unknown_names_are_one_line():
    assert alignment_name("se3") == "se3" and bayer_pattern(None) is None
    with pytest.raises(TwinError, match="--align: 'sim3' is not an alignment .*se3, first, none"):
        alignment_name("sim3")
    with pytest.raises(TwinError, match="--bayer: 'RGB' is not a Bayer pattern"):
        bayer_pattern("RGB")


def test_pairs_too_far_apart_for_tracking_are_linked_directly(tmp_path):
    """Steps of 0.3 m are 39 px at 5 Hz; the prediction at rest misses them, so the features must find them."""
    path = recorded.poses(6, step_m=0.3)
    folder = recorded.write_folder(tmp_path / "set", recorded.frames(path))
    truth = Trajectory(100 + recorded.trajectory(path).times_s, path)
    truth.save(tmp_path / "truth.tum")
    found = twin.replay(folder, tmp_path / "run", ReplayOptions(truth=tmp_path / "truth.tum", outputs=()))
    assert found.metrics["links"]["bridged"] == 0 and found.metrics["timing"]["keyframes"] == 6
    assert found.metrics["trajectory"]["final"]["ate_max_m"] < 0.006
    assert found.metrics["trajectory"]["f2f"]["ate_max_m"] < 0.02  # the links continue it, and give it the velocity


def test_an_object_that_moves_almost_as_the_floor_does_moves_neither_path_nor_its_sigma(tmp_path):
    """A piece of floor of an eighth of the image, seen by both cameras, whose images move by 7/8 of the floor's."""
    path = recorded.poses(60)
    slower = path.copy()
    slower[:, 0, 3] = path[0, 0, 3] + 0.875 * (path[:, 0, 3] - path[0, 0, 3])
    slower[:, 1, 3] += 0.8
    crossing = recorded.frames(path)
    height, width, disparity_px = 64, 84, round(RIG.focal_px * RIG.baseline_m / 1.6)
    for one, other, pose in zip(crossing, recorded.frames(slower), slower, strict=True):
        travelled_px = RIG.focal_px * (pose[0, 3] - path[0, 0, 3]) / 1.6
        start = round((120 - travelled_px) % (RIG.width_px + width)) - width
        for shown, hidden, shift in ((one.left, other.left, 0), (one.right, other.right, disparity_px)):
            columns = slice(max(start - shift, 0), max(start - shift + width, 0))
            shown[50 : 50 + height, columns] = hidden[50 : 50 + height, columns]
    folder = recorded.write_euroc(tmp_path / "set", crossing, path)
    found = twin.replay(folder, tmp_path / "run", ReplayOptions(outputs=())).metrics
    errors_m = [found["trajectory"][name]["ate_rmse_m"] for name in ("final", "online")]
    assert found["status"] == "complete" and errors_m[0] < 1.05 * errors_m[1] < 0.004
    assert found["consistency"]["nees_position_mean"] < 4 * 3  # sigmas at most twice too small


def test_the_truth_is_sorted_and_of_equal_times_the_first_pose_counts():
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = [2, 0, 1, 9]
    found = opened_dataset._ordered(Trajectory(np.array([2.0, 0.0, 1.0, 1.0]), poses), "truth.txt")
    np.testing.assert_array_equal(found.times_s, [0, 1, 2])
    np.testing.assert_array_equal(found.positions[:, 0], [0, 1, 2])
    poses[2, 1, 3] = 1e200
    with pytest.raises(TwinError, match=r"truth.txt: a coordinate of a true position is 1e.200 m"):
        opened_dataset._ordered(Trajectory(np.arange(4.0), poses), "truth.txt")


def test_topics_of_a_data_set_that_is_no_bag_are_refused(euroc):
    with pytest.raises(TwinError, match="--topics: .* is not a ROS 2 bag"):
        open_dataset(euroc, ReplayOptions(topics=("/a", "/b")))


def test_a_recording_of_one_place_with_a_noisy_truth_is_complete_without_a_warning_on_the_truth(tmp_path):
    still = np.repeat(recorded.poses(1), 20, axis=0)
    folder = recorded.write_folder(tmp_path / "set", recorded.frames(still))
    rng = np.random.default_rng(1)
    w, x, y, z = geometry.quaternion_wxyz(still[0, :3, :3])
    positions = still[:, :3, 3] + 1e-3 * rng.normal(size=(20, 3))
    rows = [[100 + k / RIG.frame_rate_hz, *position, x, y, z, w] for k, position in enumerate(positions)]
    np.savetxt(tmp_path / "truth.txt", rows, fmt="%.9f")
    found = twin.replay(folder, tmp_path / "out", ReplayOptions(outputs=(), truth=tmp_path / "truth.txt")).metrics
    assert found["status"] == "complete" and not [one for one in found["warnings"] if "truth" in one]


def test_a_range_of_frames_is_replayed_with_its_own_times_and_true_poses(euroc, replayed, tmp_path):
    part = twin.replay(euroc, tmp_path / "run", ReplayOptions(frames=frame_numbers("2::3"), outputs=()))
    whole, n = replayed.result.final, len(PATH[2::3])
    assert part.metrics["timing"]["frames"] == part.metrics["replay"]["frames_with_truth"] == n
    np.testing.assert_allclose(part.result.final.times_s, whole.times_s[2::3] - whole.times_s[2], atol=1e-6)
    assert part.metrics["trajectory"]["final"]["ate_max_m"] < 0.003


@pytest.mark.parametrize("text", ["3", "a:b", "1:2:3:4", "-1:3", "0:9:0"])
def test_a_text_that_is_no_range_of_frames_is_one_line(text):
    with pytest.raises(TwinError, match="--frames: .* is no range of frames"):
        frame_numbers(text)


def test_a_range_without_frames_is_one_line(euroc):
    with pytest.raises(TwinError, match="no frame of the data set is in this range"):
        open_dataset(euroc, ReplayOptions(frames=slice(100, 200)))
