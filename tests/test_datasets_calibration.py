"""Calibration files: what no one may drop or misread, and files of other programs against their own camera models."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import recorded_datasets as recorded
import yaml
from recorded_datasets import RIG

from twin.core import geometry
from twin.datasets.calibration import RecordedCamera, StereoCalibration, checked
from twin.datasets.calibration_files import find_calibration, read_calibration
from twin.errors import TwinError

LENS = np.array([-0.28, 0.07, 2e-4, 2e-5])
FISHEYE = np.array([-0.01, 0.02, -0.03, 0.01])


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_all_formats_that_opencv_writes_give_the_same_calibration(tmp_path, suffix):
    found = read_calibration(recorded.write_opencv(tmp_path / f"rig.{suffix}", D1=LENS, D2=LENS))
    np.testing.assert_allclose(found.left.matrix, RIG.matrix, rtol=1e-12)
    np.testing.assert_allclose(found.right.distortion, LENS)
    assert found.left.size_px == (RIG.width_px, RIG.height_px) and found.baseline_m == pytest.approx(0.15)


def test_matrices_and_distortions_are_read_under_the_names_in_use(tmp_path):
    renamed = {"K1": RIG.matrix, "K2": RIG.matrix, "dist1": LENS, "dist_coeffs_2": LENS}
    none = dict.fromkeys(("M1", "M2", "D1", "D2"))
    file = recorded.write_opencv(tmp_path / "rig.yml", **none, **renamed, R1=np.eye(3), Q=np.eye(4), rms=0.3)
    found = read_calibration(file)
    np.testing.assert_allclose([found.left.distortion, found.right.distortion], [LENS, LENS])


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"D1": None, "lens1": LENS}, "unknown or repeated keys.*'lens1'"),
        ({"dist1": LENS}, "unknown or repeated keys.*'dist1'"),
        ({"xi": 1.0}, "'xi'"),
        ({"M1": RIG.matrix + 12 * np.eye(3, k=1)}, "left camera has a skew of 12 px"),
        ({"D1": FISHEYE, "D2": FISHEYE}, "four coefficients .* fisheye .*distortion_model"),
        ({"D2": np.array([-0.2, 0.1, 0.0, 0.0])}, "four coefficients"),
        ({"T": np.array([-9.5, 0, 0]), "T_unit": "feet"}, "T_unit 'feet' is not known"),
    ],
)
def test_what_would_be_dropped_or_misread_is_refused_by_name(tmp_path, changed, message):
    file = recorded.write_opencv(tmp_path / "rig.yml", **changed)
    with pytest.raises(TwinError, match=message) as error:
        read_calibration(file)
    assert "\n" not in str(error.value)


def test_a_stated_model_and_a_stated_unit_are_used(tmp_path):
    changed = {"D1": FISHEYE, "D2": FISHEYE, "distortion_model": "fisheye", "T": np.array([-150.0, 0, 0])}
    found = read_calibration(recorded.write_opencv(tmp_path / "rig.yml", **changed, T_unit="mm"))
    assert found.left.kind == "fisheye" and found.baseline_m == pytest.approx(0.15)


def test_a_calibration_of_other_images_without_a_size_is_refused_with_both_sizes(tmp_path):
    other = np.diag([1.33, 1.33, 1]) @ RIG.matrix
    none = dict.fromkeys(("image_width", "image_height"))
    for matrix, message in ((other, "implies about 319 x 239 px .*240 x 180 px"), (RIG.matrix, None)):
        found = read_calibration(recorded.write_opencv(tmp_path / "rig.yml", **none, M1=matrix, M2=matrix))
        if message is None:
            assert found.for_images(RIG.width_px, RIG.height_px).left.size_px == (RIG.width_px, RIG.height_px)
            continue
        with pytest.raises(TwinError, match=message):
            found.for_images(RIG.width_px, RIG.height_px)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.yaml", "model_type: PINHOLE\nprojection_parameters: {fx: 500.0}", "VINS"),
        ("a.yaml", "model: OpenCV\nwidth: 640\nparameters: [500.0]", "Calibmar"),
        ("a.yaml", "Camera.type: PinHole\nCamera.fx: 500.0", "ORB-SLAM2"),
        (
            "cameras.txt",
            "1 OPENCV 640 480 500 500 320 240 0 0 0 0 FLATPORT 0 0 1 0.05 1.0 1.52 1.334",
            "refractive",
        ),
        ("a.xml", "<!DOCTYPE a [<!ENTITY b 'c'>]><opencv_storage/>", "not valid XML"),
        ("a.xml", "<opencv_storage><M1>1</M1><M1>2</M1></opencv_storage>", "repeated keys.*'M1'"),
        ("a.yaml", "cam0: {}\ncam1: {}\nrig: 1", "'rig'"),
    ],
)
def test_a_file_that_is_not_read_is_refused_by_the_name_of_its_program_or_key(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(TwinError, match=message):
        read_calibration(tmp_path / name)


def test_an_unknown_key_of_a_kalibr_camera_is_refused(tmp_path):
    with pytest.raises(TwinError, match="'line-delay'"):
        read_calibration(recorded.write_kalibr(tmp_path / "camchain.yaml", **{"line-delay": 1e-5}))


def points(seed=0, n=50):
    """Returns points (n, 3) in front of a stereo pair [m]."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.5, 0.5, n), rng.uniform(-0.4, 0.4, n), rng.uniform(1.5, 3, n)])


def pixels(camera: RecordedCamera, xyz):
    """Returns the pixels (n, 2) of points (n, 3) in the axes of a camera by OpenCV's models."""
    project = cv2.fisheye.projectPoints if camera.kind == "fisheye" else cv2.projectPoints
    zero = np.zeros(3)
    return np.asarray(project(xyz[:, None], zero, zero, camera.matrix, camera.distortion)[0]).reshape(-1, 2)


def write_ros(folder: Path):
    """Writes the two files of a rig with distortion and convergence, with R and P of cv2.stereoRectify."""
    matrix, size = RIG.matrix + [[0, 0, 3.0], [0, 0, -2.0], [0, 0, 0]], (RIG.width_px, RIG.height_px)
    rotation = geometry.so3_exp(np.array([0.01, -0.02, 0.015]))
    translation = np.array([-0.15, 0.002, 0.004])
    lens = np.append(LENS, 0.0)
    turns = cv2.stereoRectify(matrix, lens, matrix, lens, size, rotation, translation[:, None], alpha=0.0)[:4]
    for side, r, p in (("left", turns[0], turns[2]), ("right", turns[1], turns[3])):
        tree = {
            "image_width": size[0], "image_height": size[1], "camera_name": side, "distortion_model": "plumb_bob",
            "camera_matrix": matrix, "distortion_coefficients": lens, "rectification_matrix": r, "projection_matrix": p,
        }  # fmt: skip
        tree = {k: {"data": v.ravel().tolist()} if isinstance(v, np.ndarray) else v for k, v in tree.items()}
        (folder / f"{side}.yaml").write_text(yaml.safe_dump(tree))
    return turns


def test_a_ros_pair_projects_as_its_projection_matrices_do(tmp_path):
    r_left, r_right, p_left, p_right = write_ros(tmp_path)
    found = read_calibration(tmp_path / "right.yaml")
    shift, size = np.array([p_right[0, 3] / p_right[0, 0], 0, 0]), (RIG.width_px, RIG.height_px)
    v, u = np.mgrid[: RIG.height_px : 20, : RIG.width_px : 20].reshape(2, -1)
    depth_m = np.random.default_rng(0).uniform(1, 3, len(u))[:, None]
    for camera, pose, r, p, moved in (
        (found.left, np.eye(4), r_left, p_left, 0 * shift),
        (found.right, found.right_from_left, r_right, p_right, shift),
    ):
        maps = cv2.initUndistortRectifyMap(camera.matrix, camera.distortion, r, p[:, :3], size, cv2.CV_32FC1)
        rectified = np.column_stack([u, v, np.ones(len(u))]) @ np.linalg.inv(p[:, :3]).T * depth_m
        seen = pixels(camera, geometry.transform(pose, (rectified - moved) @ r_left))
        np.testing.assert_allclose(seen, np.column_stack([one[v, u] for one in maps]), atol=0.01)
    assert find_calibration(tmp_path) == tmp_path / "left.yaml"
    (tmp_path / "right.yaml").unlink()
    with pytest.raises(TwinError, match="right.yaml"):
        read_calibration(tmp_path / "left.yaml")


@pytest.mark.parametrize("model", ["PinHole", "KannalaBrandt8"])
def test_an_orbslam_file_projects_as_its_own_model(tmp_path, model):
    names, lens = ("k1", "k2", "p1", "p2"), LENS
    if model == "KannalaBrandt8":
        names, lens = ("k1", "k2", "k3", "k4"), FISHEYE
    left_from_right = geometry.pose(geometry.so3_exp(np.array([0.01, -0.02, 0.0])), np.array([0.15, 0.002, 0.001]))
    tree = {"File.version": "1.0", "Camera.type": model, "Camera.width": 640, "Camera.height": 480, "Camera.fps": 20}
    for side in (1, 2):
        tree |= {
            f"Camera{side}.{k}": v for k, v in zip(("fx", "fy", "cx", "cy"), (500.0, 501.0, 321.0, 238.0), strict=True)
        }
        tree |= {f"Camera{side}.{k}": float(v) for k, v in zip(names, lens, strict=True)}
    file = tmp_path / "rig.yaml"
    file.write_text(
        "%YAML:1.0\n" + yaml.safe_dump(tree) + "Stereo.T_c1_c2: !!opencv-matrix\n  rows: 4\n  cols: 4\n  dt: f\n"
        f"  data: {left_from_right.ravel().tolist()}\n"
    )
    found = read_calibration(file)
    in_right = points()
    in_left = geometry.transform(left_from_right, in_right)
    for camera, xyz in ((found.left, in_left), (found.right, geometry.transform(found.right_from_left, in_left))):
        x, y = xyz[:, 0] / xyz[:, 2], xyz[:, 1] / xyz[:, 2]
        r2 = x * x + y * y
        if model == "PinHole":  # Pinhole.cpp with the distortion of OpenCV
            k1, k2, p1, p2 = lens
            radial = 1 + k1 * r2 + k2 * r2**2
            u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
            v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        else:  # KannalaBrandt8.cpp
            theta = np.arctan(np.sqrt(r2))
            scale = (theta + sum(k * theta ** (2 * n + 3) for n, k in enumerate(lens))) / np.sqrt(r2)
            u, v = x * scale, y * scale
        np.testing.assert_allclose(pixels(camera, xyz), np.column_stack([500 * u + 321, 501 * v + 238]), atol=0.01)
    np.testing.assert_allclose(geometry.transform(found.right_from_left, in_left), in_right, atol=1e-9)
    assert checked(found).baseline_m == pytest.approx(np.linalg.norm(left_from_right[:3, 3]))


def test_a_matrix_with_skew_is_refused_whatever_its_source():
    camera = RecordedCamera((640, 480), np.array([[500, 0.5, 320], [0, 500, 240], [0, 0, 1.0]]), np.zeros(0))
    with pytest.raises(TwinError, match="skew of 0.5 px"):
        checked(StereoCalibration(camera, camera, geometry.inverse(RIG.left_from_right), Path("bag")))
