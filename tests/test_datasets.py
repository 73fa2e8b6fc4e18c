"""Recorded data sets: readers, calibration files, rectification, images, and input that is damaged or hostile."""

import os
import shutil
import struct
import zlib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import recorded_datasets as recorded
from recorded_datasets import RIG
from scipy.spatial.transform import Rotation

from twin.app.outputs import new_folder, writing
from twin.core import geometry
from twin.core.records import Frame, Trajectory
from twin.datasets import image_files
from twin.datasets.calibration import RecordedCamera, StereoCalibration, checked
from twin.datasets.calibration_files import read_calibration
from twin.datasets.dataset import Dataset, ImageTime, StereoImages, pair_by_time
from twin.datasets.image_files import ImageFormat, UnreadableImage, image_format, image_size, read_rgb
from twin.datasets.readers import read_dataset
from twin.datasets.truth_files import read_truth
from twin.errors import TwinError
from twin.plugin import loading
from twin.recordings import opened_dataset
from twin.recordings.frames import RecordedFrames, increasing
from twin.recordings.rectification import rectification
from twin.recordings.replay import ReplayOptions, open_dataset
from twin.report.run_folder import load_run

RNG = np.random.default_rng(1)
GRAY = cv2.GaussianBlur(RNG.integers(0, 255, (RIG.height_px, RIG.width_px), np.uint8), (0, 0), 1.5)


def rgb(value):
    return np.full((RIG.height_px, RIG.width_px, 3), value, np.uint8)


def frames_of(n):
    return [Frame(k, 0.2 * k, rgb(10 * k), rgb(10 * k + 5)) for k in range(n)]


@pytest.fixture
def euroc(tmp_path):
    return recorded.write_euroc(tmp_path / "set", frames_of(4), recorded.poses(4))


def test_images_of_unequal_times_are_paired_with_the_nearest_one():
    left = [ImageTime(t, Path(f"l{t}")) for t in (0.0, 0.1, 0.2, 0.3)]
    right = [ImageTime(t, Path(f"r{t}")) for t in (0.305, 0.004, 0.15, 0.095)]
    frames, n_right_only = pair_by_time(left, right)
    assert [frame.right and frame.right.name for frame in frames] == ["r0.004", "r0.095", None, "r0.305"]
    assert n_right_only == 1


def test_images_that_are_listed_twice_are_paired():
    left, right = ([ImageTime(0.1 * (k // 2) + late, Path(f"{k}")) for k in range(8)] for late in (0.0, 0.001))
    frames, _ = pair_by_time(left, right)
    assert all(frame.right is not None for frame in frames)


def test_pairs_of_unsynchronised_cameras_are_named():
    left, right = ([ImageTime(0.2 * k + late, Path(f"{k}")) for k in range(5)] for late in (0.0, 0.02))
    with pytest.raises(TwinError, match=r"two cameras differ by 20 ms \(median\) .*up to 10 ms"):
        pair_by_time(left, right)


@pytest.mark.parametrize("write", [recorded.write_opencv, recorded.write_kalibr, recorded.write_colmap])
def test_opencv_kalibr_and_colmap_files_give_the_same_calibration(tmp_path, write):
    name = "cameras.txt" if write is recorded.write_colmap else "calibration.yaml"
    found = read_calibration(write(tmp_path / name))
    for camera in (found.left, found.right):
        assert camera.size_px == (RIG.width_px, RIG.height_px)
        np.testing.assert_allclose(camera.matrix, RIG.matrix, atol=1e-9)
        assert not camera.distortion.any()
    np.testing.assert_allclose(found.right_from_left, geometry.inverse(RIG.left_from_right), atol=1e-12)


@pytest.mark.parametrize(
    ("write", "changed", "message"),
    [
        ("opencv", {"T": np.array([0.15, 0, 0])}, "the baseline is negative .* are swapped"),
        ("opencv", {"T": np.zeros(3)}, "has no baseline"),
        ("opencv", {"T": None}, "has no baseline"),
        ("opencv", {"T": np.array([0.0, -0.15, 0])}, "not side by side"),
        ("opencv", {"M2": None}, "M2 is missing or not valid"),
        ("opencv", {"M1": -RIG.matrix}, "focal length of the left camera"),
        ("opencv", {"M1": np.diag([1e9, 1e9, 1])}, "the focal length of the left camera is 1e.09, 1e.09 px"),
        ("opencv", {"T": np.array([-1e300, 0, 0])}, "T is missing or not valid"),
        ("opencv", {"R": np.eye(3) * 2}, "not a rotation matrix"),
        ("opencv", {"D1": np.zeros((1, 3))}, "3 coefficients of distortion"),
        ("opencv", {"image_width": 3}, "image size"),
        ("kalibr", {"T_cn_cnm1": None}, "T_cn_cnm1 is missing"),
        ("kalibr", {"camera_model": "omni"}, "camera model 'omni' is not supported"),
        ("kalibr", {"distortion_model": "fov"}, "distortion model 'fov' is not supported"),
        ("kalibr", {"intrinsics": ["a", 1, 2, 3]}, "intrinsics is missing or not valid"),
    ],
)
def test_an_impossible_calibration_is_one_line_with_its_file(tmp_path, write, changed, message):
    file = getattr(recorded, f"write_{write}")(tmp_path / "calibration.yaml", **changed)
    with pytest.raises(TwinError, match=message) as error:
        read_calibration(file)
    assert str(error.value).startswith(str(file)) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("!!python/object/apply:os.system ['touch {}']", "not valid YAML"),
        ("a: [", "not valid YAML"),
        ("- 1", "not a YAML table"),
        ("M1: !!opencv-matrix {rows: 100000, cols: 100000, dt: d, data: []}", "not valid YAML"),
        ("x" * 2**21, "too large"),
        (
            "a: &a [x, x]\n" + "".join(f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in pairwise("abcdefghi")),
            "more than 100000 values",
        ),
        (
            "a: &a {x: 1}\n"
            + "".join(f"{b}: &{b} {{<<: [{', '.join([f'*{a}'] * 9)}]}}\n" for a, b in pairwise("abcdefghi")),
            "more than 100000 values",
        ),
        ("M1: &a [*a]", "a value that contains itself"),
        ("M1: [500, 0, 160]\nD1: [0, 0]\nM1: [600, 0, 160]", "'M1' is given twice"),
        ("cam0: {resolution: [640, 480], intrinsics: [1], intrinsics: [2]}", "'intrinsics' is given twice"),
    ],
)
def test_a_hostile_yaml_file_runs_no_code_and_takes_no_memory(tmp_path, text, message):
    file, made = tmp_path / "calibration.yaml", tmp_path / "made"
    file.write_text(text.replace("{}", str(made)) if "os.system" in text else text)
    with pytest.raises(TwinError, match=message):
        read_calibration(file)
    assert not made.exists()


def test_a_colmap_camera_without_a_rig_has_no_baseline(tmp_path):
    file = recorded.write_colmap(tmp_path / "cameras.txt")
    file.with_name("rigs.txt").unlink()
    with pytest.raises(TwinError, match="has no baseline"):
        read_calibration(file)


def test_an_empty_rig_and_an_endless_column_are_one_line(tmp_path):
    file = recorded.write_colmap(tmp_path / "cameras.txt")
    file.with_name("rigs.txt").write_text("# no rig\n")
    with pytest.raises(TwinError, match=r"rigs.txt:1: is not the rig of two cameras"):
        read_calibration(file)
    file.write_text("1," + "9" * 200_000)
    with pytest.raises(TwinError, match=r"cameras.txt: cannot be read: field larger"):
        read_calibration(file)


def raw_calibration(kind):
    """A stereo rig with distortion, convergence and different focal lengths."""
    size, pose = (320, 240), geometry.exp(np.array([0.01, 0.03, -0.02, -0.15, 0.004, 0.002]))
    coefficients = {"radtan": ([-0.2, 0.05, 1e-3, -5e-4, 0.0], [-0.15, 0.03, -8e-4, 4e-4, 0.0]),
                    "fisheye": ([-0.02, 0.01, -0.004, 0.001], [0.01, -0.006, 0.003, -0.001])}[kind]  # fmt: skip
    matrices = [np.array([[f, 0, cx], [0, 1.01 * f, cy], [0, 0, 1.0]]) for f, cx, cy in
                ((260, 158, 121), (265, 163, 118))]  # fmt: skip
    cameras = [RecordedCamera(size, k, np.array(d), kind) for k, d in zip(matrices, coefficients, strict=True)]
    return checked(StereoCalibration(*cameras, pose, Path("calibration.yaml")))


@pytest.mark.parametrize("kind, whole", [("radtan", True), ("fisheye", False), ("double_sphere", True)])
def test_a_fisheye_lens_without_coefficients_is_no_pinhole(kind, whole):
    matrix = np.array([[300, 0, 159.5], [0, 300, 119.5], [0, 0, 1.0]])
    n = {"radtan": 5, "fisheye": 4, "double_sphere": 2}[kind]
    pose = geometry.pose(np.eye(3), np.array([-0.1, 0.0, 0.0]))
    camera = RecordedCamera((320, 240), matrix, np.zeros(n), kind)
    found = rectification(checked(StereoCalibration(camera, camera, pose, Path("calibration.yaml"))), 10.0)
    assert [one is None for one in found.maps] == [whole] * 2


@pytest.mark.parametrize("kind", ["radtan", "fisheye"])
def test_rectified_pixels_come_from_where_opencv_projects_their_points(kind):
    """The map at the rectified projection of a point is the projection of the point by the recorded lens."""
    calibration = raw_calibration(kind)
    found = rectification(calibration, 10.0)
    rig = found.rig
    points = np.column_stack([RNG.uniform(-0.5, 0.5, 60), RNG.uniform(-0.35, 0.35, 60), RNG.uniform(1.5, 3, 60)])
    left = rig.project(points)
    right = left - np.column_stack([rig.fx_px * rig.baseline_m / points[:, 2], np.zeros(60)])
    in_left = geometry.transform(found.left_from_rectified, points)
    in_right = geometry.transform(calibration.right_from_left, in_left)
    project = cv2.fisheye.projectPoints if kind == "fisheye" else cv2.projectPoints
    for pixels, xyz, camera, maps in (
        (left, in_left, calibration.left, found.maps[0]), (right, in_right, calibration.right, found.maps[1]),
    ):  # fmt: skip
        expected = project(xyz[:, None], np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)[0][:, 0]
        inside = (pixels > 1).all(axis=1) & (pixels < [318, 238]).all(axis=1)
        assert inside.sum() > 40
        at = [cv2.remap(one, *pixels[inside].astype(np.float32).T[..., None], cv2.INTER_LINEAR)[:, 0]
              for one in np.moveaxis(maps, -1, 0)]  # fmt: skip
        # bilinear interpolation between pixels of a smooth map, in 1/32 px
        np.testing.assert_allclose(np.column_stack(at), expected[inside], atol=0.05)


def test_principal_points_that_differ_in_their_columns_shift_the_right_image_only():
    shifted = RIG.matrix.copy()
    shifted[0, 2] += 7
    cameras = [RecordedCamera((RIG.width_px, RIG.height_px), matrix, np.zeros(4)) for matrix in (RIG.matrix, shifted)]
    found = rectification(StereoCalibration(*cameras, geometry.inverse(RIG.left_from_right), Path("c")), 1.0)
    image = np.repeat(GRAY[..., None], 3, axis=2)
    assert found.rectified(image, "left") is image
    difference = found.rectified(image, "right")[:, :-7].astype(int) - image[:, 7:]
    assert np.abs(difference).max() <= 2 and np.mean(difference != 0) < 0.02  # positions have errors of 1e-5 px


def test_grey_colour_raw_and_deep_images_become_rgb(tmp_path):
    size = RIG.width_px, RIG.height_px
    colour = np.dstack([GRAY, GRAY // 2, 255 - GRAY])
    twelve = GRAY.astype(np.uint16) * 16
    twelve[0, 0] = 4095
    raw = np.zeros_like(GRAY)
    raw[::2, ::2] = 200  # the red pixels of RGGB
    for name, image in (("grey.png", GRAY), ("colour.tiff", colour[..., ::-1]), ("deep.png", twelve),
                        ("deep.tif", twelve), ("raw.png", raw)):  # fmt: skip
        assert cv2.imwrite(str(tmp_path / name), image)
    np.testing.assert_array_equal(read_rgb(tmp_path / "grey.png", size, ImageFormat()), np.dstack([GRAY] * 3))
    np.testing.assert_array_equal(read_rgb(tmp_path / "colour.tiff", size, ImageFormat()), colour)
    for name in ("deep.png", "deep.tif"):
        form = image_format([tmp_path / name], size, None)
        assert form.bits == 12
        assert np.abs(read_rgb(tmp_path / name, size, form)[5:, 5:, 0].astype(int) - GRAY[5:, 5:]).max() <= 1
    inner = read_rgb(tmp_path / "raw.png", size, ImageFormat(8, "RGGB"))[4:-4, 4:-4]
    assert inner[..., 0].min() == 200 and inner[..., 1:].max() == 0


@pytest.mark.parametrize(
    ("suffix", "reason"), [("png", "truncated"), ("jpg", "truncated"), ("tif", "truncated|no image")]
)
def test_a_truncated_image_is_not_used(tmp_path, suffix, reason):
    file = tmp_path / f"image.{suffix}"
    cv2.imwrite(str(file), GRAY)
    file.write_bytes(file.read_bytes()[: len(file.read_bytes()) // 2])
    with pytest.raises(UnreadableImage, match=reason):
        read_rgb(file, (RIG.width_px, RIG.height_px), ImageFormat())


@pytest.mark.parametrize("after", [b"\0\0", b"\xff\xff", b"\r\n", b"SEFT"])
@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_an_image_with_other_data_after_its_end_is_whole(tmp_path, suffix, after):
    file = tmp_path / f"image.{suffix}"
    cv2.imwrite(str(file), GRAY)
    file.write_bytes(file.read_bytes() + after)
    assert read_rgb(file, (RIG.width_px, RIG.height_px), ImageFormat()).shape[:2] == GRAY.shape


def test_a_frame_that_cannot_be_used_is_skipped_and_counted(euroc):
    left, right = (euroc / "mav0" / camera / "data" for camera in ("cam0", "cam1"))
    names = sorted(file.name for file in left.iterdir())
    (left / names[1]).write_bytes((left / names[1]).read_bytes()[:-20])
    (right / names[2]).unlink()
    cv2.imwrite(str(left / "9.png"), GRAY[:50])
    with (euroc / "mav0" / "cam0" / "data.csv").open("a") as file:
        file.write(f"5,{names[0]}\n9000000000,9.png\n")  # a time that goes backwards; another size
    dataset, _ = read_dataset(euroc)
    frames = RecordedFrames(dataset, dataset.calibration)
    found = list(frames)
    assert [frame.left[0, 0, 0] for frame in found] == [0, 20, 30]
    assert [frame.right is None for frame in found] == [False, True, False]
    assert [frame.index for frame in found] == [0, 1, 2]
    assert dict(frames.skipped) == {
        "left image: truncated": 1,
        "right image: missing": 1,
        "time out of order": 1,
        "left image: another size": 1,
    }


@pytest.mark.parametrize(
    ("times_s", "kept"),
    [
        ([9, 1, 2, 3], [1, 2, 3]),  # one wrong time at the start loses one frame, not all others
        ([1, 9, 2, 3], [0, 2, 3]),
        ([1, 1, 2, 2], [0, 2]),
        ([1, 2, 3, 4, 5, 1, 2, 3], [0, 1, 2, 3, 4]),  # the clock was set back
        ([1], [0]),
    ],
)
def test_a_largest_set_of_frames_with_increasing_times_is_kept(times_s, kept):
    assert np.flatnonzero(increasing(np.array(times_s, float))).tolist() == kept


def test_the_number_of_bits_is_that_of_both_cameras(euroc):
    """8 bits in the left images, 16 in the right ones: these must not be saturated."""
    files = list((euroc / "mav0" / "cam1" / "data").iterdir())
    for file in files:
        cv2.imwrite(str(file), np.where(np.eye(*GRAY.shape) > 0, 255, cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)))
    dataset, _ = read_dataset(euroc)
    expected = [frame.right for frame in RecordedFrames(dataset, dataset.calibration)]
    for file in files:
        cv2.imwrite(str(file), cv2.imread(str(file)).astype(np.uint16) * 257)
    found = [frame.right for frame in RecordedFrames(dataset, dataset.calibration)]
    np.testing.assert_array_equal(found, expected)


def test_an_image_of_too_many_pixels_is_not_called_one_of_another_size(monkeypatch):
    data = cv2.imencode(".png", GRAY)[1].tobytes()
    monkeypatch.setattr(image_files, "_MOST_PIXELS", GRAY.size - 1)
    with pytest.raises(image_files.UnreadableImage, match=f"more than {GRAY.size - 1} pixels"):
        image_files.decoded(data, (GRAY.shape[1], GRAY.shape[0]))


def test_true_positions_without_attitude_are_not_used_and_a_note_says_so(euroc):
    """leica0 of EuRoC has three columns after the time: the position of a prism."""
    (euroc / "mav0" / "state_groundtruth_estimate0").rename(euroc / "other")
    (euroc / "mav0" / "leica0").mkdir()
    (euroc / "mav0" / "leica0" / "data.csv").write_text("#timestamp [ns],x [m],y [m],z [m]\n0,1.0,2.0,3.0\n")
    dataset, _ = read_dataset(euroc)
    assert dataset.truth is None
    assert dataset.notes == ("The true positions (leica0) are not used: they have no attitude.",)


def test_an_euroc_folder_is_read_as_it_was_written(euroc):
    dataset, name = read_dataset(euroc)
    assert name == "euroc" and len(dataset.images) == 4
    np.testing.assert_allclose(np.diff([frame.time_s for frame in dataset.images]), 0.2, atol=1e-9)
    truth = recorded.trajectory(recorded.poses(4))
    np.testing.assert_allclose(dataset.truth.world_from_camera, truth.world_from_camera, atol=1e-9)
    np.testing.assert_allclose(dataset.truth.times_s, [frame.time_s for frame in dataset.images], atol=1e-9)
    found = rectification(dataset.calibration.for_images(RIG.width_px, RIG.height_px), 5.0)
    assert found.maps == (None, None)
    np.testing.assert_allclose(found.rig.matrix, RIG.matrix)
    assert found.rig.baseline_m == pytest.approx(RIG.baseline_m)


def test_kitti_truth_of_camera_0_becomes_that_of_the_left_colour_camera(tmp_path):
    folder = tmp_path / "sequences" / "03"
    for k, value in ((2, 40), (3, 50)):
        (folder / f"image_{k}").mkdir(parents=True)
        for name in ("000000", "000002"):
            cv2.imwrite(str(folder / f"image_{k}" / f"{name}.png"), rgb(value))
    lines = []
    for k, offset_m in enumerate((0.0, -0.15, 0.06, -0.09)):
        projection = RIG.matrix @ np.hstack([np.eye(3), [[offset_m], [0], [0]]])
        lines.append(f"P{k}: " + " ".join(f"{value:.12e}" for value in projection.ravel()))
    (folder / "calib.txt").write_text("\n".join(lines))
    (folder / "times.txt").write_text("0.0\n0.1\n0.2\n")
    (tmp_path / "poses").mkdir()
    turn = geometry.rotation_from_rpy(0.1, 0.2, 0.3)
    poses = [geometry.pose(turn, np.array([1.0, 2, k])) for k in range(3)]
    np.savetxt(tmp_path / "poses" / "03.txt", [pose[:3].ravel() for pose in poses])
    dataset, name = read_dataset(folder)
    assert name == "kitti"
    assert [frame.time_s for frame in dataset.images] == [0.0, 0.2]  # the second image is missing
    assert dataset.calibration.baseline_m == pytest.approx(0.15)
    expected = [1.0, 2, 0] + turn @ [-0.06, 0, 0]
    np.testing.assert_allclose(dataset.truth.positions[0], expected, atol=1e-9)


def test_times_of_a_plain_folder_come_from_its_list_or_from_the_names(tmp_path):
    recorded.write_folder(tmp_path / "a", frames_of(3))
    assert [frame.time_s for frame in read_dataset(tmp_path / "a")[0].images] == pytest.approx([100, 100.2, 100.4])
    (tmp_path / "a" / "times.txt").write_text("".join(f"{1_500_000_000_000 + 50 * k}\n" for k in range(3)))
    times_s = [frame.time_s for frame in read_dataset(tmp_path / "a")[0].images]  # milliseconds
    np.testing.assert_allclose(times_s, 1.5e9 + 0.05 * np.arange(3), rtol=1e-15)
    (tmp_path / "a" / "times.txt").write_text("1\n2\n")
    with pytest.raises(TwinError, match=r"times.txt: has 2 times .*3, one per image"):
        read_dataset(tmp_path / "a")
    (tmp_path / "a" / "times.txt").unlink()
    dataset, _ = read_dataset(tmp_path / "a")
    assert [frame.time_s for frame in dataset.images] == [0, 1, 2] and "no times" in dataset.notes[0]
    for side in ("left", "right"):
        for k in range(3):
            old = tmp_path / "a" / side / f"{k:04d}.png"
            old.rename(old.with_name(f"{1_500_000_000_000_000_000 + k * 50_000_000}.png"))
    dataset, _ = read_dataset(tmp_path / "a")
    np.testing.assert_allclose(np.diff([frame.time_s for frame in dataset.images]), 0.05, atol=1e-6)
    assert dataset.notes == ()


def test_two_images_of_the_same_name_are_refused(tmp_path):
    recorded.write_folder(tmp_path, frames_of(2))
    cv2.imwrite(str(tmp_path / "right" / "0001.jpg"), GRAY)
    with pytest.raises(TwinError, match=r"right: has several images called '0001' .*one suffix"):
        read_dataset(tmp_path)


def test_a_superscript_digit_is_no_number(euroc, tmp_path):
    recorded.write_folder(tmp_path / "plain", frames_of(2))
    for side in ("left", "right"):
        (tmp_path / "plain" / side / "0001.png").rename(tmp_path / "plain" / side / "\u00b2.png")
    (tmp_path / "plain" / "times.txt").unlink()
    assert len(read_dataset(tmp_path / "plain")[0].images) == 2
    (euroc / "mav0" / "cam0" / "data.csv").write_text("\u00b2,a.png\n")
    with pytest.raises(TwinError, match="is not a time and a file name"):
        read_dataset(euroc)


@pytest.mark.parametrize("name", ["../../../secret.png", "/etc/passwd", "a\0b"])
def test_a_list_cannot_name_a_file_outside_its_folder(euroc, name):
    (euroc / "mav0" / "cam0" / "data.csv").write_text(f"1000000000,{name}\n")
    with pytest.raises(TwinError, match="leads out of the folder"):
        read_dataset(euroc)


def test_a_link_cannot_lead_out_of_the_folder(tmp_path):
    recorded.write_folder(tmp_path / "set", frames_of(1))
    cv2.imwrite(str(tmp_path / "secret.png"), GRAY)
    (tmp_path / "set" / "left" / "0001.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(TwinError, match="leads out of the folder"):
        read_dataset(tmp_path / "set")


def test_a_folder_without_a_data_set_is_one_line(tmp_path):
    with pytest.raises(TwinError, match="does not exist"):
        read_dataset(tmp_path / "none")
    with pytest.raises(TwinError, match="is empty"):
        read_dataset(tmp_path)
    (tmp_path / "notes.txt").write_text("no images")
    with pytest.raises(TwinError, match="no layout that a reader knows .*euroc: .*kitti: .*folder: "):
        read_dataset(tmp_path)
    (tmp_path / "left").mkdir()
    (tmp_path / "right").mkdir()
    with pytest.raises(TwinError, match="no images of the left camera"):
        read_dataset(tmp_path)


def test_a_calibration_of_another_image_size_is_refused(tmp_path):
    folder = recorded.write_folder(tmp_path / "set", frames_of(1))
    recorded.write_opencv(folder / "calibration.yaml", image_width=2 * RIG.width_px)
    dataset, _ = read_dataset(folder)
    with pytest.raises(TwinError, match="calibrated for images of 480 x 180 px .*240 x 180 px, the size of the images"):
        RecordedFrames(dataset, dataset.calibration)


class _Listed:
    """A reader of another package."""

    name, layout = "listed", "a file called listed.txt"

    def recognises(self, folder):
        return (folder / "listed.txt").is_file()

    def read(self, folder):
        return Dataset(folder, [StereoImages(0.0, folder / "l.png", folder / "r.png")], None)


def test_a_reader_of_another_package_is_found(tmp_path, monkeypatch):
    entry = SimpleNamespace(name="listed", value="other:Listed", load=lambda: _Listed)
    monkeypatch.setattr(loading, "entry_points", lambda group: [entry] if group == "twin.readers" else [])
    (tmp_path / "listed.txt").touch()
    assert read_dataset(tmp_path)[1] == "listed"

    def fail():
        raise ImportError("no module")

    entry.load = fail
    with pytest.raises(TwinError, match="twin.readers listed: other:Listed: ImportError"):
        read_dataset(tmp_path)


def test_a_reader_of_another_package_that_fails_is_named(tmp_path, monkeypatch):
    entry = SimpleNamespace(name="listed", value="other:Listed", load=lambda: _Listed)
    monkeypatch.setattr(loading, "entry_points", lambda group: [entry] if group == "twin.readers" else [])
    (tmp_path / "listed.txt").touch()
    for read, message in ((lambda self, folder: 1 / 0, "ZeroDivisionError"), (lambda self, folder: 5, "returned int")):
        monkeypatch.setattr(_Listed, "read", read)
        with pytest.raises(TwinError, match=f"twin.readers listed: other:Listed.*{message}"):
            read_dataset(tmp_path)
    monkeypatch.delattr(_Listed, "recognises")
    with pytest.raises(TwinError, match="twin.readers listed: other:Listed: AttributeError"):
        read_dataset(tmp_path)


def test_files_of_true_poses_are_told_apart(euroc, tmp_path):
    dataset, _ = read_dataset(euroc)
    truth = recorded.trajectory(recorded.poses(4))
    truth.save(tmp_path / "tum.txt")
    np.savetxt(tmp_path / "kitti.txt", truth.world_from_camera[:, :3].reshape(-1, 12))
    tum = read_truth(tmp_path / "tum.txt", dataset)
    np.testing.assert_allclose(tum.world_from_camera, truth.world_from_camera, atol=1e-7)
    kitti = read_truth(tmp_path / "kitti.txt", dataset)
    np.testing.assert_allclose(kitti.world_from_camera, truth.world_from_camera @ RIG.body_from_camera, atol=1e-9)
    bad = {
        "": "has no poses",
        "1 2 3\n": "has 3 columns",
        "0 1 2 3 0 0 0 2\n": "not of unit length",
        "0 1 2 3 0 0 0 x\n": ":1: is not a line of numbers",
        "1403636579763555584 1 2 3 0 0 0.5 0.8660254\n": "has the time 1403636579763555584 .*seconds, as in TUM",
    }
    for text, message in bad.items():
        (tmp_path / "bad.txt").write_text(text)
        with pytest.raises(TwinError, match=message):
            read_truth(tmp_path / "bad.txt", dataset)


def test_poses_of_a_marker_become_those_of_the_camera_by_its_pose_in_the_body(euroc):
    before, _ = read_dataset(euroc)
    marker = geometry.exp(np.array([0.3, -1.2, 0.8, 0.07, -0.01, -0.12]))
    folder = euroc / "mav0" / "vicon0"
    (euroc / "mav0" / "state_groundtruth_estimate0").rename(folder)
    body = before.truth.world_from_camera @ geometry.inverse(before.body_from_left)
    quaternions = Rotation.from_matrix((body @ marker)[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    times_ns = np.round(before.truth.times_s * 1e9).astype(np.int64)
    rows = [f"{t}," + ",".join(map(repr, [*p, *q])) for t, p, q in
            zip(times_ns.tolist(), (body @ marker)[:, :3, 3].tolist(), quaternions.tolist(), strict=True)]  # fmt: skip
    (folder / "data.csv").write_text("#\n" + "\n".join(rows))
    values = ", ".join(map(repr, marker.ravel().tolist()))
    (folder / "sensor.yaml").write_text(f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{values}]\n")
    dataset, _ = read_dataset(euroc)
    np.testing.assert_allclose(dataset.truth.world_from_camera, before.truth.world_from_camera, atol=1e-8)


@pytest.mark.parametrize("missing", ["left", "right"])
def test_a_pose_per_line_belongs_to_the_frame_of_its_number_also_where_an_image_is_missing(tmp_path, missing):
    folder = recorded.write_folder(tmp_path / "set", frames_of(4))
    (folder / missing / "0001.png").unlink()
    dataset, _ = read_dataset(folder)
    poses = recorded.poses(4)
    np.savetxt(tmp_path / "kitti.txt", poses[:, :3].reshape(-1, 12))
    truth = read_truth(tmp_path / "kitti.txt", dataset)
    for frame in dataset.images:
        row = int(np.argmin(np.abs(truth.times_s - frame.time_s)))
        assert truth.times_s[row] == pytest.approx(frame.time_s, abs=1e-9)
        np.testing.assert_allclose(truth.world_from_camera[row], poses[int(frame.left.stem)], atol=1e-9)


def test_a_stored_image_of_another_size_is_not_used():
    """A reader of another package returns objects whose `pixels` may ignore the size."""

    class Stored:
        name = "frame 7"

        def size_px(self):
            return 6, 4

        def pixels(self, size_px):
            return np.zeros((4, 6), np.uint8)

    assert image_files.read_rgb(Stored(), (6, 4), image_files.ImageFormat()).shape == (4, 6, 3)
    with pytest.raises(image_files.UnreadableImage, match="another size"):
        image_files.read_rgb(Stored(), (8, 4), image_files.ImageFormat())


def test_a_focal_length_far_below_the_image_size_is_refused(tmp_path):
    matrix = np.array([[5.0, 0, RIG.cx_px], [0, 5.0, RIG.cy_px], [0, 0, 1]])
    file = recorded.write_opencv(tmp_path / "calibration.yaml", M1=matrix)
    with pytest.raises(TwinError, match=r"the focal length of the left camera is 5, 5 px .allowed: at least 0.05 of"):
        read_calibration(file).for_images(RIG.width_px, RIG.height_px)


@pytest.mark.parametrize(
    ("times", "problem"),
    [
        ([f"{k}e300" for k in range(3)], "the time of 0001.png is 1e.300 s .allowed: seconds, up to 1e.11"),
        ([str(170_000_000_000_000_000 + k * 10**8) for k in range(3)], "the time of 0000.png is 1.7e.17 s"),
        (["0.0", "5e-324", "1e-323"], "the median interval between its frames is 4.94066e-324 s"),
        (["100.0", "100.000000001", "100.000000002"], "the median interval between its frames is 9.99997e-10 s"),
        (["0", "100000000", "200000000"], r"the median interval between its frames is 1e\+08 s"),
    ],
)
def test_times_that_cannot_be_seconds_are_refused(tmp_path, times, problem):
    folder = recorded.write_folder(tmp_path / "set", recorded.frames(recorded.poses(3)))
    (folder / "times.txt").write_text("\n".join(times))
    with pytest.raises(TwinError, match=problem):
        read_dataset(folder)


@pytest.mark.parametrize("digits", [20, 400, 5000])
def test_a_time_with_too_many_digits_is_refused_with_its_line(euroc, tmp_path, digits):
    folder = shutil.copytree(euroc, tmp_path / "copy")
    table = folder / "mav0" / "cam0" / "data.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join([*lines[:2], "9" * digits + "," + lines[2].split(",")[1]]))
    with pytest.raises(TwinError, match=r"cam0/data.csv:3: is not a time and a file name"):
        read_dataset(folder)


def test_hidden_files_are_no_images_and_a_folder_of_other_files_is_named(tmp_path):
    folder = recorded.write_folder(tmp_path / "set", recorded.frames(recorded.poses(1)))
    (folder / "left" / "._0000.png").write_bytes(b"Mac OS X")
    assert len(read_dataset(folder)[0].images) == 1
    for file in folder.glob("*/*0000.png"):
        file.rename(file.with_suffix(".bmp"))
    with pytest.raises(TwinError, match=r"has no images of the left camera or of the right one .allowed: .png, .jpg"):
        read_dataset(folder)


def test_folders_in_place_of_files_are_refused(euroc, tmp_path):
    folder = recorded.write_folder(tmp_path / "plain", recorded.frames(recorded.poses(1)))
    (folder / "times.txt").unlink()
    (folder / "times.txt").mkdir()
    with pytest.raises(TwinError, match="times.txt: is not a regular file"):
        read_dataset(folder)
    copy = shutil.copytree(euroc, tmp_path / "copy")
    truth = copy / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    truth.unlink()
    truth.mkdir()
    assert isinstance(read_dataset(copy)[0].truth, TwinError)


def test_one_image_of_another_size_at_the_start_is_skipped(tmp_path):
    folder = recorded.write_folder(tmp_path / "set", recorded.frames(recorded.poses(4)))
    cv2.imwrite(str(folder / "left" / "0000.png"), np.zeros((20, 30, 3), np.uint8))
    dataset, _ = read_dataset(folder)
    frames = RecordedFrames(dataset, dataset.calibration)
    assert len(list(frames)) == 3 and frames.skipped == {"left image: another size": 1}


def test_an_image_with_too_many_pixels_is_named_so(tmp_path):
    header = struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0)
    chunk = b"IHDR" + header
    bomb = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    bomb += struct.pack(">I", 0) + b"IDAT" + struct.pack(">I", zlib.crc32(b"IDAT"))
    (tmp_path / "bomb.png").write_bytes(bomb)
    with pytest.raises(UnreadableImage, match="too many pixels"):
        image_size(tmp_path / "bomb.png")


def test_a_path_that_is_too_long_is_one_line():
    with pytest.raises(TwinError, match="File name too long"):
        read_dataset(Path("x" * 5000))


def test_a_path_that_is_too_long_is_one_line_also_with_a_topic_of_true_poses():
    with pytest.raises(TwinError, match="File name too long"):
        open_dataset(Path("x" * 5000), ReplayOptions(truth=Path("/truth")))


def test_a_path_that_is_not_utf8_is_refused_before_opencv_crashes_on_it(tmp_path):
    folder = os.fsencode(tmp_path) + b"/\xff\xfe"
    os.mkdir(folder)
    path = Path(os.fsdecode(folder))
    for check in (read_dataset, load_run, new_folder):
        with pytest.raises(TwinError, match=r"udcff.udcfe.*: is not text in UTF-8") as error:
            check(path)
        assert str(error.value).isascii()


def test_an_unreadable_folder_is_one_line_with_its_name(tmp_path, monkeypatch):
    folder = recorded.write_folder(tmp_path / "set", recorded.frames(recorded.poses(1)))

    def refused(path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "iterdir", lambda path: refused(path) if path.name == "left" else iter([path]))
    with pytest.raises(TwinError, match="set/left: cannot be read: Permission denied"):
        read_dataset(folder)


@pytest.mark.parametrize("method", ["iterdir", "is_dir"])
def test_a_folder_that_may_not_be_listed_or_entered_is_one_line_with_its_name(method, tmp_path, monkeypatch):
    """A folder without permission r fails when it is listed, one without permission x when a file in it is tested."""
    folder = recorded.write_folder(tmp_path / "set", recorded.frames(recorded.poses(1)))
    original = getattr(Path, method)

    def refused(path):
        if path == folder and method == "iterdir" or path.parent == folder:
            raise PermissionError(13, "Permission denied", str(path))
        return original(path)

    monkeypatch.setattr(Path, method, refused)
    with pytest.raises(TwinError, match="set.*: cannot be read: Permission denied"):
        open_dataset(folder, ReplayOptions(truth=Path("/truth")))


def test_a_bayer_pattern_for_images_with_colours_is_refused(euroc):
    with pytest.raises(TwinError, match=r"--bayer: .*\.png has colours already"):
        open_dataset(euroc, ReplayOptions(bayer="RGGB"))


def test_a_truth_without_poses_is_one_line(euroc, monkeypatch):
    """Readers of other packages may return one; those of this package refuse such files."""
    dataset, name = read_dataset(euroc)
    empty = replace(dataset, truth=Trajectory(np.zeros(0), np.zeros((0, 4, 4))))
    monkeypatch.setattr(opened_dataset, "read_dataset", lambda *_: (empty, name))
    with pytest.raises(TwinError, match="set: the truth has no poses"):
        open_dataset(euroc, ReplayOptions())


def test_an_error_of_another_file_does_not_blame_the_output(tmp_path):
    cases = {
        "/run/image.png": "/run/image.png: cannot be read or written: Permission denied",
        str(tmp_path / "out" / "a"): "--out: .*out cannot be written: Permission denied",
    }
    for named, problem in cases.items():
        with pytest.raises(TwinError, match=problem), writing(tmp_path / "out"):
            raise PermissionError(13, "Permission denied", named)
