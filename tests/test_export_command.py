"""Recorded frames are kept without loss, read back from the run folder, and their truth is that of the images."""

import csv
import importlib
import json
import shutil
from dataclasses import replace

import cv2
import exported_run as made
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from twin.core import geometry
from twin.core.records import Frame, ImuReadings, Readings, StereoRig, Trajectory
from twin.core.timing import Stopwatch
from twin.errors import TwinError
from twin.exchange import geotiff
from twin.exports.command import ExportOptions, export, run_contents
from twin.exports.formats import FORMATS
from twin.exports.true_layers import floor_normals, optical_flow
from twin.report.frame_recorder import EXPOSURE_COLUMNS, IMU_COLUMNS, FrameRecorder, remove_keyframe_images
from twin.report.run_folder import load_run
from twin.scenario.file import dump_toml
from twin.scenario.model import Scenario
from twin.terrains.terrain import Terrain

RIG = StereoRig(40, 30, 35.0, 0.1)
SCENARIO = {
    "seed": 3,
    "terrain": {"kind": "ripples", "size_m": [4.0, 4.0], "relief_m": 0.3},
    "rig": {"image_width_px": 96, "image_height_px": 72, "frame_rate_hz": 5.0},
    "vehicle": {"dynamics": "kinematic"},
    "lamps": [{"position_m": [0.25, 0.3, -0.05]}],
    "plan": {"area_m": [1.0, 0.4], "tracks": 1, "altitude_m": 1.5},
    "objects": [{"shape": "boulder", "size_m": 0.4, "position_m": [-0.4, 0.1]}],
}

RIGID = SCENARIO | {"vehicle": {"dynamics": "rigid"}, "navigation": {"aiding": ["pressure"]}}


def frame(index, stereo):
    rng = np.random.default_rng(index)
    left, right = rng.integers(0, 255, (2, 30, 40, 3), dtype=np.uint8)
    readings = Readings(1.5 + index / 3, None, np.array([0.1, 0.2, index / 7]))
    return Frame(index, index / 3, left, right if stereo else None, readings, stereo, (0.1, 0.2, index / 9))


def run_folder(folder, scenario):
    """Writes the files that a finished run of a scenario has besides its frames."""
    folder.mkdir(exist_ok=True)
    (folder / "scenario.resolved.toml").write_text(dump_toml(scenario))
    (folder / "keyframes").mkdir(exist_ok=True)
    (folder / "keyframes" / "index.json").write_text(json.dumps({"frames": [0, 2], "tracks": [1, 1]}))
    return folder


def test_recorded_frames_are_read_back_without_loss(tmp_path):
    frames = [frame(k, k % 2 == 0) for k in range(4)]
    with FrameRecorder(run_folder(tmp_path, Scenario()), "all") as recorder:
        for one in frames:
            recorder.add(one, geometry.pose(np.eye(3), np.array([one.index, 0, 1 / 3])), np.zeros(6))
    contents = run_contents(tmp_path)
    assert [f.index for f in contents.frames] == [0, 1, 2, 3] and [f.index for f in contents.pairs] == [0, 2]
    assert [f.keyframe for f in contents.frames] == [True, False, True, False]
    listed = csv.DictReader((tmp_path / "frames" / "frames.csv").read_text().splitlines())
    assert [tuple(float(row[name]) for name in EXPOSURE_COLUMNS) for row in listed] == [f.exposure for f in frames]
    for one, read in zip(frames, contents.frames, strict=True):
        assert read.time_s == one.time_s
        assert read.readings.pressure_z_m == one.readings.pressure_z_m and read.readings.ahrs_rpy_rad is None
        np.testing.assert_array_equal(read.readings.dvl_mps, one.readings.dvl_mps)
        np.testing.assert_array_equal(cv2.imread(str(read.left), cv2.IMREAD_COLOR_RGB), one.left)
        if one.right is not None:
            np.testing.assert_array_equal(cv2.imread(str(read.right), cv2.IMREAD_COLOR_RGB), one.right)
    poses = np.load(tmp_path / "frames" / "truth.npz")["world_from_camera"]
    assert poses.shape == (4, 4, 4) and poses[1, 2, 3] == 1 / 3


@pytest.mark.parametrize("tilt_deg", [None, 60.0])
def test_exported_points_are_in_world_axes_for_a_map_in_the_plane_of_a_tilted_rig(tilt_deg, tmp_path):
    """None: a run folder without the pose of its map, whose frame is then the world."""
    pose = geometry.pose(geometry.so3_exp(np.array([np.deg2rad(tilt_deg or 0), 0, 0])), np.array([0.3, -0.2, 1.0]))
    folder = run_folder(tmp_path / "run", Scenario())
    geotiff.write_map(folder, replace(made.elevation(), map_from_world=pose))
    index = {"frames": [0, 2], "tracks": [1, 1]} | ({} if tilt_deg is None else {"map_from_world": pose.tolist()})
    (folder / "keyframes" / "index.json").write_text(json.dumps(index))
    written = export(folder, ["ply", "obj"], tmp_path / "out")
    map_from_world = np.eye(4) if tilt_deg is None else pose
    for name, path in (("ply", written["ply"][0]), ("obj", tmp_path / "out" / "obj" / "map.obj")):
        vertices = trimesh.load(path, process=False).vertices
        x, y, z = geometry.transform(map_from_world, np.asarray(vertices)).T
        np.testing.assert_allclose(z, made.height_at(x, y), atol=1e-5, err_msg=name)


def test_readings_of_the_imu_are_recorded_frame_by_frame_without_loss(tmp_path):
    rng = np.random.default_rng(0)
    given = [ImuReadings(np.arange(4 * k, 4 * k + 4) / 120, rng.normal(size=(4, 3)), rng.normal(size=(4, 3)))
             for k in range(3)]  # fmt: skip
    with FrameRecorder(tmp_path, "keyframes") as recorder:
        for k, one in enumerate(given):
            seen = frame(k, True)
            recorder.add(replace(seen, readings=replace(seen.readings, imu=one)), np.eye(4), np.zeros(6))
    lines = (tmp_path / "frames" / "imu.csv").read_text().splitlines()
    assert lines[0] == ",".join(IMU_COLUMNS)
    table = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
    np.testing.assert_array_equal(table, np.vstack([np.column_stack(one) for one in given]))


@pytest.fixture
def run_with_imu(tmp_path):
    """Returns the folder of a run with three frames and an IMU, and the readings of the IMU."""
    rng = np.random.default_rng(0)
    parts = [ImuReadings(np.arange(4 * k, 4 * k + 4) / 120, rng.normal(size=(4, 3)), rng.normal(size=(4, 3)))
             for k in range(3)]  # fmt: skip
    scenario = Scenario.model_validate({"imu": {"gyroscope_noise_density": 1e-3}})
    with FrameRecorder(run_folder(tmp_path / "run", scenario), "all") as recorder:
        for k, one in enumerate(parts):
            seen = frame(k, True)
            recorder.add(replace(seen, readings=replace(seen.readings, imu=one)), np.eye(4), np.zeros(6))
    return tmp_path / "run", ImuReadings(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def test_an_export_has_the_readings_of_the_imu_without_loss(run_with_imu, tmp_path):
    folder, given = run_with_imu
    imu = run_contents(folder).imu
    assert imu is not None and imu.rate_hz == pytest.approx(120.0)
    assert imu.noise.gyroscope_noise_density == 1e-3 and imu.noise.accelerometer_noise_density == 2e-3
    for expected, read in zip(given, imu.readings, strict=True):
        np.testing.assert_array_equal(read, expected)
    export(folder, ["euroc"], tmp_path / "out")
    table = np.loadtxt(tmp_path / "out" / "euroc" / "mav0" / "imu0" / "data.csv", delimiter=",")
    np.testing.assert_array_equal(table[:, 1:], np.hstack(given[1:]))
    (folder / "frames" / "imu.csv").unlink()
    assert run_contents(folder).imu is None


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda text: text[:-30], "imu.csv: cannot be read: line 13 is incomplete"),
        (lambda text: "", "imu.csv: cannot be read: its first line is ''"),
        (lambda text: text.replace("rate_x", "rate_q"), "imu.csv: cannot be read: its first line is 'time_s,rate_q"),
        (lambda text: text.replace("\n0.0,", "\nnan,"), "line 2 has a value that is not finite"),
        (lambda text: text.replace("\n0.025,", "\n0.005,"), "line 5: time_s is 0.005, not larger than before"),
        (lambda text: text[:-70] + "\n1e300,0,0,0,0,0,0\n", "imu.csv: cannot be read: line .*"),
        (lambda text: text.replace("\n0.025,", "\nx,"), "imu.csv: cannot be read: could not convert string"),
    ],
)
def test_damaged_readings_of_the_imu_are_refused(run_with_imu, change, problem):
    file = run_with_imu[0] / "frames" / "imu.csv"
    file.write_text(change(file.read_text()))
    with pytest.raises(TwinError, match=problem):
        run_contents(run_with_imu[0])


def test_readings_of_an_imu_that_the_scenario_does_not_have_are_refused(run_with_imu):
    (run_with_imu[0] / "scenario.resolved.toml").write_text(dump_toml(Scenario()))
    with pytest.raises(
        TwinError, match=r"imu.csv: belongs to no sensor: scenario.resolved.toml has no section \[imu\]"
    ):
        run_contents(run_with_imu[0])


def test_an_imu_does_not_change_the_flight_and_its_readings_reach_the_frames():
    from twin.world.mission import prepare
    from twin.world.rendered_world import RenderedWorld

    frames = []
    for section in ({}, {"imu": {"rate_hz": 60.0}}):
        mission = prepare(Scenario.model_validate(RIGID | section))
        with RenderedWorld(mission, Stopwatch()) as world:
            sequence = mission.planned_frames(1)
            world.start_sequence(sequence)
            found = []
            for k in range(3):
                found.append((world.observe(sequence[k]), world.vehicle.world_from_body))
                world.act(np.full(8, 0.3))
            frames.append(found)
    for (plain, plain_pose), (fitted, pose) in zip(*frames, strict=True):
        np.testing.assert_array_equal(plain.left, fitted.left)
        np.testing.assert_array_equal(plain_pose, pose)
        assert plain.readings.imu is None and plain.readings.pressure_z_m == fitted.readings.pressure_z_m
    times_s = [one.readings.imu.times_s for one, _ in frames[1]]
    np.testing.assert_allclose(times_s[0], [0.0])
    np.testing.assert_allclose(times_s[1], np.arange(1, 13) / 60)
    np.testing.assert_allclose(times_s[2], np.arange(13, 25) / 60)


def test_an_image_that_cannot_be_written_is_an_error_at_a_later_frame(tmp_path):
    with pytest.raises(OSError, match="left"), FrameRecorder(tmp_path, "all") as recorder:
        (tmp_path / "frames" / "left").rename(tmp_path / "frames" / "moved")
        for k in range(20):
            recorder.add(frame(k, False), np.eye(4), np.zeros(6))


def test_a_last_image_that_cannot_be_written_is_an_error_at_the_end(tmp_path):
    with pytest.raises(OSError, match="left"), FrameRecorder(tmp_path, "all") as recorder:
        (tmp_path / "frames" / "left").rename(tmp_path / "frames" / "moved")
        recorder.add(frame(0, False), np.eye(4), np.zeros(6))
    assert (tmp_path / "frames" / "truth.npz").is_file()


def test_nothing_is_recorded_on_request(tmp_path):
    with FrameRecorder(tmp_path, "none") as recorder:
        recorder.add(frame(0, True), np.eye(4), np.zeros(6))
    assert not (tmp_path / "frames").exists()
    run_folder(tmp_path, Scenario())
    (tmp_path / "keyframes" / "000000_left.png").write_bytes(b"image")
    remove_keyframe_images(tmp_path)
    assert [file.name for file in (tmp_path / "keyframes").iterdir()] == ["index.json"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (ExportOptions(crs="EPSG:32633"), "--crs: is given without --origin"),
        (ExportOptions("EPSG:32633", "1,x"), "--origin: '1,x' is not a position"),
        (ExportOptions("EPSG:4326", "1,2"), "--crs: 'EPSG:4326' is not a projected CRS"),
        (ExportOptions("EPSG:nonsense", "1,2"), "--crs: 'EPSG:nonsense' is not a CRS"),
        (ExportOptions(jpeg_quality=0), "--jpeg: 0 is not a quality"),
    ],
)
def test_options_that_are_not_valid_are_refused(options, message, tmp_path):
    with pytest.raises(TwinError, match=message):
        run_contents(run_folder(tmp_path, Scenario()), options)


def test_a_damaged_list_of_frames_is_refused(tmp_path):
    with FrameRecorder(run_folder(tmp_path, Scenario()), "all") as recorder:
        recorder.add(frame(0, True), np.eye(4), np.zeros(6))
    table = tmp_path / "frames" / "frames.csv"
    table.write_text(table.read_text().replace("time_s", "clock"))
    with pytest.raises(TwinError, match="frames.csv: cannot be read"):
        run_contents(tmp_path)


@pytest.mark.parametrize("kept", [0, 100])
def test_a_truncated_file_of_true_poses_is_refused(kept, tmp_path):
    with FrameRecorder(run_folder(tmp_path, Scenario()), "all") as recorder:
        for k in range(3):
            recorder.add(frame(k, True), np.eye(4), np.zeros(6))
    poses = tmp_path / "frames" / "truth.npz"
    poses.write_bytes(poses.read_bytes()[:kept])
    with pytest.raises(TwinError, match="truth.npz: cannot be read"):
        export(tmp_path, ["truth"], tmp_path / "out")


def test_the_scenario_key_record_does_not_change_the_fingerprint():
    assert Scenario(record="all").fingerprint() == Scenario().fingerprint() != Scenario(seed=1).fingerprint()


def test_normals_of_a_tilted_floor_are_those_of_its_plane():
    y, x = np.mgrid[-2:2.01:0.1, -2:2.01:0.1]
    terrain = Terrain((0.3 * x - 0.1 * y).astype(np.float32), 0.1, -2.0, -2.0, np.zeros((4, 4, 3), np.uint8), 1.0)
    pose = geometry.pose(geometry.rotations_of_down_camera(np.array(0.4)), np.array([0.1, 0.2, 1.0]))
    depth = np.full((30, 40), 0.9, np.float32)
    depth[0, 0] = np.inf
    normals = floor_normals(terrain, depth, pose, RIG)
    expected = pose[:3, :3].T @ np.array([-0.3, 0.1, 1.0]) / np.linalg.norm([0.3, 0.1, 1.0])
    np.testing.assert_allclose(normals[1:].reshape(-1, 3), np.tile(expected, (29 * 40, 1)), atol=1e-5)
    assert not normals[0, 0].any()


def test_flow_over_a_plane_is_its_closed_form_and_hidden_points_have_none():
    depth = np.full((30, 40), 2.0, np.float32)
    moved = geometry.pose(np.eye(3), np.array([-0.4, 0.2, 0.0]))  # the camera moves right and up
    flow = optical_flow(depth, depth, moved, RIG)
    inside = np.isfinite(flow).all(axis=2)
    np.testing.assert_allclose(flow[inside], np.tile([-7.0, 3.5], (inside.sum(), 1)), atol=1e-5)
    assert inside[:26, 7:].all() and not inside[:, :6].any() and not inside[28:].any()
    near = depth.copy()
    near[10:20, 10:20] = 1.0  # an obstacle in the next image alone
    hidden = ~np.isfinite(optical_flow(depth, near, moved, RIG)).all(axis=2) & inside
    assert hidden[8:14, 19:26].all()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Returns the folder of a run with three rendered frames."""
    from twin.world.mission import prepare
    from twin.world.rendered_world import RenderedWorld

    scenario = Scenario.model_validate(SCENARIO)
    folder = run_folder(tmp_path_factory.mktemp("run"), scenario)
    mission = prepare(scenario)
    with RenderedWorld(mission, Stopwatch()) as world, FrameRecorder(folder, "all") as recorder:
        sequence = mission.planned_frames(1)
        world.start_sequence(sequence)
        for k in range(3):
            recorder.add(world.observe(sequence[k]), world.world_from_camera, world.vehicle.twist_body)
            world.act(np.array([1.0, 0.1, 0.0, 0.2]))
        path = Trajectory(np.arange(3) / 5.0, world.truth().trajectory.world_from_camera)
    path.save(folder / "trajectory_truth.tum")
    return folder


def test_right_images_between_keyframes_are_recorded_without_an_effect_on_any_other_image():
    from twin.world.mission import prepare
    from twin.world.rendered_world import RenderedWorld

    mission, found = prepare(Scenario.model_validate(SCENARIO)), []
    for records in (False, True):
        with RenderedWorld(mission, Stopwatch()) as world:
            sequence, images = mission.planned_frames(1), []
            world.start_sequence(sequence)
            for k in range(3):
                frame = world.observe(sequence[k]._replace(keyframe=k == 2))
                if frame.right is None and records:
                    pair = world.extra_pair()
                    right = world.right_image()
                    difference = np.abs(right.astype(int) - pair[1].astype(int))
                    assert difference.mean() < 3.5  # grey levels: independent noise of about 2 in each
                    assert np.abs(right.astype(int) - frame.left.astype(int)).mean() > 4 * difference.mean()
                images += [frame.left] if frame.right is None else [frame.left, frame.right]
                world.act(np.array([1.0, 0.1, 0.0, 0.2]))
            found.append(images)
    assert all(np.array_equal(one, other) for one, other in zip(*found, strict=True)) and len(found[0]) == 4


def test_the_world_rendered_again_gives_the_recorded_images_and_their_truth(recorded, tmp_path):
    export(recorded, ["truth"], tmp_path)
    folder = tmp_path / "truth"
    index = json.loads((folder / "index.json").read_text())
    assert index["rerendered"]["identical"] == index["rerendered"]["compared_with_noise"] == 3
    assert index["objects"] == {"1": "boulder (objects.0)"}
    depth, later = (cv2.imread(str(folder / "depth" / f"{k:06d}.tiff"), cv2.IMREAD_UNCHANGED) for k in (0, 1))
    millimetres = cv2.imread(str(folder / "depth_mm" / "000000.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(millimetres / 1000, depth, atol=0.5001e-3)
    flow = cv2.readOpticalFlow(str(folder / "flow" / "000000.flo"))
    assert np.nanmax(np.abs(flow)) > 3 and not (folder / "flow" / "000002.flo").exists()
    albedo, shown = (cv2.imread(str(folder / "albedo" / f"{k:06d}.png")).astype(np.float32) for k in (0, 1))
    position = np.stack(np.meshgrid(np.arange(96), np.arange(72)), -1).astype(np.float32) + flow
    warped = cv2.remap(shown, position, None, cv2.INTER_LINEAR)
    seen = np.isfinite(flow).all(axis=2)
    texture = np.std(albedo[seen])
    assert np.median(np.abs(warped - albedo)[seen]) < 0.15 * texture < np.median(np.abs(shown - albedo)[seen])
    labels = cv2.imread(str(folder / "labels" / "000000.png"), cv2.IMREAD_UNCHANGED)
    assert set(np.unique(labels)) == {0, 1} and later.shape == labels.shape


@pytest.mark.long
@pytest.mark.parametrize(("jpeg_quality", "limit_m"), [(None, 0.001), (90, 0.003)])
def test_an_exported_survey_is_replayed_to_the_same_path(flown, jpeg_quality, limit_m, tmp_path):
    import twin
    from twin.recordings.replay import ReplayOptions

    export(flown, ["euroc"], tmp_path, ExportOptions(jpeg_quality=jpeg_quality))
    replayed = twin.replay(tmp_path / "euroc", tmp_path / "run", ReplayOptions(outputs=()))
    online = Trajectory.load(flown / "trajectory_final.tum").positions
    path = replayed.result.final.positions
    shift, centre = online.mean(axis=0), path.mean(axis=0)
    rotation, _ = Rotation.align_vectors(online - shift, path - centre)
    difference_m = np.linalg.norm(rotation.apply(path - centre) + shift - online, axis=1)
    assert np.sqrt(np.mean(difference_m**2)) < limit_m
    if jpeg_quality is None:  # the export has the true heights beside the true poses; all mapped cells count
        le90_m = json.loads((flown / "metrics.json").read_text())["map"]["le90_m"]
        assert replayed.metrics["map"]["le90_m"] < 1.1 * le90_m


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Returns the folder of a flown survey with the images of all frames."""
    from twin import survey
    from twin.scenario.file import load_scenario

    scenario = load_scenario("reef", ["plan.area_m=[2.0,1.0]", "rig.frame_rate_hz=10", "record=all"])
    return survey.run(scenario, tmp_path_factory.mktemp("flown") / "run", outputs=()).folder


@pytest.mark.long
def test_a_survey_with_an_imu_and_without_attitude_is_replayed_level_within_its_sigma(tmp_path):
    """The floor of the first view is tilted by 4 degrees; the bias of the accelerometer has a sigma of 1.15 degrees.

    Pressure alone cannot level the world, but with the vertical it does: 0.01 m over 2 m, many times, is 0.1 degrees.
    """
    import twin
    from twin import survey
    from twin.recordings.replay import ReplayOptions
    from twin.scenario.file import load_scenario

    keys = ["plan.area_m=[2.0,1.0]", "rig.frame_rate_hz=10", "record=all", 'navigation.aiding=["pressure"]', "imu={}"]
    run = survey.run(load_scenario("reef", keys), tmp_path / "run", outputs=()).folder
    export(run, ["euroc"], tmp_path)
    true = Trajectory.load(run / "trajectory_truth.tum").world_from_camera

    def errors(name, **options):
        """Returns the largest tilt [rad], its sigma [rad], the RMS height error [m] and its sigma [m] of a replay."""
        found = twin.replay(tmp_path / "euroc", tmp_path / name, ReplayOptions(outputs=(), **options)).result
        path = found.final.world_from_camera
        height_m = path[:, 2, 3] - true[:, 2, 3]
        tilt = np.linalg.norm(np.cross(path[:, 2, :3], true[:, 2, :3]), axis=1)
        up = path[found.keyframe_rows, 2, :3]
        height_sigma_m = np.sqrt(np.einsum("ni,nij,nj->n", up, found.node_cov[:, 3:, 3:], up).mean())
        return tilt.max(), np.sqrt(found.node_cov[0, :2, :2].trace()), height_m.std(), height_sigma_m

    alone, with_pressure = errors("alone", aiding=False), errors("both")
    (tmp_path / "euroc" / "mav0" / "pressure0" / "data.csv").unlink()
    level = errors("level")
    assert level[0] < 3 * level[1] and with_pressure[0] < 3 * with_pressure[1]
    assert with_pressure[0] < np.deg2rad(0.5) < level[0] < alone[0]
    assert with_pressure[2] < level[2] < alone[2]
    assert with_pressure[2] < 3 * with_pressure[3] < 3 * level[3]


@pytest.fixture
def recorded_run(tmp_path):
    """Returns the folder of a run with three recorded frames."""
    folder = run_folder(tmp_path / "run", Scenario())
    with FrameRecorder(folder, "all") as recorder:
        for k in range(3):
            recorder.add(frame(k, k % 2 == 0), np.eye(4), np.zeros(6))
    return folder


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_an_interrupted_export_leaves_no_data_set(recorded_run, tmp_path, error):
    def fail(_, fraction):
        if fraction > 0.5:
            raise error

    with pytest.raises(error):
        export(recorded_run, ["kitti"], tmp_path / "out", progress=fail)
    assert not (tmp_path / "out").exists()
    (tmp_path / "out" / ".kitti.partial").mkdir(parents=True)  # as an export that was killed leaves it
    written = export(recorded_run, ["kitti"], tmp_path / "out")
    assert [path.is_dir() for path in written["kitti"]] == [True]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["kitti"]


def test_an_export_is_not_mixed_with_other_files(recorded_run, tmp_path):
    (tmp_path / "out" / "kitti" / "image_2").mkdir(parents=True)
    with pytest.raises(TwinError, match="kitti is not empty"):
        export(recorded_run, ["calibration", "kitti"], tmp_path / "out")
    assert not (tmp_path / "out" / "calibration").exists()


@pytest.mark.parametrize("quality", [None, 90])
@pytest.mark.parametrize("name", ["euroc", "mcap"])
def test_a_truncated_image_of_the_run_is_named(recorded_run, tmp_path, name, quality):
    image = recorded_run / "frames" / "left" / "000001.png"
    image.write_bytes(image.read_bytes()[:-20])
    with pytest.raises(TwinError, match=r"left/000001.png: is truncated or not a PNG"):
        export(recorded_run, [name], tmp_path / "out", ExportOptions(jpeg_quality=quality))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("kept", "message"), [(3, "has no line for the keyframe 2"), (3.5, "frame 2 is incomplete")])
def test_a_truncated_list_of_frames_is_refused(recorded_run, tmp_path, kept, message):
    table = recorded_run / "frames" / "frames.csv"
    lines = table.read_text().splitlines(keepends=True)
    table.write_text("".join(lines[: int(kept)]) + (lines[3][:20] if kept % 1 else ""))
    with pytest.raises(TwinError, match=message):
        export(recorded_run, ["euroc"], tmp_path / "out")


@pytest.mark.parametrize("name", ["colmap", "nerfstudio", "ifdo", "metashape"])
def test_images_of_a_killed_run_are_exported_and_formats_with_poses_are_refused(recorded_run, tmp_path, name):
    """A process that is killed leaves images, but no trajectories."""
    with pytest.raises(TwinError, match=rf"--to {name}: .* has neither a true nor a final trajectory"):
        export(recorded_run, ["euroc", name], tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (written,) = export(recorded_run, ["euroc"], tmp_path / "out")["euroc"]
    assert len(list((written / "cam0" / "data").iterdir())) == 3


def changed_line(number, column, value):
    """Returns a function that replaces one cell of a table."""

    def change(text):
        lines = text.splitlines()
        cells = lines[number - 1].split(",")
        cells[column] = value
        lines[number - 1] = ",".join(cells)
        return "\n".join(lines) + "\n"

    return change


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (changed_line(3, 1, "nan"), "line 3: time_s is nan, not larger than before and from 0 to 1e"),
        (changed_line(3, 1, "inf"), "line 3: time_s is inf"),
        (changed_line(3, 1, "1e18"), "line 3: time_s is 1e.18"),
        (changed_line(2, 1, "-5"), "line 2: time_s is -5"),
        (changed_line(3, 1, "0.0"), "line 3: time_s is 0"),
        (changed_line(3, 0, "0"), "line 3: index is 0"),
        (changed_line(2, 0, "-1"), "line 2: index is -1"),
        (changed_line(3, 6, "nan"), "nan is not a finite number"),
        (lambda text: text.replace("time_s", "clock"), "the column time_s is missing"),
    ],
)
def test_impossible_values_in_the_list_of_frames_are_refused(recorded_run, change, problem):
    table = recorded_run / "frames" / "frames.csv"
    table.write_text(change(table.read_text()))
    with pytest.raises(TwinError, match=f"frames.csv: cannot be read: {problem}"):
        run_contents(recorded_run)


def test_a_list_of_frames_with_a_byte_order_mark_is_read(recorded_run):
    table = recorded_run / "frames" / "frames.csv"
    table.write_bytes(b"\xef\xbb\xbf" + table.read_bytes())
    assert len(run_contents(recorded_run).frames) == 3


@pytest.mark.parametrize("name", ["truth", "final"])
def test_a_trajectory_with_too_few_or_unordered_poses_is_refused(recorded_run, name):
    file = recorded_run / f"trajectory_{name}.tum"
    Trajectory(np.arange(2) / 3, np.tile(np.eye(4), (2, 1, 1))).save(file)
    with pytest.raises(TwinError, match=f"trajectory_{name}.tum: has 2 poses .allowed: 3, one per frame"):
        run_contents(recorded_run)
    Trajectory(np.array([0.0, 0.5, 0.5]), np.tile(np.eye(4), (3, 1, 1))).save(file)
    with pytest.raises(TwinError, match=f"trajectory_{name}.tum: has times that do not increase"):
        run_contents(recorded_run)


def test_files_that_are_missing_in_a_run_folder_are_named(recorded_run, tmp_path):
    (recorded_run / "scenario.resolved.toml").write_text(
        dump_toml(Scenario.model_validate({"record": "all", "imu": {}}))
    )
    (recorded_run / "frames" / "left" / "000001.png").unlink()
    found: list[str] = []
    export(recorded_run, ["euroc"], tmp_path / "out", warn=found.append)
    assert [note.replace(str(recorded_run), "RUN") for note in found] == [
        "1 of 3 left images of RUN are missing; their frames are left out.",
        "RUN/frames/imu.csv is missing: the readings of the IMU are not exported.",
    ]
    (recorded_run / "frames" / "right" / "000002.png").unlink()
    (recorded_run / "frames" / "frames.csv").unlink()
    assert "frames.csv is missing" in run_contents(recorded_run).notes[0]


def test_a_complete_run_folder_has_no_notes(recorded_run):
    (recorded_run / "scenario.resolved.toml").write_text(dump_toml(Scenario(record="all")))
    assert run_contents(recorded_run).notes == ()


def test_a_file_in_place_of_the_hidden_folder_is_named(recorded_run, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".euroc.partial").write_text("mine")
    with pytest.raises(TwinError, match=r"--out: .*\.euroc\.partial is in the way"):
        export(recorded_run, ["euroc"], tmp_path / "out")
    assert (tmp_path / "out" / ".euroc.partial").read_text() == "mine"


@pytest.mark.parametrize("origin", ["1e300,1e300", "1e9,1e9", "4e7,1"])
def test_an_origin_outside_its_crs_is_refused(recorded_run, origin):
    with pytest.raises(TwinError, match="--origin: .* is outside the CRS"):
        run_contents(recorded_run, ExportOptions("EPSG:32633", origin))


def test_an_image_of_another_size_has_no_true_layers(recorded, tmp_path):
    shutil.copytree(recorded, tmp_path / "run")
    image = tmp_path / "run" / "frames" / "left" / "000000.png"
    cv2.imwrite(str(image), cv2.imread(str(image))[:50, :60])
    with pytest.raises(TwinError, match=r"left/000000.png: is 60 x 50 px .allowed: 96 x 72 px"):
        export(tmp_path / "run", ["truth"], tmp_path / "out")


@pytest.mark.parametrize("name", FORMATS)
def test_the_writer_of_every_format_is_found(name):
    module, function = FORMATS[name].writer.split(":")
    assert callable(getattr(importlib.import_module(f"twin.{module}"), function))


def test_images_along_a_path_show_the_floor_from_its_poses(tmp_path):
    """The images of a pose are those that a world captures there, at rest; between poses the motion is uniform."""
    from twin.exports.rendered_path import render_path
    from twin.world.mission import prepare
    from twin.world.rendered_world import RenderedWorld

    scenario = Scenario.model_validate(SCENARIO)
    first = prepare(scenario).start_of_body @ scenario.believed_rig().body_from_camera
    moved = first @ geometry.exp(np.array([0.0, 0.0, 0.2, 0.1, 0.05, 0.0]))
    path = Trajectory(np.array([7.0, 7.6, 8.0]), np.array([first, moved, moved]))
    path.save(tmp_path / "path.tum", digits=12)
    assert render_path(scenario, tmp_path / "path.tum", tmp_path / "run", lambda _: None) == 6  # at 5 Hz
    run = load_run(tmp_path / "run")
    np.testing.assert_allclose(run.trajectories["truth"].times_s, np.arange(6) / 5)
    third = geometry.log(geometry.inverse(first) @ run.trajectories["truth"].world_from_camera[1])
    np.testing.assert_allclose(
        third, np.array([0.0, 0.0, 0.2, 0.1, 0.05, 0.0]) / 3, atol=1e-7
    )  # 7 decimals are written
    with RenderedWorld(prepare(scenario), Stopwatch()) as world:
        for _ in range(6):
            seen = world.camera.capture(moved, True)
    for side, image in (("left", seen.left), ("right", seen.right)):
        recorded = cv2.imread(str(tmp_path / "run" / "frames" / side / "000005.png"), cv2.IMREAD_COLOR_RGB)
        assert np.abs(recorded.astype(int) - image.astype(int)).mean() < 0.6
    written = export(tmp_path / "run", ["truth"], tmp_path)
    assert written and (tmp_path / "truth" / "depth" / "000005.tiff").is_file()
    below, outside = path.world_from_camera.copy(), path.world_from_camera.copy()
    below[:, 2, 3] -= 9.0
    outside[1:, 0, 3] += 1e4
    wrong = {
        "not over the terrain": Trajectory(path.times_s, outside),
        "above the floor": Trajectory(path.times_s, below),
        "do not increase": Trajectory(path.times_s[::-1].copy(), path.world_from_camera),
    }
    for problem, given in wrong.items():
        given.save(tmp_path / "wrong.tum")
        with pytest.raises(TwinError, match=problem):
            render_path(scenario, tmp_path / "wrong.tum", tmp_path / "wrong", lambda _: None)
