"""Exported data sets: other programs and our own readers find images, poses and calibration where they were."""

import csv
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import rasterio.warp
import yaml
from ifdo import iFDO
from physics_world import vehicle
from scipy.spatial.transform import Rotation

from twin.core import geometry
from twin.core.georeference import Georeference
from twin.core.records import ElevationMap, ImuReadings, MapGrid, Readings, StereoRig, Trajectory
from twin.datasets import calibration_files, colmap, euroc, kitti, tum
from twin.datasets.calibration import rectified_calibration
from twin.datasets.calibration_files import read_calibration
from twin.datasets.readers import read_dataset
from twin.datasets.run_contents import ImuNoise, RecordedFrame, RecordedImu, RunContents
from twin.errors import TwinError
from twin.exchange import geotiff
from twin.exports import ifdo, metashape, nerfstudio
from twin.exports.camera_models import true_calibration
from twin.exports.formats import FORMATS, check_needs, chosen_formats
from twin.exports.geographic_place import yaw_pitch_roll_deg
from twin.recordings.opened_dataset import ReplayOptions
from twin.recordings.rectification import rectification
from twin.scenario.model import Scenario

N = 5
RIG = StereoRig(64, 48, 55.0, 0.12, 5.0, geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.1, 0.06, -0.2])))


def poses():
    """Returns poses of a camera that looks down at a slant and turns, without symmetry."""
    return np.array(
        [
            geometry.pose(
                geometry.rotations_of_down_camera(np.array(0.3 + 0.1 * k))
                @ geometry.so3_exp(np.array([0.1, -0.05, 0])),
                np.array([-0.4 + 0.2 * k, 0.1 * k, 2.0 + 0.02 * k]),
            )
            for k in range(N)
        ]
    )


@pytest.fixture
def contents(tmp_path):
    rng = np.random.default_rng(3)
    frames = []
    for k in range(N):
        files = [tmp_path / f"{side}{k}.png" for side in ("left", "right")]
        for file in files:
            cv2.imwrite(str(file), rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
        readings = Readings(2.0 + k, np.array([0.01, 0.02, 0.3 + k]))
        frames.append(RecordedFrame(k, k / 5.0, files[0], files[1], k % 2 == 0, readings))
    grid = MapGrid(-1.5, 1.8, 0.05, 70, 60)
    x, y = np.meshgrid(*grid.centres())
    height = (0.1 * x + 0.2 * np.sin(3 * y)).astype(np.float32)
    height[:5, :9] = np.nan
    elevation = ElevationMap(
        grid, height, np.full_like(height, 0.01), rng.integers(1, 255, (70, 60, 3), dtype=np.uint8)
    )
    path = Trajectory(np.arange(N) / 5.0, poses())
    shifted = Trajectory(path.times_s, geometry.pose(np.eye(3), np.array([0.01, 0, 0])) @ poses())
    believed = rectified_calibration(RIG)
    pose = geometry.pose(geometry.so3_exp(np.array([0.01, 0.02, -0.01])), np.array([0.121, 0, 0]))
    left = replace(believed.left, distortion=np.array([0.05, -0.02, 0.001, -0.002, 0.003]))
    true = replace(believed, left=left, right_from_left=geometry.inverse(pose))
    return RunContents(
        tmp_path, "run", {"name": "run"}, RIG, true, {"truth": path, "final": shifted}, tuple(frames), elevation,
    )  # fmt: skip


def test_colmap_reads_the_model_and_its_points_reproject_where_they_are_observed(contents, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    model, _ = colmap.export(contents, tmp_path)
    read = pycolmap.Reconstruction(str(model))
    assert (len(read.cameras), len(read.images), len(read.rigs)) == (2, 6, 1)
    assert len(read.points3D) > 300
    for image in read.images.values():
        for point in image.points2D:
            if point.has_point3D():
                xyz = read.points3D[point.point3D_id].xyz
                np.testing.assert_allclose(image.project_point(xyz), point.xy, atol=1e-4)  # written with 6 digits
    left, right = (
        next(i for i in read.images.values() if i.name == f"{side}/000002.png") for side in ("left", "right")
    )
    world_from_left = np.vstack([left.cam_from_world().inverse().matrix(), [0, 0, 0, 1]])
    np.testing.assert_allclose(world_from_left, poses()[2], atol=1e-12)
    relative = left.cam_from_world() * right.cam_from_world().inverse()
    np.testing.assert_allclose(relative.matrix(), contents.true.left_from_right[:3], atol=1e-12)


def test_points_outside_the_field_are_not_observed_where_the_distortion_folds_back():
    camera = replace(rectified_calibration(RIG).left, distortion=np.array([-0.2, 0.0, 0.0, 0.0, 0.0]))
    x, y = (part.ravel() for part in np.meshgrid(np.linspace(-9, 9, 181), np.linspace(-9, 9, 181)))
    points = np.column_stack([x, y, np.full(len(x), 2.0)])
    _, seen = colmap._observed(points, camera)
    width, height = camera.size_px
    in_field = (np.abs(points[seen, :2]) / 2.0 < [0.75 * width / RIG.fx_px, 0.75 * height / RIG.fy_px]).all(axis=1)
    assert len(seen) > 100 and in_field.all()


def test_points_triangulated_by_colmap_are_those_of_the_map(contents, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    model, _ = colmap.export(contents, tmp_path)
    read = pycolmap.Reconstruction(str(model))
    point = max(read.points3D.values(), key=lambda p: len(p.track.elements))
    images = [read.images[e.image_id] for e in point.track.elements]
    rays = [
        (image.projection_center(), image.cam_from_world().rotation.inverse() * np.append(
            image.camera.cam_from_img(image.points2D[e.point2D_idx].xy), 1.0))
        for image, e in zip(images, point.track.elements, strict=True)
    ]  # fmt: skip
    normal = sum(np.eye(3) - np.outer(d, d) / (d @ d) for _, d in rays)
    right = sum((np.eye(3) - np.outer(d, d) / (d @ d)) @ c for c, d in rays)
    np.testing.assert_allclose(np.linalg.solve(normal, right), point.xyz, atol=1e-5)  # pixels with 6 digits
    expected = contents.elevation
    x, y = expected.grid.centres()
    col, row = np.argmin(np.abs(x - point.xyz[0])), np.argmin(np.abs(y - point.xyz[1]))
    assert point.xyz[2] == pytest.approx(float(expected.height_m[row, col]), abs=1e-6)
    assert tuple(point.color) == tuple(expected.mosaic[row, col])


def test_evo_reads_the_trajectories(contents, tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    (tmp_path / "tum").mkdir()
    tum.export(contents, tmp_path / "tum")
    kitti.export(contents, tmp_path / "kitti")
    euroc.export(contents, tmp_path / "euroc")
    read = file_interface.read_tum_trajectory_file(tmp_path / "tum" / "groundtruth.txt")
    np.testing.assert_allclose(np.array(read.poses_se3), poses(), atol=1e-9)
    read = file_interface.read_kitti_poses_file(tmp_path / "kitti" / "poses" / "00.txt")
    np.testing.assert_allclose(np.array(read.poses_se3), np.linalg.inv(poses()[0]) @ poses(), atol=1e-9)
    truth = tmp_path / "euroc" / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    read = file_interface.read_euroc_csv_trajectory(truth)
    np.testing.assert_allclose(np.array(read.poses_se3) @ RIG.body_from_camera, poses(), atol=1e-9)
    np.testing.assert_allclose(read.timestamps, 1.0 + np.arange(N) / 5.0, atol=1e-9)


@pytest.mark.parametrize("writer", [euroc, kitti])
def test_our_readers_read_what_was_written(contents, writer, tmp_path):
    writer.export(contents, tmp_path / "set")
    folder = tmp_path / "set" if writer is euroc else tmp_path / "set" / "sequences" / "00"
    dataset, _ = read_dataset(folder)
    assert [cv2.imread(str(f.left)).tobytes() for f in dataset.images] == [
        cv2.imread(str(f.left)).tobytes() for f in contents.frames
    ]
    assert all(frame.right is not None for frame in dataset.images)
    calibration = dataset.calibration
    np.testing.assert_allclose(calibration.left.matrix, RIG.matrix)
    np.testing.assert_allclose(geometry.inverse(calibration.right_from_left), RIG.left_from_right, atol=1e-12)
    expected = poses() if writer is euroc else np.linalg.inv(poses()[0]) @ poses()
    np.testing.assert_allclose(dataset.truth.world_from_camera, expected, atol=1e-9)


def test_readings_are_written_with_their_times(contents, tmp_path):
    euroc.export(contents, tmp_path)
    rows = np.loadtxt(tmp_path / "mav0" / "pressure0" / "data.csv", delimiter=",")
    np.testing.assert_array_equal(rows, [[(1 + k / 5.0) * 1e9, 2.0 + k] for k in range(N)])
    assert not (tmp_path / "mav0" / "dvl0").exists()  # the vehicle has none


@pytest.mark.parametrize("name", ["opencv.yaml", "kalibr.yaml", "cameras.txt"])
def test_calibration_files_are_read_back(contents, name, tmp_path):
    calibration_files.export(contents, tmp_path)
    for kind, rig in (("believed", contents.believed), ("true", contents.true)):
        read = read_calibration(tmp_path / kind / name)
        np.testing.assert_allclose(read.left.matrix, rig.left.matrix)
        np.testing.assert_allclose(geometry.inverse(read.right_from_left), rig.left_from_right, atol=1e-12)
        kept = slice(2, 4) if name == "kalibr.yaml" else slice(min(len(read.left.distortion), 5))
        np.testing.assert_allclose(read.left.distortion[kept], rig.left.distortion[kept])


@pytest.mark.parametrize("k3", [0.003, 0.236, -0.1])
def test_the_distortion_of_kalibr_is_near_that_with_k3_in_the_whole_image(contents, k3, tmp_path):
    left = replace(contents.true.left, distortion=np.array([0.05, -0.02, 0.001, -0.002, k3]))
    calibration_files.export(replace(contents, true=replace(contents.true, left=left)), tmp_path)
    read = read_calibration(tmp_path / "true" / "kalibr.yaml").left
    half = np.array(left.size_px) / np.diag(left.matrix)[:2] / 2
    x, y = (part.ravel() for part in np.meshgrid(*(np.linspace(-side, side, 30) for side in half)))
    points = np.column_stack([x, y, np.ones(len(x))])
    dropped = replace(left, distortion=np.array([0.05, -0.02, 0.001, -0.002]))
    rms = [np.sqrt(np.mean((one.project(points) - left.project(points)) ** 2)) for one in (read, dropped)]
    assert rms[0] < 0.1 * rms[1]


def test_nerfstudio_poses_project_points_into_the_image_that_sees_them(contents, tmp_path):
    file, images = nerfstudio.export(replace(contents, true=None), tmp_path)
    assert images == tmp_path / "images" and images.is_dir()
    frame = next(f for f in json.loads(file.read_text())["frames"] if f["file_path"] == "images/right_000003.png")
    point = np.array([0.3, 0.4, 0.1])
    x, y, z = np.linalg.solve(np.array(frame["transform_matrix"]), np.append(point, 1.0))[:3]
    assert z < 0  # OpenGL cameras look along -z
    pixel = [frame["fl_x"] * x / -z + frame["cx"] - 0.5, -frame["fl_y"] * y / -z + frame["cy"] - 0.5]
    camera = geometry.transform(geometry.inverse(poses()[3] @ RIG.left_from_right), point[None])
    np.testing.assert_allclose([pixel], RIG.project(camera), atol=1e-9)


def test_attitude_is_that_of_the_rotation_from_top_right_sight_to_north_east_down():
    for yaw, pitch, roll in [(0, 0, 0), (90, 0, 0), (30, 20, 0), (250, -35, 10), (120, 5, -170)]:
        ned_from_camera = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
        top, right, sight = ned_from_camera.T[:, [1, 0, 2]] * [1, 1, -1]  # in east, north, up
        pose = geometry.pose(np.column_stack([right, -top, sight]), np.zeros(3))
        np.testing.assert_allclose(yaw_pitch_roll_deg(pose), [yaw, pitch, roll], atol=1e-9)
    north_up = geometry.pose(geometry.rotations_of_down_camera(np.array(np.pi / 2)), np.zeros(3))
    np.testing.assert_allclose(np.sin(np.deg2rad(yaw_pitch_roll_deg(north_up))), 0, atol=1e-12)


def test_positions_are_in_the_crs_of_the_export(contents, tmp_path):
    origin = geotiff.georeference_in("EPSG:32633", (432000.0, 5571000.0, -35.0))
    metashape.export(replace(contents, georeference=origin), tmp_path)
    lines = (tmp_path / "reference_truth.csv").read_text().splitlines()
    label, *values = lines[1 + 2 * 3].split(",")  # two images per frame
    assert label == "left_000003.png"
    np.testing.assert_allclose(
        np.array(values[:3], float), poses()[3, :3, 3] + [432000, 5571000, -35], atol=1e-6, rtol=0
    )
    (file, _) = ifdo.export(replace(contents, georeference=origin), tmp_path)
    item = json.loads(file.read_text())["image-set-items"]["left_000003.png"]
    east, north = rasterio.warp.transform(
        "EPSG:4326", "EPSG:32633", [item["image-longitude"]], [item["image-latitude"]]
    )
    np.testing.assert_allclose([east[0], north[0]], poses()[3, :2, 3] + [432000.01, 5571000], atol=1e-3, rtol=0)
    assert item["image-altitude-meters"] == pytest.approx(2.06 - 35)
    assert item["image-datetime"] == "1970-01-01 00:00:00.600000"


FEET = 1200 / 3937  # US survey foot [m], the unit of EPSG:2263


@pytest.mark.parametrize(
    ("crs", "origin", "metres_per_unit", "zone", "epsg", "convergence_deg"),
    [
        ("EPSG:32633", (432000.0, 5571000.0), 1.0, "33N", "32633", -0.7343),  # (longitude - 15) sin(latitude)
        ("EPSG:25833+5783", (432000.0, 5571000.0), 1.0, "33N", "32633", -0.7343),
        ("EPSG:32756", (334000.0, 6250000.0), 1.0, "56S", "32756", 1.0007),
        ("EPSG:2263", (984000.0, 210000.0), FEET, "18N", "32618", -0.0006),
    ],
)
def test_the_ifdo_package_opens_a_file_with_zone_position_and_attitude(
    contents, tmp_path, crs, origin, metres_per_unit, zone, epsg, convergence_deg
):
    wkt = rasterio.crs.CRS.from_user_input(crs).to_wkt()
    place = Georeference(*origin, -35.0, wkt, metres_per_unit)
    (file, _) = ifdo.export(replace(contents, georeference=place), tmp_path)
    opened = iFDO.load(file)
    found, pose = opened.image_set_items["left_000003.png"], contents.trajectories["final"].world_from_camera[3]
    assert (found.image_camera_pose.pose_utm_zone, found.image_camera_pose.pose_utm_epsg) == (zone, epsg)
    scene = np.array(origin) + pose[:2, 3] / metres_per_unit
    expected = np.array(rasterio.warp.transform(wkt, f"EPSG:{epsg}", *([value] for value in scene)))[:2, 0]
    *horizontal, up = found.image_camera_pose.pose_utm_east_north_up_meters
    np.testing.assert_allclose(horizontal, expected, atol=1e-3, rtol=0)
    assert up == pytest.approx(pose[2, 3] - 35)
    assert 4.0e5 < horizontal[0] < 6.0e5 or zone == "56S"  # metres, not feet
    ahead = np.array(rasterio.warp.transform(wkt, f"EPSG:{epsg}", [scene[0]], [scene[1] + 10 / metres_per_unit]))[:2, 0]
    turned = np.array(found.image_camera_pose.pose_absolute_orientation_utm_matrix) @ pose[:3, :3].T
    np.testing.assert_allclose(turned @ [0, 10, 0], [*(ahead - expected), 0], atol=0.01)
    yaw = yaw_pitch_roll_deg(pose)[0] + convergence_deg
    assert found.image_camera_yaw_degrees == pytest.approx(yaw % 360, abs=2e-3)
    assert opened.image_set_header.image_coordinate_reference_system == "EPSG:4326"


@pytest.mark.parametrize("wkt", [None, 'LOCAL_CS["tank",UNIT["metre",1],AXIS["x",EAST],AXIS["y",NORTH]]'])
def test_an_ifdo_file_in_local_coordinates_has_no_place_on_the_earth_and_says_so(contents, tmp_path, wkt):
    (file, _) = ifdo.export(replace(contents, georeference=Georeference(10.0, 20.0, 0.0, wkt)), tmp_path)
    opened = iFDO.load(file)
    item, header = opened.image_set_items["left_000003.png"], opened.image_set_header
    assert item.image_latitude is None and item.image_camera_pose is None
    assert (
        header.image_coordinate_reference_system is None and "cannot state where on the Earth" in header.image_abstract
    )
    position = contents.trajectories["final"].world_from_camera[3, :3, 3]
    np.testing.assert_allclose(item.image_acquisition_settings["local-position-meters"], position)


@pytest.mark.parametrize("replayed", [False, True])
def test_an_ifdo_file_calls_the_images_of_a_replay_recorded(contents, tmp_path, replayed):
    scenario = {"replay": {"dataset": "reef", "reader": "euroc"}} if replayed else {"lamps": [{"flux_lm": 1500.0}]}
    scenario |= {"vehicle": {"title": "BlueROV2"}}
    (file, _) = ifdo.export(replace(contents, scenario=scenario), tmp_path)
    header = json.loads(file.read_text())["image-set-header"]
    origin = {key: json.dumps(value) for key, value in header.items() if "simulated" in json.dumps(value)}
    keys = {"image-context", "image-abstract", "image-copyright", "image-platform", "image-sensor"}
    assert set(origin) == (set() if replayed else keys) and keys <= set(header)
    assert ("BlueROV2" in header["image-platform"]["name"]) is not replayed
    assert header["image-license"]["name"] == ("unknown" if replayed else "CC-BY-4.0")
    assert header.get("image-illumination") == (None if replayed else "artificial light")


@pytest.mark.parametrize(
    ("lamps", "sun_lx", "light"),
    [([{}], 0.0, "artificial light"), ([], 100.0, "sunlight"), ([{}], 100.0, "mixed light")],
)
def test_an_ifdo_file_names_the_light_of_the_scenario(contents, tmp_path, lamps, sun_lx, light):
    scenario = {"lamps": lamps, "sun": {"illuminance_lx": sun_lx}}
    (file, _) = ifdo.export(replace(contents, scenario=scenario), tmp_path)
    assert json.loads(file.read_text())["image-set-header"]["image-illumination"] == light


def test_jpeg_is_written_on_request(contents, tmp_path):
    euroc.export(replace(contents, jpeg_quality=90), tmp_path)
    dataset, _ = read_dataset(tmp_path)
    assert {frame.left.suffix for frame in dataset.images} == {".jpg"} and len(dataset.images) == N


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["eurok"], "--to: 'eurok' is not a format; did you mean 'euroc'\\? \\(allowed: euroc, "),
        ([], "--to: is missing"),
    ],
)
def test_an_unknown_format_is_refused(names, message):
    with pytest.raises(TwinError, match=message):
        chosen_formats(names)


def test_names_may_be_repeated_and_separated_by_commas():
    assert chosen_formats(["kitti,euroc", "kitti"]) == ["kitti", "euroc"]


def test_a_run_without_images_is_refused_with_what_is_needed(contents):
    without = replace(contents, frames=())
    for name in ("euroc", "kitti", "colmap"):
        with pytest.raises(TwinError, match='record = "all"'):
            check_needs(name, without)
    check_needs("calibration", without)
    assert {"euroc", "kitti", "tum", "colmap", "nerfstudio", "calibration", "ifdo", "metashape", "truth"} <= set(
        FORMATS
    )


def test_the_true_calibration_of_cameras_without_errors_is_exact():
    scenario = Scenario.model_validate({"calibration_error": {"baseline_error": 0.02}})
    true, rig = true_calibration(scenario), scenario.believed_rig()
    np.testing.assert_array_equal(true.left.matrix, rig.matrix)
    assert true.left_from_right[0, 3] == pytest.approx(1.02 * rig.baseline_m) and true.residual_px == 0


def test_the_true_calibration_has_the_errors_of_the_scenario():
    errors = {"focal_error": 0.01, "right_yaw_deg": 0.2, "left_principal_point_error_px": (2.0, -1.0)}
    scenario = Scenario.model_validate({"calibration_error": errors})
    true, rig = true_calibration(scenario), scenario.believed_rig()
    assert true.left.matrix[0, 0] == pytest.approx(1.01 * rig.fx_px, rel=1e-6)
    np.testing.assert_allclose(true.left.matrix[:2, 2], [rig.cx_px + 2, rig.cy_px - 1], atol=1e-4)
    yaw = geometry.so3_log(true.left_from_right[:3, :3])[1]  # about the axis that points down
    assert np.rad2deg(yaw) == pytest.approx(0.2, abs=1e-4) and true.residual_px < 1e-4


def test_the_model_of_the_fit_is_that_of_opencv():
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -1, 1], [1, 1, 3], (20, 3))
    distortion, matrix = np.array([0.1, -0.05, 0.01, -0.02, 0.03]), RIG.matrix
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)[0][:, 0]
    camera = replace(rectified_calibration(RIG).left, distortion=distortion)
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-9)


NOISE = ImuNoise(1.5e-4, 2e-5, 3e-3, 4e-3)


def turned(seconds, rate_hz=120.0):
    """Returns exact IMU readings of a simulated vehicle that turns about all axes, and its poses at 5 Hz."""
    rov, found = vehicle(buoyancy_n=1.0), []
    found.append((rov.inertial, rov.world_from_body))
    rov.after_timestep = lambda values: found.append((values, rov.world_from_body))
    for k in range(round(seconds * 30)):
        turn = 0.35 * np.sin(0.03 * k + np.arange(8)) + 0.15 * np.array([1, -1, 1, -1, 0, 0, 0, 0])
        rov.step(turn, 1 / 30)
    values = np.array([one for one, _ in found])
    bodies = np.array([pose for _, pose in found])
    readings = ImuReadings(np.arange(len(values)) / rate_hz, values[:, :3], values[:, 3:])
    path = Trajectory(np.arange(0, len(values), 24) / rate_hz, bodies[::24] @ RIG.body_from_camera)
    return RecordedImu(readings, rate_hz, NOISE), path


def test_standard_deviations_of_the_calibration_survive_in_a_euroc_folder(contents, tmp_path):
    rig = replace(contents.rig, yaw_sigma_rad=6e-4, baseline_sigma=5e-4)
    euroc.export(replace(contents, rig=rig), tmp_path)
    stated = read_dataset(tmp_path)[0].calibration
    read = rectification(ReplayOptions().with_sigmas(stated), 30.0).rig
    assert (read.yaw_sigma_rad, read.baseline_sigma) == pytest.approx((6e-4, 5e-4))
    given = ReplayOptions(rotation_sigma_deg=0.1, baseline_sigma_mm=0.0).with_sigmas(stated)
    assert (given.rotation_sigma_deg, given.baseline_sigma) == (0.1, 0.0)
    with pytest.raises(TwinError, match="rotation_sigma_deg: 3 .*0 to 2"):
        ReplayOptions(rotation_sigma_deg=3.0).with_sigmas(stated)
    file = tmp_path / "mav0" / "cam1" / "sensor.yaml"
    file.write_text(file.read_text().replace("baseline_sigma_mm", "baseline_sigma"))
    assert "calibration_error.baseline_sigma_mm is missing" in str(read_dataset(tmp_path)[0].calibration)


def test_true_heights_lie_beside_the_true_poses_of_a_euroc_folder(contents, tmp_path):
    heights = tmp_path / "dem_truth.tif"
    geotiff.write_elevations(heights, np.ones((3, 4), np.float32), MapGrid(0.0, 1.0, 0.1, 3, 4), "true elevation [m]")
    euroc.export(replace(contents, true_map=heights), tmp_path / "set")
    found = read_dataset(tmp_path / "set")[0].true_map
    assert found.parent.name == "state_groundtruth_estimate0" and found.read_bytes() == heights.read_bytes()
    euroc.export(contents, tmp_path / "without")
    assert read_dataset(tmp_path / "without")[0].true_map is None


def test_imu_readings_of_a_euroc_folder_are_those_of_the_run_and_integrate_to_its_attitudes(contents, tmp_path):
    imu, path = turned(4.0)
    euroc.export(replace(contents, imu=imu, trajectories={"truth": path}), tmp_path)
    with (tmp_path / "mav0" / "imu0" / "data.csv").open(newline="") as lines:
        header, *rows = csv.reader(lines)
    names = [name.split(" ")[0] for name in header]
    assert names == ["#timestamp", *(f"{kind}_RS_S_{axis}" for kind in "wa" for axis in "xyz")]
    times_ns = np.array([int(row[0]) for row in rows])
    np.testing.assert_array_equal(times_ns, 10**9 + np.round(np.arange(481) * 1e9 / 120).astype(int))
    values = np.array([[float(cell) for cell in row[1:]] for row in rows])
    np.testing.assert_array_equal(values, np.hstack(imu.readings[1:]))
    truth = np.loadtxt(tmp_path / "mav0" / "state_groundtruth_estimate0" / "data.csv", delimiter=",")
    attitude = Rotation.from_quat(truth[:, 4:], scalar_first=True)
    turn = np.radians(np.diff(attitude.as_euler("ZYX", degrees=True)[[0, -1]], axis=0))[0]
    assert (np.abs(turn) > 0.05).all()  # about all three axes
    here = attitude[0]
    for k in range(len(values) - 1):
        rate = (values[k, :3] + values[k + 1, :3]) / 2
        here = here * Rotation.from_rotvec(rate * (times_ns[k + 1] - times_ns[k]) * 1e-9)
        if (k + 1) % 24 == 0:
            assert times_ns[k + 1] == int(truth[(k + 1) // 24, 0])
            assert np.rad2deg((here.inv() * attitude[(k + 1) // 24]).magnitude()) < 0.05  # of the trapezoidal rule
    upwards = attitude.apply(values[::24, 3:])  # specific forces in the world: gravity upwards, and some acceleration
    np.testing.assert_allclose(upwards.mean(axis=0), [0, 0, 9.81], atol=0.2)


def test_the_noise_of_the_imu_is_written_with_the_keys_of_kalibr(contents, tmp_path):
    imu, _ = turned(0.1)
    euroc.export(replace(contents, imu=imu), tmp_path)
    sensor = yaml.safe_load((tmp_path / "mav0" / "imu0" / "sensor.yaml").read_text())
    assert sensor["sensor_type"] == "imu" and sensor["rate_hz"] == 120.0
    assert sensor["T_BS"] == {"rows": 4, "cols": 4, "data": np.eye(4).ravel().tolist()}
    believed, true = calibration_files.export(replace(contents, imu=imu), tmp_path)
    kalibr = yaml.safe_load((believed / "imu.yaml").read_text())
    assert kalibr == yaml.safe_load((true / "imu.yaml").read_text())
    assert kalibr.pop("rostopic") == "/imu/data_raw" and kalibr.pop("update_rate") == 120.0
    assert kalibr == NOISE._asdict() == {key: sensor[key] for key in NOISE._fields}
    chain, point = yaml.safe_load((true / "kalibr.yaml").read_text()), np.array([0.3, -0.2, 0.5])
    for camera, pose in (("cam0", np.eye(4)), ("cam1", contents.true.left_from_right)):
        in_camera = geometry.transform(np.array(chain[camera]["T_cam_imu"]), point[None])[0]
        np.testing.assert_allclose(
            geometry.transform(RIG.body_from_camera @ pose, in_camera[None])[0], point, atol=1e-12
        )
    assert read_calibration(believed / "kalibr.yaml").left.size_px == (64, 48)


def test_without_an_imu_nothing_is_written_for_one(contents, tmp_path):
    euroc.export(contents, tmp_path)
    (believed, _) = calibration_files.export(contents, tmp_path)
    assert not (tmp_path / "mav0" / "imu0").exists() and not (believed / "imu.yaml").exists()
    assert "imu" not in (believed / "kalibr.yaml").read_text()
