"""Exported ROS 2 bags: rosbags reads every topic back at the right time, place and orientation; replays read them."""

from dataclasses import replace
from pathlib import Path

import cv2
import exported_run as made
import numpy as np
import pytest
from recorded_datasets import RIG
from rosbags.highlevel import AnyReader

import twin
from twin.core import geometry
from twin.core.records import ImuReadings, Readings
from twin.datasets import euroc
from twin.datasets.ros2 import bag_writer
from twin.datasets.ros2.bag_reader import BagReader, BagTopics
from twin.datasets.run_contents import ImuNoise, RecordedImu
from twin.datasets.sensor_folders import timestamp_ns
from twin.exports.formats import FORMATS
from twin.recordings.frames import RecordedFrames
from twin.recordings.replay import ReplayOptions

N = 4
ANGLES = np.array([0.05, -0.1, 2.0])
SCENARIO = {
    "navigation": {
        "pressure_sigma_m": 0.02,
        "attitude_sigma_deg": 1.0,
        "heading_sigma_deg": 2.0,
        "dvl_sigma_mps": 0.01,
        "usbl_sigma_m": 0.3,
    },
    "sun": {"depth_m": 12.0},
}


IMU = RecordedImu(
    ImuReadings(np.arange(73) / 120, *np.random.default_rng(0).normal(size=(2, 73, 3)) + [[[0]], [[9.81]]]),
    120.0,
    ImuNoise(1e-3, 2e-5, 2e-2, 4e-3),
)


def readings(k):
    """Returns readings of all sensors at frame 1, of the pressure sensor alone at frame 2, of none elsewhere."""
    if k == 1:
        velocity_mps, position_m = np.array([0.3, -0.1, 0.02]), np.array([4.0, -5.0, 6.0])
        return Readings(1.5, ANGLES, velocity_mps, position_m)
    return Readings(pressure_z_m=1.25) if k == 2 else Readings()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return made.flown(tmp_path_factory.mktemp("run"), N, readings, scenario=SCENARIO, imu=IMU)


@pytest.fixture(scope="module")
def bag(run, tmp_path_factory):
    """Returns the exported bag as {topic: [(recording time, message)]}, read with the definitions in the bag."""
    (path,) = FORMATS["mcap"].write(run, tmp_path_factory.mktemp("out"))
    found = {}
    with AnyReader([path]) as reader:
        for connection, time_ns, data in reader.messages():
            found.setdefault(connection.topic, []).append((time_ns, reader.deserialize(data, connection.msgtype)))
    return found


def pose_of(position, orientation):
    """Returns the pose (4, 4) of a position and a quaternion of a message."""
    quaternion = np.array([orientation.w, orientation.x, orientation.y, orientation.z])
    return geometry.pose(geometry.rotation_from_wxyz(quaternion), np.array([position.x, position.y, position.z]))


def stamp_ns(message):
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def test_the_topics_and_times_are_those_of_the_run(bag, run):
    pair = [f"/{side}/{name}" for side in ("left", "right") for name in ("image_rect/compressed", "camera_info")]
    other = [
        "/tf_static",
        "/tf",
        "/odometry",
        "/ground_truth/odometry",
        "/imu/data",
        "/imu/data_raw",
        "/pressure",
        "/dvl",
        "/usbl",
    ]
    assert set(bag) == {*pair, *other}
    times_ns = [timestamp_ns(frame.time_s) for frame in run.frames]
    for topic in (*pair, "/odometry", "/ground_truth/odometry"):
        assert [time_ns for time_ns, _ in bag[topic]] == [stamp_ns(one) for _, one in bag[topic]] == times_ns
    assert [stamp_ns(one) for _, one in bag["/pressure"]] == times_ns[1:3]


def test_images_are_the_recorded_files(bag, run):
    for side in ("left", "right"):
        for frame, (_, message) in zip(run.frames, bag[f"/{side}/image_rect/compressed"], strict=True):
            assert bytes(message.data) == getattr(frame, side).read_bytes()
            assert message.format == "rgb8; png compressed bgr8"
            assert message.header.frame_id == f"{side}_camera_optical_frame"


def test_images_are_jpeg_if_a_quality_is_given(run, tmp_path):
    (path,) = bag_writer.export(replace(run, jpeg_quality=90), tmp_path)
    with AnyReader([path]) as reader:
        connection = next(one for one in reader.connections if one.topic == "/left/image_rect/compressed")
        message = reader.deserialize(next(reader.messages([connection]))[2], connection.msgtype)
    image, exact = cv2.imdecode(message.data, cv2.IMREAD_COLOR), cv2.imread(str(run.frames[0].left))
    assert message.format.startswith("rgb8; jpeg")
    assert 0 < np.abs(image.astype(int) - exact).mean() < 4


def test_camera_info_projects_points_as_the_rig_does(bag):
    point = np.array([0.2, -0.1, 1.7, 1.0])
    expected = RIG.project(point[None, :3])[0] - [0, 0], RIG.project(point[None, :3] - [RIG.baseline_m, 0, 0])[0]
    for side, pixel in zip(("left", "right"), expected, strict=True):
        info = bag[f"/{side}/camera_info"][0][1]
        projected = np.array(info.p).reshape(3, 4) @ point
        np.testing.assert_allclose(projected[:2] / projected[2], pixel, atol=1e-9)
        assert (info.width, info.height, info.distortion_model) == (RIG.width_px, RIG.height_px, "plumb_bob")
        np.testing.assert_array_equal(np.array(info.k).reshape(3, 3), RIG.matrix)


def test_odometry_and_transforms_are_the_poses_of_the_body(bag, run):
    body = [run.trajectories[name].world_from_camera @ geometry.inverse(RIG.body_from_camera)
            for name in ("final", "truth")]  # fmt: skip
    for topic, poses in zip(("/odometry", "/ground_truth/odometry"), body, strict=True):
        read = [pose_of(one.pose.pose.position, one.pose.pose.orientation) for _, one in bag[topic]]
        np.testing.assert_allclose(read, poses, atol=1e-12)
        assert {(one.header.frame_id, one.child_frame_id) for _, one in bag[topic]} == {("world", "base_link")}
    transforms = [one.transforms[0].transform for _, one in bag["/tf"]]
    np.testing.assert_allclose([pose_of(t.translation, t.rotation) for t in transforms], body[0], atol=1e-12)
    moved = {one.child_frame_id: pose_of(one.transform.translation, one.transform.rotation)
             for one in bag["/tf_static"][0][1].transforms}  # fmt: skip
    np.testing.assert_allclose(moved["left_camera_optical_frame"], RIG.body_from_camera, atol=1e-12)
    right = RIG.body_from_camera @ RIG.left_from_right
    np.testing.assert_allclose(moved["right_camera_optical_frame"], right, atol=1e-12)


def test_the_twist_of_the_odometry_integrates_to_the_poses(bag):
    found = [one for _, one in bag["/odometry"]]
    for here, then in zip(found[:-1], found[1:], strict=True):
        linear, angular = here.twist.twist.linear, here.twist.twist.angular
        twist = np.array([angular.x, angular.y, angular.z, linear.x, linear.y, linear.z])
        moved = pose_of(here.pose.pose.position, here.pose.pose.orientation) @ geometry.exp(twist / RIG.frame_rate_hz)
        np.testing.assert_allclose(moved, pose_of(then.pose.pose.position, then.pose.pose.orientation), atol=1e-9)


def test_readings_are_in_the_units_of_the_messages(bag):
    attitude = bag["/imu/data"][0][1]
    rotation = pose_of(geometry_zero(), attitude.orientation)[:3, :3]
    np.testing.assert_allclose(rotation, geometry.rotation_from_rpy(*ANGLES), atol=1e-12)
    assert attitude.angular_velocity_covariance[0] == attitude.linear_acceleration_covariance[0] == -1
    assert np.sqrt(np.diag(attitude.orientation_covariance.reshape(3, 3))) == pytest.approx(np.deg2rad([1, 1, 2]))
    deep, shallow = (one.fluid_pressure for _, one in bag["/pressure"])
    assert deep == pytest.approx(101_325 + 1025 * 9.81 * 10.5)
    assert shallow - deep == pytest.approx(1025 * 9.81 * 0.25)
    assert bag["/pressure"][0][1].variance == pytest.approx((1025 * 9.81 * 0.02) ** 2)
    velocity = bag["/dvl"][0][1].twist
    assert [velocity.twist.linear.x, velocity.twist.linear.y, velocity.twist.linear.z] == [0.3, -0.1, 0.02]
    assert velocity.covariance[0] == pytest.approx(1e-4) and velocity.covariance[-1] == -1
    ((_, fix),) = bag["/usbl"]
    assert [fix.pose.pose.position.x, fix.pose.pose.position.y, fix.pose.pose.position.z] == [4.0, -5.0, 6.0]
    assert fix.header.frame_id == "world" and fix.pose.covariance[0] == pytest.approx(0.09)
    assert fix.pose.covariance[-1] == -1


def test_rates_and_specific_forces_are_those_of_the_run_without_an_orientation(bag):
    found = bag["/imu/data_raw"]
    assert [time_ns for time_ns, _ in found] == [stamp_ns(one) for _, one in found]
    assert [time_ns for time_ns, _ in found] == [10**9 + round(k / 120 * 1e9) for k in range(73)]
    for values, name in ((IMU.readings.rates_radps, "angular_velocity"),
                         (IMU.readings.specific_forces_mps2, "linear_acceleration")):  # fmt: skip
        read = [getattr(one, name) for _, one in found]
        np.testing.assert_array_equal([[one.x, one.y, one.z] for one in read], values)
    for _, one in found:
        assert one.header.frame_id == "base_link" and one.orientation_covariance[0] == -1
    # white noise of density s has the standard deviation s sqrt(rate)
    first = found[0][1]
    np.testing.assert_allclose(first.angular_velocity_covariance.reshape(3, 3), np.eye(3) * 1e-6 * 120)
    np.testing.assert_allclose(first.linear_acceleration_covariance.reshape(3, 3), np.eye(3) * 4e-4 * 120)


def geometry_zero():
    """Returns an object with the position (0, 0, 0)."""
    return type("Zero", (), {"x": 0.0, "y": 0.0, "z": 0.0})


def test_without_a_surface_the_pressure_is_relative_to_the_reference_plane():
    assert bag_writer.pressure_pa(2.0, 0.0) == pytest.approx(-2 * 1025 * 9.81)


def test_our_reader_reads_the_exported_bag_back(run, tmp_path):
    (path,) = bag_writer.export(run, tmp_path)
    dataset = BagReader(BagTopics(truth="/ground_truth/odometry")).read(path)
    frames = RecordedFrames(dataset, dataset.calibration)
    for given, read in zip(run.frames, frames, strict=True):
        np.testing.assert_array_equal(read.left, cv2.imread(str(given.left))[..., ::-1])
        np.testing.assert_array_equal(read.right, cv2.imread(str(given.right))[..., ::-1])
    rig = frames.rectification.rig
    np.testing.assert_allclose(rig.matrix, RIG.matrix, atol=1e-12)
    assert rig.baseline_m == pytest.approx(RIG.baseline_m, abs=1e-12) and frames.rectification.maps == (None, None)
    truth = run.trajectories["truth"].world_from_camera
    np.testing.assert_allclose(dataset.truth.world_from_camera, truth, atol=1e-9)


@pytest.mark.long
def test_a_replay_of_the_bag_equals_the_replay_of_the_same_run_as_a_euroc_folder(tmp_path):
    run = made.flown(tmp_path / "run", 8)
    (bag,) = bag_writer.export(run, tmp_path)
    euroc.export(run, tmp_path / "euroc")
    truths = (Path("/ground_truth/odometry"), None)
    first, second = (
        twin.replay(path, tmp_path / f"{path.name}-run", ReplayOptions(outputs=(), truth=truth))
        for path, truth in zip((bag, tmp_path / "euroc"), truths, strict=True)
    )
    np.testing.assert_array_equal(first.result.final.world_from_camera, second.result.final.world_from_camera)
    np.testing.assert_array_equal(first.elevation.height_m, second.elevation.height_m)
    errors = [one.metrics["trajectory"]["final"]["ate_rmse_m"] for one in (first, second)]
    assert errors[0] == pytest.approx(errors[1], rel=1e-6) and errors[0] < 0.001
