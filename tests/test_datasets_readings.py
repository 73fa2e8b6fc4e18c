"""Recorded readings that are not finite, have no times or no rows are left out with a note; the others are used."""

import bags
import numpy as np
import pytest

from twin.datasets import text_files
from twin.datasets.ros2.bag import Bag
from twin.datasets.ros2.bag_readings import read_bag
from twin.datasets.sensor_folders import read_folder
from twin.errors import TwinError

N, NS = 5, 100_000_000


def folder_of(tmp_path, sensor, rows):
    """Returns a folder with the readings of one sensor: lines of data.csv after its header."""
    (tmp_path / sensor).mkdir()
    (tmp_path / sensor / "sensor.yaml").write_text("sigma: 0.01")
    (tmp_path / sensor / "data.csv").write_text("#time [ns],values\n" + "".join(row + "\n" for row in rows))
    return tmp_path


@pytest.mark.parametrize("lost", ["300000000,nan,nan,nan", "300000000,0.1,inf,0", "300000000,,,"])
@pytest.mark.parametrize(("sensor", "name"), [("dvl0", "velocity"), ("ahrs0", "attitude")])
def test_a_row_that_is_not_finite_is_no_reading(tmp_path, sensor, name, lost):
    """The time of the row is that of another one, which would be an error of a reading."""
    found = read_folder(folder_of(tmp_path, sensor, ["300000000,0.1,0,0", lost, "400000000,0.2,0,0"]), np.eye(4))
    series = getattr(found, name)
    np.testing.assert_allclose(series.times_s, [0.3, 0.4])
    np.testing.assert_array_equal(series.values[:, 0], [0.1, 0.2])
    assert found.notes == (f"1 of 3 readings of {sensor} are not used: not finite.",)


def test_the_line_of_a_bad_row_is_counted_with_the_rows_left_out(tmp_path):
    """Line 1 is the header, line 3 the row that is left out."""
    folder = folder_of(tmp_path, "pressure0", ["100,-1", "200,nan", "300,-1", "300,-1"])
    with pytest.raises(TwinError, match=r"pressure0/data.csv:5: the time 3e-07 s is not after"):
        read_folder(folder, np.eye(4))


@pytest.mark.parametrize(
    ("rows", "note"),
    [
        ([], "There are no readings in pressure0."),
        (["1,nan", "2,nan"], "The readings of pressure0 are not used: none of them is finite."),
    ],
)
def test_a_sensor_without_a_reading_is_noted(tmp_path, rows, note):
    found = read_folder(folder_of(tmp_path, "pressure0", rows), np.eye(4))
    assert found.height is None and found.notes == (note,)


def test_a_file_of_readings_is_parsed_once(tmp_path, monkeypatch):
    folder = folder_of(tmp_path, "pressure0", ["1,-1", "2,-1"])
    parsed, parse = [], text_files.text_rows
    monkeypatch.setattr(text_files, "text_rows", lambda file: parsed.append(file) or parse(file))
    assert len(read_folder(folder, np.eye(4)).height.times_s) == 2 and len(parsed) == 1


def bag_of(tmp_path, stamped=True, **lost):
    """Returns the readings in a bag of N messages per sensor.

    `lost` has, for a sensor ("pressure", "attitude", "velocity"), the function that damages its second message.
    """
    messages = []
    for k in range(N):
        time_ns = bags.START_NS + k * NS
        stamp_ns = time_ns if stamped else 0
        found = {
            "pressure": bags.ROS.pressure(stamp_ns, 2e5 + k, 0.01),
            "attitude": bags.ROS.attitude(stamp_ns, np.array([0.1, 0.2, 0.3]), np.full(3, 0.01)),
            "velocity": bags.ROS.velocity(stamp_ns, np.array([0.1, 0, k]), 0.01),
        }
        if k == 1:
            for sensor, damage in lost.items():
                damage(found[sensor])
        messages += [(f"/{sensor}", time_ns, message) for sensor, message in found.items()]
    frames = {message.header.frame_id for _, _, message in messages}
    poses = {frame: ("base_link", np.eye(4)) for frame in frames - {"base_link"}}
    return read_bag(Bag(bags.write(tmp_path / "bag", messages)), bags.LEFT, poses)


def test_messages_of_a_bag_that_are_not_finite_are_no_readings(tmp_path):
    """A DVL that lost the bottom often reports NaN with a variance of 0 or NaN."""
    found = bag_of(
        tmp_path,
        pressure=lambda one: setattr(one, "fluid_pressure", np.inf),
        attitude=lambda one: setattr(one.orientation, "w", np.nan),
        velocity=lambda one: (setattr(one.twist.twist.linear, "x", np.nan), one.twist.covariance.fill(0)),
    )
    kept_s = (bags.START_NS + NS * np.array([0, 2, 3, 4])) * 1e-9
    for series in (found.height, found.attitude, found.velocity):
        np.testing.assert_allclose(series.times_s, kept_s, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(found.velocity.values[:, 2], [0, 2, 3, 4])
    assert len(found.notes) == 3 and all("1 of 5 readings of /" in note for note in found.notes)


def test_a_message_without_a_finite_covariance_is_no_reading(tmp_path):
    found = bag_of(tmp_path, velocity=lambda one: one.twist.covariance.fill(np.nan))
    assert len(found.velocity.times_s) == N - 1 and found.velocity.sigmas == pytest.approx([0.01] * 3)


def test_readings_without_stamps_get_the_times_of_recording(tmp_path):
    found = bag_of(tmp_path, stamped=False)
    for series in (found.height, found.attitude, found.velocity):
        np.testing.assert_allclose(series.times_s, (bags.START_NS + NS * np.arange(N)) * 1e-9, rtol=0, atol=1e-6)
    assert len(found.notes) == 3 and all("times of recording" in note for note in found.notes)
