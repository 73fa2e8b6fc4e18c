"""ROS 2 bags as data sets: encodings, calibration, topics, truth; damaged and hostile bags are one line or counted."""

import struct
import sys
from dataclasses import replace
from pathlib import Path

import bags
import cv2
import lz4.frame
import numpy as np
import pytest
import recorded_datasets as recorded
from bags import LEFT, RIGHT, START_NS
from recorded_datasets import RIG
from rosbags.rosbag2 import StoragePlugin, storage_mcap

from twin.core import geometry
from twin.datasets.image_files import UnreadableImage
from twin.datasets.ros2 import bag as bag_module
from twin.datasets.ros2.bag import Bag
from twin.datasets.ros2.bag_images import image_topics, raw_pixels, stereo_topics
from twin.datasets.ros2.bag_reader import BagReader, BagTopics
from twin.datasets.ros2.camera_info import stereo_calibration
from twin.errors import TwinError
from twin.recordings.frames import RecordedFrames
from twin.recordings.replay import ReplayOptions, open_dataset
from twin.recordings.replay import image_topics as named_topics

PATH = recorded.poses(5)
FILE = Path("survey.mcap")


@pytest.fixture(scope="module")
def frames():
    return recorded.frames(PATH)


@pytest.fixture(scope="module")
def bag(frames, tmp_path_factory):
    """Returns a bag of uncompressed colour images with true poses of the body on /truth."""
    truth = PATH @ geometry.inverse(RIG.body_from_camera)
    static = {
        ("base_link", LEFT): RIG.body_from_camera,
        ("base_link", RIGHT): RIG.body_from_camera @ RIG.left_from_right,
    }
    messages = [("/tf_static", START_NS, bags.ROS.transforms(START_NS, static)), *bags.stereo(frames)]
    messages += [
        ("/truth", START_NS, bags.ROS.odometry(START_NS + round(frame.time_s * 1e9), pose, np.zeros(6)))
        for frame, pose in zip(frames, truth, strict=True)
    ]
    return bags.write(tmp_path_factory.mktemp("bags") / "bag", messages)


def read(path, topics=None):
    """Returns the data set in a bag and its frames."""
    dataset = BagReader(topics).read(path)
    if isinstance(dataset.calibration, TwinError):
        raise dataset.calibration
    found = RecordedFrames(dataset, dataset.calibration)
    return dataset, found, list(found)


def test_the_frames_are_the_images_of_the_bag(bag, frames):
    dataset, found, images = read(bag)
    assert not found.skipped and dataset.truth is None and found.size_px == (RIG.width_px, RIG.height_px)
    for given, one in zip(frames, images, strict=True):
        np.testing.assert_array_equal(one.left, given.left)
        np.testing.assert_array_equal(one.right, given.right)
        assert one.time_s == pytest.approx(given.time_s, abs=1e-6)
    rig = found.rectification.rig
    assert rig.baseline_m == pytest.approx(RIG.baseline_m) and rig.focal_px == pytest.approx(RIG.focal_px)


def test_the_truth_is_that_of_the_left_camera(bag):
    truth = read(bag, BagTopics(truth="/truth"))[0].truth
    np.testing.assert_allclose(truth.world_from_camera, PATH, atol=1e-9)


def test_an_sqlite_bag_and_a_single_file_are_read_as_well(bag, frames, tmp_path):
    database = bags.write(tmp_path / "bag", bags.stereo(frames), StoragePlugin.SQLITE3)
    for path in (database, tmp_path / "bag" / "bag.db3", bag / "bag.mcap"):
        np.testing.assert_array_equal(read(path)[2][3].right, frames[3].right)


def test_the_truth_of_a_replay_is_that_of_the_topic(bag):
    opened = open_dataset(bag, ReplayOptions(truth=Path("/truth")))
    np.testing.assert_allclose(opened.truth.world_from_camera, PATH, atol=1e-9)
    np.testing.assert_allclose(opened.truth.times_s, recorded.trajectory(PATH).times_s, atol=1e-6)
    assert opened.reader == "ros2" and opened.name == "bag"


GREY = np.random.default_rng(1).integers(0, 256, (24, 32), dtype=np.uint8)
COLOUR = np.random.default_rng(2).integers(0, 256, (24, 32, 3), dtype=np.uint8)
ALPHA = np.dstack([COLOUR, GREY])
DEEP, DEEP_COLOUR = GREY.astype(np.uint16) * 251, COLOUR.astype(np.uint16) * 251


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("mono8", GREY, GREY),
        ("8UC1", GREY, GREY),
        ("rgb8", COLOUR, COLOUR[..., ::-1]),
        ("bgr8", COLOUR, COLOUR),
        ("rgba8", ALPHA, COLOUR[..., ::-1]),
        ("bgra8", ALPHA, COLOUR),
        ("mono16", DEEP, DEEP),
        ("16UC1", DEEP, DEEP),
        ("rgb16", DEEP_COLOUR, DEEP_COLOUR[..., ::-1]),
    ],
)
@pytest.mark.parametrize(("padding", "big_endian"), [(0, False), (6, False), (0, True)])
def test_encodings_of_images(encoding, pixels, expected, padding, big_endian):
    if big_endian and pixels.dtype == np.uint8:
        pytest.skip("bytes have no order")
    values = raw_pixels(bags.image(pixels, encoding, padding=padding, big_endian=big_endian), (32, 24))
    assert values.dtype == expected.dtype
    np.testing.assert_array_equal(values, expected)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_bayer_images_of_a_uniform_colour_have_this_colour(pattern, dtype):
    levels = {"r": 40, "g": 90, "b": 200}
    mosaic = np.tile(np.array([levels[letter] for letter in pattern], dtype).reshape(2, 2), (12, 16))
    values = raw_pixels(bags.image(mosaic, f"bayer_{pattern}{8 * dtype().itemsize}"), (32, 24))
    np.testing.assert_array_equal(values[4:-4, 4:-4], np.full((16, 24, 3), [200, 90, 40]))  # BGR


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (bags.image(GREY, "32FC1"), "encoding '32FC1' is not supported"),
        (bags.image(GREY, "rgb8"), "truncated"),
        (bags.image(GREY[:, :30], "mono8"), "another size"),
        (bags.image(GREY[:20], "mono8"), "another size"),
    ],
)
def test_an_image_that_cannot_be_used_has_a_reason(message, reason):
    with pytest.raises(UnreadableImage, match=reason):
        raw_pixels(message, (32, 24))


def test_compressed_images_are_read_and_damaged_ones_counted(frames, tmp_path):
    messages = [(f"/{side}/camera_info", START_NS, bags.info(side)) for side in ("left", "right")]
    for frame in frames:
        time_ns = START_NS + round(frame.time_s * 1e9)
        for side, pixels in (("left", frame.left), ("right", frame.right)):
            suffix = ".jpg" if side == "right" else ".png"
            data = cv2.imencode(suffix, pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
            data = data[: len(data) // 2] if (side, frame.index) == ("left", 2) else data
            message = bags.ROS.compressed_image(time_ns, side, "png", data)
            messages.append((f"/{side}/image_rect/compressed", time_ns, message))
    _, found, images = read(bags.write(tmp_path / "bag", messages))
    assert found.skipped == {"left image: truncated": 1}
    np.testing.assert_array_equal(images[2].left, frames[3].left)
    assert 0 < np.abs(images[2].right.astype(int) - frames[3].right).mean() < 4


def test_unpaired_late_and_unknown_images_are_counted(frames, tmp_path):
    messages = bags.stereo([frames[0], replace(frames[1], right=None), *frames[2:]])
    for _, _, message in messages[7:9]:
        message.header.stamp = bags.header(START_NS + 10**8).stamp
    alone_ns = START_NS + 5_000_000_000
    messages.append(("/right/image_rect", alone_ns, bags.image(frames[0].right, "rgb8", alone_ns)))
    messages.append(("/left/image_rect", alone_ns + 10**9, bags.image(GREY, "yuv999", alone_ns + 10**9)))
    _, found, images = read(bags.write(tmp_path / "bag", messages))
    assert [one.right is None for one in images] == [False, True, False, False]
    assert found.skipped == {
        "right image without left image": 1,
        "right image: missing": 1,
        "time out of order": 1,
        "left image: encoding 'yuv999' is not supported": 1,
    }


def test_images_without_stamps_get_the_times_of_recording(frames, tmp_path):
    messages = bags.stereo(frames)
    for _, _, message in messages[2:]:
        message.header.stamp = bags.make("builtin_interfaces/msg/Time", 0, 0)
    dataset, _, images = read(bags.write(tmp_path / "bag", messages))
    assert [one.time_s for one in images] == pytest.approx([frame.time_s for frame in frames], abs=1e-6)
    assert "times of recording" in dataset.notes[0]


def raw_rig(fisheye=False):
    """Returns messages CameraInfo of a raw rig, and its right_from_left and distortion."""
    size, left, right = (320, 240), np.array([[300, 0, 150.0], [0, 310, 122], [0, 0, 1]]), np.diag([290.0, 300, 1])
    right[:2, 2] = 165, 118
    pose = geometry.pose(geometry.so3_exp(np.array([0.01, -0.03, 0.02])), np.array([-0.12, 0.002, 0.003]))
    if fisheye:
        distortion, model = np.array([0.02, -0.01, 0.003, -0.001]), "equidistant"
        turns = cv2.fisheye.stereoRectify(
            left, distortion, right, distortion, size, pose[:3, :3].copy(), pose[:3, 3].copy(), flags=0
        )
    else:
        distortion, model = np.array([-0.2, 0.05, 0.001, -0.002, 0.01, 0.1, 0.02, -0.01]), "rational_polynomial"
        turns = cv2.stereoRectify(left, distortion, right, distortion, size, pose[:3, :3], pose[:3, 3:])
    messages = [
        bags.info(side, k=matrix.ravel(), d=distortion, distortion_model=model, r=np.ravel(turns[n]),
                  p=np.ravel(turns[n + 2]), width=320, height=240)
        for n, (side, matrix) in enumerate((("left", left), ("right", right)))
    ]  # fmt: skip
    return messages, pose, distortion


@pytest.mark.parametrize("fisheye", [False, True])
def test_a_raw_rig_is_recovered_from_its_rectification(fisheye):
    (left, right), pose, distortion = raw_rig(fisheye)
    found = stereo_calibration(left, right, False, None, FILE)
    np.testing.assert_allclose(found.right_from_left, pose, atol=1e-9)
    np.testing.assert_array_equal(found.left.distortion, distortion)
    assert found.left.kind == ("fisheye" if fisheye else "radtan") and found.left.size_px == (320, 240)
    np.testing.assert_array_equal(found.right.matrix, right.k.reshape(3, 3))


def test_the_baseline_is_that_of_the_static_transforms_if_the_projections_have_none(frames, tmp_path):
    body = geometry.pose(geometry.so3_exp(np.array([0.4, -0.2, 1.0])), np.array([0.3, 0.1, -0.2]))
    static = {("base_link", "mast"): body, ("mast", LEFT): body, ("mast", RIGHT): body @ RIG.left_from_right}
    messages = bags.stereo(frames[:1], p=np.column_stack([RIG.matrix, np.zeros(3)]).ravel())
    with pytest.raises(TwinError, match=r"/right/camera_info: has no baseline .*tf_static"):
        read(bags.write(tmp_path / "none", messages))
    messages.append(("/tf_static", START_NS, bags.ROS.transforms(START_NS, static)))
    calibration = read(bags.write(tmp_path / "bag", messages))[0].calibration
    np.testing.assert_allclose(calibration.right_from_left, geometry.inverse(RIG.left_from_right), atol=1e-12)


def test_swapped_projections_and_parts_of_images_are_named(frames, tmp_path):
    messages = bags.stereo(frames[:1])
    messages[0][2].p, messages[1][2].p = messages[1][2].p, messages[0][2].p
    with pytest.raises(TwinError, match="the baseline is negative"):
        read(bags.write(tmp_path / "swapped", messages))
    (left, right), _, _ = raw_rig()
    right.binning_x = 2
    with pytest.raises(TwinError, match="binned"):
        stereo_calibration(left, right, False, None, FILE)


def test_another_calibration_replaces_one_in_the_bag_that_cannot_be_used(frames, tmp_path):
    messages = bags.stereo(frames[:1], p=np.column_stack([RIG.matrix, np.zeros(3)]).ravel())
    path = bags.write(tmp_path / "bag", messages)
    with pytest.raises(TwinError, match="has no baseline"):
        open_dataset(path, ReplayOptions())
    file = recorded.write_colmap(tmp_path / "cameras.txt")
    opened = open_dataset(path, ReplayOptions(calibration=file))
    assert opened.frames.rectification.rig.baseline_m == pytest.approx(RIG.baseline_m)


def names(*topics):
    """Returns image topics with their calibrations; a topic that ends with ! has none."""
    kinds = {}
    for topic in topics:
        name = topic.rstrip("!")
        kinds[name] = "sensor_msgs/msg/CompressedImage" if "compressed" in name else "sensor_msgs/msg/Image"
        if not topic.endswith("!"):
            kinds[name.removesuffix("/compressed").rpartition("/")[0] + "/camera_info"] = "sensor_msgs/msg/CameraInfo"
    return image_topics(kinds)


@pytest.mark.parametrize(
    ("topics", "chosen"),
    [
        (("/left/image_raw", "/right/image_raw"), ("/left/image_raw", "/right/image_raw")),
        (("/a/cam1/image", "/a/cam0/image", "/thermal/image!"), ("/a/cam0/image", "/a/cam1/image")),
        (("/infra2/image", "/infra1/image", "/colour/image"), ("/infra1/image", "/infra2/image")),
        (("/left/i", "/left/i/compressed", "/right/i", "/left/i/compressedDepth"), ("/left/i", "/right/i")),
        (("/b/image", "/a/image"), ("/a/image", "/b/image")),  # by the baseline, see below
    ],
)
def test_the_stereo_pair_of_a_bag_is_found(topics, chosen):
    first = {"/a/camera_info": bags.info("left"), "/b/camera_info": bags.info("right")}
    found = stereo_topics(names(*topics), first.get, FILE)
    assert (found.left, found.right) == chosen and found.left_info.endswith("/camera_info")
    assert not found.rectified


@pytest.mark.parametrize(
    ("topics", "message"),
    [
        (
            ("/a/image", "/b/image", "/c/image"),
            r"ambiguous \(allowed: --topics LEFT,RIGHT of: /a/image, /b/image, /c/im",
        ),
        (("/left/a", "/left/b", "/right/a"), "ambiguous"),
        (("/left/image!", "/right/image!"), r"has no stereo pair \(allowed: --topics LEFT,RIGHT of: /left/image"),
        ((), r"has no stereo pair \(allowed: a bag with"),
    ],
)
def test_a_bag_without_a_clear_pair_is_one_line_with_its_topics(topics, message):
    with pytest.raises(TwinError, match=message):
        stereo_topics(names(*topics), lambda topic: None, FILE)


def test_named_topics_are_read_and_unknown_ones_listed(bag, frames, tmp_path):
    swapped = BagTopics(("/right/image_rect", "/left/image_rect"))
    with pytest.raises(TwinError, match="negative"):
        read(bag, swapped)
    with pytest.raises(TwinError, match=r"--topics: '/c' is not an image topic .*/left/image_rect, /right/image_rect"):
        read(bag, BagTopics(("/left/image_rect", "/c")))
    with pytest.raises(TwinError, match=r"--truth: '/c' is not a topic of poses .*/truth"):
        read(bag, BagTopics(truth="/c"))


def test_a_truth_of_a_body_that_is_not_joined_to_the_camera_is_one_line(frames, tmp_path):
    messages = [*bags.stereo(frames[:1]), ("/truth", START_NS, bags.ROS.odometry(START_NS, np.eye(4), np.zeros(6)))]
    with pytest.raises(TwinError, match=r"tf_static does not join the frame 'base_link' .* 'left_camera_optical"):
        read(bags.write(tmp_path / "bag", messages), BagTopics(truth="/truth"))


def test_a_truth_of_a_body_is_noted_if_the_images_name_no_frame(frames, tmp_path):
    messages = [*bags.stereo(frames[:1]), ("/truth", START_NS, bags.ROS.odometry(START_NS, np.eye(4), np.zeros(6)))]
    for topic, _, message in messages:
        if topic == "/left/image_rect":
            message.header.frame_id = ""
    dataset = BagReader(BagTopics(truth="/truth")).read(bags.write(tmp_path / "bag", messages))
    assert dataset.notes == ("The left images name no frame; the poses were taken as those of the left camera.",)


def damage(path, at, data=b""):
    """Overwrites bytes of a file from a position, or truncates it there without data."""
    contents = bytearray(path.read_bytes())
    contents[at : at + len(data) if data else None] = data
    path.write_bytes(contents)


@pytest.fixture
def copy(bag, tmp_path):
    path = tmp_path / "copy.mcap"
    path.write_bytes((bag / "bag.mcap").read_bytes())
    return path


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        (lambda data: data[: len(data) // 2], "copy.mcap: is truncated"),
        (lambda data: b"", "copy.mcap: is empty"),
        (lambda data: b"not a bag" * 10, "copy.mcap: is not an MCAP file"),
        (lambda data: data[:100] + bytes(len(data) - 200) + data[-100:], "copy.mcap: cannot be read"),
        (lambda data: data[:8] + data[-8:], "copy.mcap: cannot be read"),
    ],
)
def test_a_damaged_bag_is_one_line_with_the_file(copy, contents, message):
    copy.write_bytes(contents(copy.read_bytes()))
    with pytest.raises(TwinError, match=message) as error:
        read(copy)
    assert "\n" not in str(error.value)


def test_random_damage_never_ends_with_another_error(bag, tmp_path):
    data, rng = (bag / "bag.mcap").read_bytes(), np.random.default_rng(5)
    for _ in range(30):
        broken = np.frombuffer(data, np.uint8).copy()
        broken[rng.integers(0, len(broken), 200)] = rng.integers(0, 256, 200)
        broken[-2000:] = np.where(rng.random(2000) < 0.01, rng.integers(0, 256, 2000), broken[-2000:])
        (tmp_path / "broken.mcap").write_bytes(broken.tobytes())
        try:
            read(tmp_path / "broken.mcap")
        except TwinError as error:
            assert "\n" not in str(error)


def test_a_chunk_that_states_too_large_a_size_is_refused():
    bag_module._bound_decompression()
    for name, data in (("zstd", storage_mcap.zstd.compress(bytes(5000))), ("lz4", lz4.frame.compress(bytes(5000)))):
        assert len(storage_mcap.DECOMPRESSORS[name](data, 1000)) == 1001
        with pytest.raises(ValueError, match="larger than 1024 MiB"):
            storage_mcap.DECOMPRESSORS[name](data, 2**31)


MAGIC = b"\x89MCAP0\r\n"


def record(kind, data):
    """Returns a record of an MCAP file."""
    return bytes([kind]) + struct.pack("<Q", len(data)) + data


def text(value):
    """Returns a text or bytes in an MCAP record."""
    return struct.pack("<I", len(value)) + value


def bag_without_index(path, *records):
    """Writes an MCAP file with these records and without a summary."""
    header, footer = record(1, text(b"ros2") + text(b"")), record(2, bytes(20))
    path.write_bytes(MAGIC + header + b"".join(records) + footer + MAGIC)
    return path


def test_a_bag_without_index_is_refused(tmp_path):
    schema = record(3, struct.pack("<H", 1) + text(b"std_msgs/msg/Empty") + text(b"ros2msg") + text(b""))
    channel = record(4, struct.pack("<HH", 1, 1) + text(b"/a") + text(b"cdr") + text(b""))
    message = record(5, struct.pack("<HIQQ", 1, 0, 5, 5) + b"\0\1\0\0")
    with pytest.raises(TwinError, match="no index of chunks; `mcap recover"):
        Bag(bag_without_index(tmp_path / "bag.mcap", schema, channel, message))


def test_a_chunk_is_never_decompressed_beyond_its_stated_size(tmp_path):
    bomb = storage_mcap.zstd.compress(bytes(50_000_000))
    chunk = record(6, struct.pack("<QQQI", 0, 9, 1000, 0) + text(b"zstd") + struct.pack("<Q", len(bomb)) + bomb)
    with pytest.raises(TwinError, match="expected 1000 bytes, got 1001"):
        Bag(bag_without_index(tmp_path / "bag.mcap", chunk))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("relative_file_paths:\n  - bag.mcap", "relative_file_paths:\n  - other.mcap"), "other.mcap is missing"),
        (("compression_mode: ''", "compression_mode: file"), "the bag is compressed"),
        (("rosbag2_bagfile_information", "something"), "does not describe a ROS 2 bag"),
        (("storage_identifier: mcap", "storage_identifier: [1"), "is not valid YAML"),
    ],
)
def test_damaged_metadata_are_one_line(bag, change, message, tmp_path):
    changed = (bag / "metadata.yaml").read_text().replace("    - bag.mcap", "  - bag.mcap").replace(*change)
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "bag.mcap").write_bytes((bag / "bag.mcap").read_bytes())
    (folder / "metadata.yaml").write_text(changed)
    with pytest.raises(TwinError, match=message):
        read(folder)


def test_a_file_of_a_bag_must_lie_in_its_folder(bag, tmp_path):
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "metadata.yaml").write_text((bag / "metadata.yaml").read_text())
    (folder / "bag.mcap").symlink_to(bag / "bag.mcap")
    with pytest.raises(TwinError, match="leads out of the folder"):
        read(folder)


def test_a_missing_package_is_one_line_with_the_command_that_installs_it(bag, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(TwinError, match=r"rosbags, which is not installed .*pip install 'seabed-twin\[exchange\]'"):
        read(bag)


def test_named_topics_on_the_command_line():
    assert named_topics("/a, /b") == ("/a", "/b") and named_topics(None) is None
    for text in ("/a", "/a,/a", "/a,", "/a,/b,/c"):
        with pytest.raises(TwinError, match="--topics: .* is not two topics"):
            named_topics(text)
