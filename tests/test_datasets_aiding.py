"""Recorded readings in a replay: the world follows gravity, bad rows are named, what cannot be used is left out."""

import re
import shutil

import bags
import exported_run
import numpy as np
import pytest
import recorded_datasets as recorded
from recorded_datasets import RIG

import twin
from twin.core import geometry
from twin.core.records import ImuReadings, Readings
from twin.datasets import euroc
from twin.datasets.ros2 import bag_writer
from twin.datasets.ros2.bag_reader import BagReader
from twin.datasets.run_contents import ImuNoise, RecordedImu
from twin.datasets.sensor_folders import read_folder
from twin.errors import TwinError
from twin.recordings.replay import ReplayOptions, open_dataset

pytestmark = pytest.mark.long

N = 8
SIGMAS_RAD = np.deg2rad([0.2, 0.2, 0.5])
SCENARIO = {
    "navigation": {
        "pressure_sigma_m": 0.01, "attitude_sigma_deg": 0.2, "heading_sigma_deg": 0.5, "dvl_sigma_mps": 0.005,
    }
}  # fmt: skip
BODIES = recorded.poses(N) @ geometry.inverse(RIG.body_from_camera)
VELOCITY_MPS = np.array([0.03 * RIG.frame_rate_hz, 0.0, 0.0])


def noisy_readings(turned_rad=0.0):
    """Returns the function frame number -> readings with the noise of SCENARIO; heights 30 m lower than in the scene.

    `turned_rad` is an error of the attitude that grows with every frame.
    """
    rng = np.random.default_rng(2)

    def reading(k):
        body, noise = BODIES[k], rng.normal(size=7)
        attitude = geometry.rpy_from_rotation(body[:3, :3]) + SIGMAS_RAD * noise[1:4] + turned_rad * k
        height = float(recorded.poses(N)[k, 2, 3]) - 30 + 0.01 * noise[0]
        return Readings(height, geometry.wrap_angle(attitude), body[:3, :3].T @ VELOCITY_MPS + 0.005 * noise[4:])

    return reading


@pytest.fixture(scope="module")
def contents(tmp_path_factory):
    return exported_run.flown(tmp_path_factory.mktemp("run"), N, noisy_readings(), scenario=SCENARIO)


@pytest.fixture(scope="module")
def folder(contents, tmp_path_factory):
    found = tmp_path_factory.mktemp("euroc")
    euroc.export(contents, found)
    return found


def replayed(folder, out, **options):
    return twin.replay(folder, out, ReplayOptions(outputs=(), **options))


def tilts_deg(result):
    """Returns the angles between the estimated and the true direction of gravity in camera axes."""
    cosines = np.einsum("ni,ni->n", result.final.world_from_camera[:, 2, :3], recorded.poses(N)[:, 2, :3])
    return np.rad2deg(np.arccos(np.clip(cosines, -1, 1)))


def test_attitude_and_pressure_make_the_world_level(folder, tmp_path):
    """The mean of 8 readings has a standard deviation of 0.07 degrees per axis; the plane of the hills is tilted."""
    found = replayed(folder, tmp_path / "aided")
    assert found.metrics["replay"]["aiding"] == "pressure, attitude, dvl"
    assert tilts_deg(found.result).max() < 0.25
    assert found.metrics["trajectory"]["final"]["ate_max_m"] < 0.004
    assert not any("standard deviations" in warning for warning in found.metrics["warnings"])
    alone = replayed(folder, tmp_path / "alone", aiding=False)
    assert alone.metrics["replay"]["aiding"] == "none" and tilts_deg(alone.result).min() > 0.4
    sigma = np.sqrt(found.result.node_cov[0].diagonal())
    assert np.deg2rad(0.02) < sigma[0] < np.deg2rad(0.2)  # the tilt of the first pose is not exact


def test_a_bag_has_the_same_readings(contents, folder, tmp_path):
    bag_writer.export(contents, tmp_path)
    bag = replayed(tmp_path / "ros2_bag", tmp_path / "bag").result
    assert np.abs(bag.final.positions - replayed(folder, tmp_path / "euroc").result.final.positions).max() < 1e-6


def test_an_attitude_of_another_body_is_a_warning(tmp_path):
    contents = exported_run.flown(tmp_path / "run", N, noisy_readings(turned_rad=0.05), scenario=SCENARIO)
    euroc.export(contents, tmp_path / "set")
    found = replayed(tmp_path / "set", tmp_path / "out").metrics
    assert any(w.startswith("The readings of attitude deviate from the final path") for w in found["warnings"])


@pytest.mark.parametrize(
    ("sensor", "line", "message"),
    [
        ("pressure0", "2000000000,deep", r"pressure0/data.csv:10: is not a line of numbers \(allowed: 2 finite"),
        ("pressure0", "2000000000", r"pressure0/data.csv:10: is not a line of numbers"),
        ("pressure0", "1000000000,-28", r"data.csv:10: the time 1 s is not after .* before, 2.4 s \(allowed: incr"),
        ("pressure0", "9000000000,1e6", r"data.csv:10: the height from pressure is 1e\+06 m \(allowed: -12000 to"),
        ("ahrs0", "9000000000,0,0,90", r"data.csv:10: the attitude is 90 rad \(allowed: -6.28319 to 6.28319 rad"),
        ("dvl0", "9000000000,0,25,0", r"data.csv:10: the velocity of the DVL is 25 m/s \(allowed: -20 to 20 m/s"),
    ],
)  # fmt: skip
def test_a_bad_row_is_named_with_its_value(folder, tmp_path, sensor, line, message):
    copied = copy_of(folder, tmp_path)
    with (copied / "mav0" / sensor / "data.csv").open("a") as file:
        file.write(line + "\n")
    with pytest.raises(TwinError, match=message):
        open_dataset(copied, ReplayOptions())
    assert open_dataset(copied, ReplayOptions(aiding=False)).aiding is None


def copy_of(folder, tmp_path):
    """Returns a copy of a data set."""
    shutil.copytree(folder, tmp_path / "set")
    return tmp_path / "set"


@pytest.mark.parametrize("text", ["sigma: [1, 2]", "sigma: small", "sigma: -1"])
def test_an_impossible_standard_deviation_is_named(folder, tmp_path, text):
    copied = copy_of(folder, tmp_path)
    (copied / "mav0" / "pressure0" / "sensor.yaml").write_text(text)
    with pytest.raises(
        TwinError, match=r"(?s)sensor.yaml: sigma: .* \(allowed: a number or 1 numbers|are -1 \(allowed: positive"
    ):
        open_dataset(copied, ReplayOptions())


def test_readings_without_a_standard_deviation_or_a_direction_of_gravity_are_not_used(folder, tmp_path):
    copied = copy_of(folder, tmp_path)
    (copied / "mav0" / "ahrs0" / "sensor.yaml").unlink()
    aiding = open_dataset(copied, ReplayOptions()).aiding
    assert aiding.used == ["dvl"]
    assert aiding.notes[0] == "The readings in ahrs0 are not used: sensor.yaml states no `sigma`."
    assert "no attitude states the direction of gravity" in aiding.notes[1]
    assert read_folder(tmp_path, np.eye(4)) is None


def inertial(bias_mps2, stated_mps2=0.02, rate_hz=100.0):
    """Returns the readings of an IMU on the path of `BODIES`, with a biased accelerometer and the noise of EuRoC."""
    n, rng, noise = (
        round((N - 1) / RIG.frame_rate_hz * rate_hz) + 1,
        np.random.default_rng(1),
        ImuNoise(1.7e-4, 2e-5, 2e-3, 0.0),
    )
    white = rng.normal(size=(2, n, 3)) * np.sqrt(rate_hz)
    forces = BODIES[0, 2, :3] * 9.81 + bias_mps2 + white[1] * noise.accelerometer_noise_density
    readings = ImuReadings(np.arange(n) / rate_hz, white[0] * noise.gyroscope_noise_density, forces)
    return RecordedImu(readings, rate_hz, noise, stated_mps2)


def level_errors_m(result):
    """Returns the height errors (n,) of the final path, moved to the truth by a rotation about z and a translation."""
    found, true = result.final.positions, recorded.poses(N)[:, :3, 3]
    return (found[:, 2] - found[:, 2].mean()) - (true[:, 2] - true[:, 2].mean())


@pytest.mark.parametrize("writer", ["euroc", "ros2"])
def test_an_imu_without_orientation_makes_the_world_level(tmp_path, writer):
    """A bias of 0.02 m/s2 is a tilt of 0.12 degrees; the first view of the hills is tilted by more than 0.4 degrees."""
    contents = exported_run.flown(tmp_path / "run", N, scenario=SCENARIO, imu=inertial(np.array([0.02, 0, 0])))
    (euroc if writer == "euroc" else bag_writer).export(contents, tmp_path / "set")
    folder = tmp_path / "set" if writer == "euroc" else tmp_path / "set" / "ros2_bag"
    found = replayed(folder, tmp_path / "aided")
    assert found.metrics["replay"]["aiding"] == "vertical" and not found.metrics["warnings"]
    assert found.metrics["replay"]["plane"] == "plane of the map horizontal by the recorded specific forces"
    alone = replayed(folder, tmp_path / "alone", aiding=False)
    assert tilts_deg(found.result).max() < 0.2 < 0.4 < tilts_deg(alone.result).min()
    assert np.abs(level_errors_m(found.result)).max() < 0.5 * np.abs(level_errors_m(alone.result)).max()
    sigma = np.sqrt(found.result.node_cov[:, :2, :2].trace(axis1=1, axis2=2) / 2)  # about the axes across the view
    # the smoothed vertical has 0.8 degrees over these 1.4 s; the bias is believed to be 0.12 (bag: 1.2) degrees
    np.testing.assert_allclose(sigma, sigma[0], rtol=0.05)
    assert np.deg2rad(0.4) < sigma[0] < np.deg2rad(1.6)


def test_an_attitude_precedes_an_imu_and_heights_need_either(tmp_path):
    imu = inertial(np.zeros(3))
    contents = exported_run.flown(tmp_path / "run", N, noisy_readings(), scenario=SCENARIO, imu=imu)
    euroc.export(contents, tmp_path / "set")
    assert open_dataset(tmp_path / "set", ReplayOptions()).aiding.used == ["pressure", "attitude", "dvl"]
    (tmp_path / "set" / "mav0" / "ahrs0" / "data.csv").unlink()
    assert open_dataset(tmp_path / "set", ReplayOptions()).aiding.used == ["pressure", "vertical", "dvl"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (r"gyroscope_noise_density: .*", "", "The readings in imu0 are not used: .* `gyroscope_noise_density`"),
        (r"gyroscope_random_walk: .*", "gyroscope_random_walk: -1", r"gyroscope_random_walk: '-1' is not .* 0 to"),
        (r"accelerometer_bias_sigma: .*", "accelerometer_bias_sigma: big", r"accelerometer_bias_sigma: 'big' is not"),
        (r"data: \[1.0", "data: [3.0", r"T_BS is not a rotation matrix"),
    ],
)  # fmt: skip
def test_a_bad_description_of_an_imu_is_named(tmp_path, old, new, message):
    contents = exported_run.flown(tmp_path / "run", 2, scenario=SCENARIO, imu=inertial(np.zeros(3)))
    euroc.export(contents, tmp_path / "set")
    file = tmp_path / "set" / "mav0" / "imu0" / "sensor.yaml"
    text, n = re.subn(old, new, file.read_text())
    file.write_text(text)
    assert n == 1
    try:
        found = " ".join(open_dataset(tmp_path / "set", ReplayOptions()).aiding.notes)
    except TwinError as error:
        found = str(error)
    assert re.search(message, found), found


STATIC = {
    ("base_link", bags.LEFT): RIG.body_from_camera,
    ("base_link", "dvl"): geometry.pose(np.eye(3), np.array([0.3, 0, 0])),
}


def speed_message():
    """Returns a velocity of the body."""
    return bags.ROS.velocity(bags.START_NS, np.array([0.1, 0, 0]), 0.01)


def bag_readings(tmp_path, *messages, static=None):
    """Returns the readings in a bag of one stereo pair and the given messages (topic, message) at its start."""
    start = bags.START_NS
    found = [
        ("/tf_static", start, bags.ROS.transforms(start, static or STATIC)),
        *bags.stereo(recorded.frames(recorded.poses(1))),
    ]
    path = bags.write(tmp_path / "bag", [*found, *((topic, start, message) for topic, message in messages)])
    readings = BagReader().read(path).readings
    if isinstance(readings, TwinError):
        raise readings
    return readings


def attitude_message(**changed):
    message = bags.ROS.attitude(bags.START_NS, np.array([0.1, 0.2, 0.3]), SIGMAS_RAD)
    for key, value in changed.items():
        setattr(message.orientation if key == "w" else message, key, value)
    return message


def test_the_body_of_a_bag_is_the_frame_of_its_attitude(tmp_path):
    found = bag_readings(tmp_path, ("/imu/data", attitude_message()))
    np.testing.assert_allclose(found.attitude.values, [[0.1, 0.2, 0.3]], atol=1e-12)
    np.testing.assert_allclose(found.attitude.sigmas, SIGMAS_RAD)
    np.testing.assert_allclose(found.body_from_left, RIG.body_from_camera)


def test_readings_of_a_bag_that_cannot_be_used_are_named(tmp_path):
    start, speed = bags.START_NS, np.array([0.1, 0, 0])
    unknown = attitude_message(orientation_covariance=np.zeros(9))
    elsewhere = bags.ROS.velocity(start, speed, 0.01)
    elsewhere.header.frame_id = "dvl"
    cases = {
        "they state no covariance": [("/imu", unknown)],
        r"several topics have it \(/a, /b\)": [("/a", attitude_message()), ("/b", attitude_message())],
        "the DVL is not at the origin": [("/imu", attitude_message()), ("/dvl", elsewhere)],
        "no covariance": [("/pressure", bags.ROS.pressure(start, 2e5, 0.0))],
    }
    for number, (note, messages) in enumerate(cases.items()):
        assert re.search(note, " ".join(bag_readings(tmp_path / str(number), *messages).notes)), note
    with pytest.raises(TwinError, match=r"/imu: message 1: the orientation is 3, .* \(allowed: a unit quaternion\)"):
        bag_readings(tmp_path / "bad", ("/imu", attitude_message(w=3.0)))


def test_of_two_topics_of_type_imu_the_one_with_an_orientation_gives_the_attitude(tmp_path):
    raw = bags.ROS.inertial(bags.START_NS, np.array([0.1, 0.2, 0.3]), np.array([0, 0, 9.81]), (1e-3, 1e-2))
    empty, broken, unsure = attitude_message(w=0.0), attitude_message(w=np.nan), attitude_message()
    empty.orientation.x = empty.orientation.y = empty.orientation.z = 0.0
    unsure.orientation_covariance = np.zeros(9)
    for number, other in enumerate((raw, empty, broken, unsure)):
        for names in (("/a", "/z"), ("/z", "/a")):
            messages = dict(zip(names, (other, attitude_message()), strict=True))
            found = bag_readings(tmp_path / f"{number}{names[0][1]}", *sorted(messages.items()))
            np.testing.assert_allclose(found.attitude.values, [[0.1, 0.2, 0.3]], atol=1e-12)
            assert found.notes == ()


def test_a_topic_of_rates_and_specific_forces_alone_gives_the_vertical(tmp_path):
    raw = bags.ROS.inertial(bags.START_NS, np.zeros(3), np.array([0, 3.0, 9.34]), (1e-3, 1e-2))
    found = bag_readings(tmp_path / "one", ("/imu", raw))
    assert found.attitude is None and found.notes == ()
    np.testing.assert_allclose(found.vertical.values, [np.array([0, 3.0, 9.34]) / np.hypot(3, 9.34)], atol=1e-6)
    np.testing.assert_allclose(found.body_from_left, RIG.body_from_camera)
    sideways = {("base_link", "imu"): geometry.pose(geometry.rotation_from_rpy(np.pi / 2, 0.0, 0.0), np.zeros(3))}
    raw.header.frame_id = "imu"
    turned = bag_readings(tmp_path / "turned", ("/imu", raw), ("/dvl", speed_message()), static=STATIC | sideways)
    np.testing.assert_allclose(turned.vertical.values, [np.array([0, -9.34, 3.0]) / np.hypot(3, 9.34)], atol=1e-6)


def test_topics_of_rates_that_cannot_be_used_are_named(tmp_path):
    """A driver without orientation, one that has removed gravity, one in units of g, and two sensors."""
    raw, free, in_g = (
        bags.ROS.inertial(bags.START_NS, np.zeros(3), np.array(force), (1e-3, 1e-2))
        for force in ([0, 0, 9.81], [0.02, 0, 0.01], [0, 0, 1.0])
    )
    two = bag_readings(tmp_path / "two", ("/front", raw), ("/rear", raw))
    assert two.vertical is None
    assert two.notes[0] == "The attitude is not used: no message of /front, /rear states an orientation."
    assert "several topics have it (/front, /rear)" in two.notes[1]
    for name, message, mean in (("free", free, "0.0224"), ("g", in_g, "1")):
        found = bag_readings(tmp_path / name, ("/imu", message))
        assert found.vertical is None
        assert f"/imu are not used: their mean specific force is {mean} m/s2, that of gravity" in found.notes[0]


def test_a_sensor_that_warms_up_is_recognised_by_a_later_message(tmp_path):
    early = attitude_message(w=np.nan)
    late = attitude_message()
    late.header.stamp.sec += 1
    raw = bags.ROS.inertial(bags.START_NS, np.zeros(3), np.array([0, 0, 9.81]), (1e-3, 1e-2))
    found = bag_readings(tmp_path, ("/raw", raw), ("/imu", early), ("/imu", late))
    assert len(found.attitude.values) == 1 and "1 of 2 readings of /imu are not used" in " ".join(found.notes)
