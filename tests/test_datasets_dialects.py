"""Calibration files of 12 dialects: each projects as its own published camera model, or is refused by its key.

The oracles state the models and conventions of the other programs: lens, pixel of the first centre, direction of poses.
"""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import recorded_datasets as recorded
import yaml

from twin.core import geometry
from twin.datasets.calibration import RecordedCamera, StereoCalibration
from twin.datasets.calibration_files import read_calibration
from twin.datasets.euroc import EurocReader
from twin.datasets.text_files import read_yaml
from twin.errors import TwinError
from twin.recordings.rectification import rectification

SIZE = 640, 480
FX, FY, CX, CY = 410.0, 412.0, 322.5, 236.0  # of the left camera; the right one has 3 px more each
RADTAN = (-0.28, 0.07, 2e-4, -3e-4)
RADTAN8 = (-0.2, 0.05, 3e-4, -2e-4, 0.01, 0.02, -0.01, 0.003)
FISHEYE = (-0.01, 0.02, -0.03, 0.01)
DOUBLE_SPHERE = (-0.2, 0.6)  # xi, alpha
BODY_FROM_LEFT = geometry.pose(geometry.so3_exp(np.array([1.2, -0.4, 0.7])), np.array([0.2, -0.1, 0.3]))
RIGHT_FROM_LEFT = geometry.pose(geometry.so3_exp(np.array([0.01, -0.02, 0.015])), np.array([-0.15, 0.002, 0.004]))
BODY_FROM_RIGHT = BODY_FROM_LEFT @ np.linalg.inv(RIGHT_FROM_LEFT)
FOCALS = (FX, FY, CX, CY), (FX + 3, FY + 3, CX + 3, CY + 3)
MATRICES = [np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]) for fx, fy, cx, cy in FOCALS]


def points(widest_deg=40.0, n=60):
    """Returns points (n, 3) in the axes of the left camera, up to an angle from its axis [m]."""
    rng = np.random.default_rng(3)
    angle, turn, range_m = np.radians(rng.uniform(0, widest_deg, n)), rng.uniform(0, 6.3, n), rng.uniform(1, 3, n)
    rays = np.column_stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)])
    return rays * range_m[:, None]


def brown(xyz, k1, k2, p1, p2, k3=0.0, k4=0.0, k5=0.0, k6=0.0):
    """Brown's model in the notation of OpenCV and OKVIS, with the rational terms of both."""
    x, y = (xyz[:, :2] / xyz[:, 2:]).T
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return np.column_stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
    )


def kannala_brandt(xyz, k1, k2, k3, k4):
    """KannalaBrandt8 of ORB-SLAM3, equidistant of Kalibr, KANNALA_BRANDT of CamOdoCal, kb4 of Basalt."""
    theta = np.arccos(xyz[:, 2] / np.linalg.norm(xyz, axis=1))
    psi = np.arctan2(xyz[:, 1], xyz[:, 0])
    radius = theta + k1 * theta**3 + k2 * theta**5 + k3 * theta**7 + k4 * theta**9
    return np.column_stack([radius * np.cos(psi), radius * np.sin(psi)])


def double_sphere(xyz, xi, alpha):
    """Usenko, Demmel & Cremers 2018: a shift by xi between two unit spheres, then a pinhole."""
    x, y, z = xyz.T
    d1 = np.sqrt(x**2 + y**2 + z**2)
    d2 = np.sqrt(x**2 + y**2 + (xi * d1 + z) ** 2)
    scale = alpha * d2 + (1 - alpha) * (xi * d1 + z)
    return np.column_stack([x / scale, y / scale])


def metashape_frame(xyz, k1, k2, k3, p1, p2):
    """Frame camera of the Metashape manual, appendix "Camera models", without K4, P3, P4."""
    x, y = (xyz[:, :2] / xyz[:, 2:]).T
    r = np.hypot(x, y)
    radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
    return np.column_stack(
        [x * radial + p1 * (r**2 + 2 * x**2) + 2 * p2 * x * y, y * radial + p2 * (r**2 + 2 * y**2) + 2 * p1 * x * y]
    )


METASHAPE = (-0.28, 0.07, 0.02, 3e-4, -2e-4)  # k1, k2, k3, p1, p2
LENSES = {"radtan": (brown, RADTAN), "radtan8": (brown, RADTAN8), "fisheye": (kannala_brandt, FISHEYE)} | {
    "ds": (double_sphere, DOUBLE_SPHERE), "none": (brown, (0.0, 0.0, 0.0, 0.0)), "radial": (brown, (-0.1, 0, 0, 0)),
    "metashape": (metashape_frame, METASHAPE),
}  # fmt: skip


def yaml_file(folder: Path, tree, name="rig.yaml", head=""):
    (folder / name).write_text(head + yaml.safe_dump(tree))
    return folder / name


def json_file(folder: Path, tree):
    (folder / "rig.json").write_text(json.dumps(tree))
    return folder / "rig.json"


def opencv(folder, lens, suffix="yml", **changed):
    kind = {"distortion_model": "fisheye"} if lens == "fisheye" else {}
    distortion = np.array(LENSES[lens][1])
    values = {
        "image_width": SIZE[0], "image_height": SIZE[1], "M1": MATRICES[0], "M2": MATRICES[1], "D1": distortion,
        "D2": distortion, "R": RIGHT_FROM_LEFT[:3, :3], "T": RIGHT_FROM_LEFT[:3, 3:],
    }  # fmt: skip
    return recorded.write_opencv(folder / f"rig.{suffix}", **values | kind | changed)


def opencv_names(folder, lens):
    unnamed, distortion = dict.fromkeys(("M1", "M2", "D1", "D2")), np.array(LENSES[lens][1])
    return opencv(folder, lens, **unnamed, K1=MATRICES[0], K2=MATRICES[1], dist1=distortion, dist2=distortion)


def ros(folder, lens):
    """Files of camera_info: R and P of OpenCV's rectification."""
    distortion, rotation, shift = np.array(LENSES[lens][1]), RIGHT_FROM_LEFT[:3, :3], RIGHT_FROM_LEFT[:3, 3:]
    rectify = cv2.fisheye.stereoRectify if lens == "fisheye" else cv2.stereoRectify
    turns = rectify(
        MATRICES[0],
        distortion,
        MATRICES[1],
        distortion,
        SIZE,
        rotation.copy(),
        shift.copy(),
        flags=cv2.CALIB_ZERO_DISPARITY,
    )[:4]
    for k, side in enumerate(("left", "right")):
        values = {"camera_matrix": MATRICES[k], "distortion_coefficients": distortion} | {
            "rectification_matrix": turns[k], "projection_matrix": turns[2 + k],
        }  # fmt: skip
        tree = {"image_width": SIZE[0], "image_height": SIZE[1], "camera_name": side}
        tree["distortion_model"] = "equidistant" if lens == "fisheye" else "plumb_bob"
        yaml_file(folder, tree | {k: {"data": v.ravel().tolist()} for k, v in values.items()}, f"{side}.yaml")
    return folder / "left.yaml"


def kalibr(folder, lens, poses="T_cn_cnm1", **changed):
    cameras = []
    for focals, body_from_camera in zip(FOCALS, (BODY_FROM_LEFT, BODY_FROM_RIGHT), strict=True):
        camera = {"camera_model": "pinhole", "intrinsics": list(focals), "resolution": list(SIZE), "rostopic": "/a"}
        camera |= {"distortion_model": {"fisheye": "equidistant"}.get(lens, "radtan")}
        camera |= {"distortion_coeffs": list(LENSES[lens][1]), "timeshift_cam_imu": 0.0}
        if lens == "ds":
            camera |= {"camera_model": "ds", "intrinsics": [*DOUBLE_SPHERE, *focals]}
            camera |= {"distortion_model": "none", "distortion_coeffs": []}
        if poses == "T_imu_cam":
            camera["T_imu_cam"] = body_from_camera.tolist()
        cameras.append(camera | changed)
    if poses == "T_cn_cnm1":
        cameras[1]["T_cn_cnm1"] = RIGHT_FROM_LEFT.tolist()
    return yaml_file(folder, {"cam0": cameras[0], "cam1": cameras[1]}, head="%YAML:1.0\n")


def orbslam(folder, lens):
    names = ("k1", "k2", "k3", "k4") if lens == "fisheye" else ("k1", "k2", "p1", "p2")
    tree = {"Camera.type": "KannalaBrandt8" if lens == "fisheye" else "PinHole", "Camera.fps": 20}
    tree |= {"Camera.width": SIZE[0], "Camera.height": SIZE[1], "File.version": "1.0", "Camera1.overlappingBegin": 0}
    for k, focals in enumerate(FOCALS, 1):
        tree |= dict(zip((f"Camera{k}.{name}" for name in ("fx", "fy", "cx", "cy")), focals, strict=True))
        tree |= dict(zip((f"Camera{k}.{name}" for name in names), LENSES[lens][1], strict=True))
    file = yaml_file(folder, tree, head="%YAML:1.0\n")
    data = np.linalg.inv(RIGHT_FROM_LEFT).ravel().tolist()  # T_c1_c2: c1 from c2
    file.write_text(
        file.read_text() + f"Stereo.T_c1_c2: !!opencv-matrix\n  {{rows: 4, cols: 4, dt: f, data: {data}}}\n"
    )
    return file


def okvis(folder, lens, **changed):
    kinds = {"radtan": "radialtangential", "radtan8": "radialtangential8", "fisheye": "equidistant"}
    cameras = [
        {
            "T_SC": body_from_camera.ravel().tolist(), "image_dimension": list(SIZE), "distortion_type": kinds[lens],
            "distortion_coefficients": list(LENSES[lens][1]), "focal_length": focals[:2], "principal_point": focals[2:],
        } | changed
        for focals, body_from_camera in zip(map(list, FOCALS), (BODY_FROM_LEFT, BODY_FROM_RIGHT), strict=True)
    ]  # fmt: skip
    return yaml_file(folder, {"cameras": cameras, "imu_params": {"sigma_g_c": 1e-3}}, head="%YAML:1.0\n---\n")


def vins(folder, lens, **changed):
    for k, (fx, fy, cx, cy) in enumerate(FOCALS):
        tree = {"model_type": "PINHOLE", "camera_name": "a", "image_width": SIZE[0], "image_height": SIZE[1]}
        if lens == "fisheye":
            coefficients = dict(zip(("k2", "k3", "k4", "k5"), FISHEYE, strict=True))
            tree |= {"projection_parameters": coefficients | {"mu": fx, "mv": fy, "u0": cx, "v0": cy}}
            tree["model_type"] = "KANNALA_BRANDT"
        else:
            tree["distortion_parameters"] = dict(zip(("k1", "k2", "p1", "p2"), LENSES[lens][1], strict=True))
            tree["projection_parameters"] = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
        yaml_file(folder, tree | changed, f"cam{k}.yaml", "%YAML:1.0\n---\n")
    rig = {"num_of_cam": 2, "cam0_calib": "cam0.yaml", "cam1_calib": "cam1.yaml", "max_cnt": 150}
    rig |= {"body_T_cam0": BODY_FROM_LEFT.tolist(), "body_T_cam1": BODY_FROM_RIGHT.tolist()}
    return yaml_file(folder, rig, "rig.yaml", "%YAML:1.0\n")


def basalt(folder, lens, kind, names, **changed):
    poses = [
        dict(zip(("px", "py", "pz"), pose[:3, 3].tolist(), strict=True))
        | dict(zip(("qx", "qy", "qz", "qw"), geometry.quaternion_xyzw(pose[:3, :3]).tolist(), strict=True))
        for pose in (BODY_FROM_LEFT, BODY_FROM_RIGHT)
    ]
    lenses = [
        {"camera_type": kind, "intrinsics": dict(zip(("fx", "fy", "cx", "cy", *names), values, strict=True))}
        for values in ((*focals, *LENSES[lens][1][: len(names)]) for focals in FOCALS)
    ]
    value = {"T_imu_cam": poses, "intrinsics": lenses, "resolution": [SIZE, SIZE], "calib_gyro_bias": [0.0] * 9}
    return json_file(folder, {"value0": value | {"imu_update_rate": 200.0} | changed})


def matlab(folder, lens, key="K", **changed):
    """jsonencode(toStruct(stereoParams)): row vectors, 1-based pixels, millimetres."""
    k1, k2, p1, p2, *rest = LENSES[lens][1]
    cameras = []
    for matrix in MATRICES:
        given = matrix + np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
        cameras.append(
            {
                key: (given if key == "K" else given.T).tolist(), "RadialDistortion": [k1, k2, *rest],
                "TangentialDistortion": [p1, p2], "ImageSize": SIZE[::-1], "WorldUnits": "millimeters",
            } | changed
        )  # fmt: skip
    tree = {"CameraParameters1": cameras[0], "CameraParameters2": cameras[1], "Version": {"Name": "a"}}
    tree["RotationOfCamera2"] = RIGHT_FROM_LEFT[:3, :3].T.tolist()
    return json_file(folder, tree | {"TranslationOfCamera2": (1000 * RIGHT_FROM_LEFT[:3, 3]).tolist()})


def metashape(folder, lens, master=0, more="", kind="frame"):
    """Export Cameras of a rig: f + b1 and f are the focal lengths, cx and cy count from the image centre."""
    names, sensors = ("k1", "k2", "k3", "p1", "p2"), []
    slave_pose = RIGHT_FROM_LEFT if master == 1 else np.linalg.inv(RIGHT_FROM_LEFT)
    for k, (fx, fy, cx, cy) in enumerate(FOCALS):
        inner = {"f": fy, "cx": cx + 0.5 - SIZE[0] / 2, "cy": cy + 0.5 - SIZE[1] / 2, "b1": fx - fy}
        inner |= dict(zip(names, LENSES[lens][1], strict=True))
        values = "".join(f"<{key}>{value!r}</{key}>" for key, value in inner.items()) + more
        size = f'<resolution width="{SIZE[0]}" height="{SIZE[1]}"/>'
        pose = ""
        if k != master:
            rotation, place = (" ".join(map(repr, v.ravel().tolist())) for v in (slave_pose[:3, :3], slave_pose[:3, 3]))
            pose = f"<rotation>{rotation}</rotation><location>{place}</location>"
        slave = "" if k == master else f' master_id="{master}"'
        sensors.append(
            f'<sensor id="{k}" label="a" type="frame"{slave}>{size}<property name="layer_index" value="0"/>'
            f'<calibration type="{kind}" class="adjusted">{size}{values}</calibration>{pose}</sensor>'
        )
    text = f'<document version="2.0.0"><chunk><sensors next_id="2">{"".join(sensors)}</sensors></chunk></document>'
    (folder / "cameras.xml").write_text('<?xml version="1.0" encoding="UTF-8"?>\n' + text)
    return folder / "cameras.xml"


def colmap(folder, lens, model):
    """cameras.txt and rigs.txt: the corner of the first pixel is at (0, 0), one focal length in the simple models."""
    lines = []
    for k, (fx, fy, cx, cy) in enumerate(FOCALS, 1):
        focals = (fx, cx + 0.5, cy + 0.5) if model.startswith("SIMPLE") else (fx, fy, cx + 0.5, cy + 0.5)
        count = {"SIMPLE_RADIAL": 1}.get(model, len(LENSES[lens][1]))
        lines.append(f"{k} {model} {SIZE[0]} {SIZE[1]} " + " ".join(map(repr, focals + LENSES[lens][1][:count])))
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    pose = [*geometry.quaternion_wxyz(RIGHT_FROM_LEFT[:3, :3]).tolist(), *RIGHT_FROM_LEFT[:3, 3].tolist()]
    (folder / "rigs.txt").write_text("1 2 CAMERA 1 CAMERA 2 1 " + " ".join(map(repr, pose)) + "\n")
    return folder / "cameras.txt"


def euroc(folder, lens):
    for k, (focals, pose) in enumerate(zip(FOCALS, (BODY_FROM_LEFT, BODY_FROM_RIGHT), strict=True)):
        camera = folder / "mav0" / f"cam{k}"
        camera.mkdir(parents=True)
        tree = {"T_BS": {"rows": 4, "cols": 4, "data": pose.ravel().tolist()}, "resolution": list(SIZE)}
        tree |= {"camera_model": "pinhole", "intrinsics": list(focals), "distortion_model": "radial-tangential"}
        yaml_file(camera, tree | {"distortion_coefficients": list(LENSES[lens][1])}, "sensor.yaml")
        (camera / "data.csv").write_text("#timestamp [ns],filename\n1000000000,a.png\n")
    return folder


FILES = {
    "OpenCV YAML": (opencv, "radtan"), "OpenCV XML": (opencv, "radtan8", "xml"),
    "OpenCV JSON": (opencv, "radtan", "json"), "OpenCV fisheye": (opencv, "fisheye"),
    "OpenCV K1, dist1": (opencv_names, "radtan"), "ROS": (ros, "radtan"),
    "ROS equidistant": (ros, "fisheye"), "Kalibr radtan": (kalibr, "radtan"), "Kalibr equidistant": (kalibr, "fisheye"),
    "Kalibr ds": (kalibr, "ds"), "OpenVINS T_imu_cam": (kalibr, "fisheye", "T_imu_cam"),
    "ORB-SLAM3 PinHole": (orbslam, "radtan"), "ORB-SLAM3 KannalaBrandt8": (orbslam, "fisheye"),
    "OKVIS": (okvis, "radtan"), "OKVIS 8": (okvis, "radtan8"), "OKVIS equidistant": (okvis, "fisheye"),
    "VINS PINHOLE": (vins, "radtan"), "VINS KANNALA_BRANDT": (vins, "fisheye"),
    "Basalt pinhole": (basalt, "none", "pinhole", ()), "Basalt ds": (basalt, "ds", "ds", ("xi", "alpha")),
    "Basalt kb4": (basalt, "fisheye", "kb4", ("k1", "k2", "k3", "k4")),
    "Basalt radtan8": (basalt, "radtan8", "pinhole-radtan8", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "MATLAB K": (matlab, "radtan"), "MATLAB IntrinsicMatrix": (matlab, "radtan8", "IntrinsicMatrix"),
    "Metashape": (metashape, "metashape"), "Metashape, right master": (metashape, "metashape", 1),
    "COLMAP OPENCV": (colmap, "radtan", "OPENCV"), "COLMAP fisheye": (colmap, "fisheye", "OPENCV_FISHEYE"),
    "COLMAP simple": (colmap, "radial", "SIMPLE_RADIAL"), "EuRoC": (euroc, "radtan"),
}  # fmt: skip


def read(path: Path) -> StereoCalibration:
    if path.is_dir():
        found = EurocReader().read(path).calibration
        assert isinstance(found, StereoCalibration), found
        return found
    return read_calibration(path)


@pytest.mark.parametrize("name", FILES)
def test_a_file_projects_within_a_hundredth_of_a_pixel_of_its_own_model(tmp_path, name):
    write, lens, *arguments = FILES[name]
    found = read(write(tmp_path, lens, *arguments))
    model, coefficients = LENSES[lens]
    in_left = points()
    in_right = geometry.transform(np.linalg.inv(BODY_FROM_RIGHT) @ BODY_FROM_LEFT, in_left)
    for camera, xyz, focals, pose in (
        (found.left, in_left, FOCALS[0], np.eye(4)),
        (found.right, in_right, FOCALS[1], found.right_from_left),
    ):
        fx, fy, cx, cy = focals
        fy = fx if "simple" in name else fy
        expected = model(xyz, *coefficients) * [fx, fy] + [cx, cy]
        np.testing.assert_allclose(camera.project(geometry.transform(pose, in_left)), expected, atol=0.01)
        assert camera.size_px == SIZE


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE", "SIMPLE_RADIAL"])
def test_a_colmap_file_projects_as_colmap(tmp_path, model):
    pycolmap = pytest.importorskip("pycolmap")
    lens = {"OPENCV": "radtan", "OPENCV_FISHEYE": "fisheye", "SIMPLE_RADIAL": "radial"}[model]
    file = colmap(tmp_path, lens, model)
    values = [float(part) for part in file.read_text().splitlines()[0].split()[4:]]
    camera = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=values)
    np.testing.assert_allclose(
        read_calibration(file).left.project(points()) + 0.5, camera.img_from_cam(points()), atol=1e-9
    )


def text(name, content):
    def write(folder):
        (folder / name).write_text(content)
        return folder / name

    return write


def without(key, file):
    """Removes the lines of a key from a file."""
    file.write_text(re.sub(rf"(?m)^( *){key}:.*\n(\1( +|- ).*\n)*", "", file.read_text()))
    return file


REFUSED = {
    "VINS MEI": (lambda folder: vins(folder, "radtan", model_type="MEI"), "camera model 'MEI'"),
    "VINS with a mirror": (lambda folder: vins(folder, "radtan", mirror_parameters={"xi": 1.9}), "'mirror_parameters'"),
    "VINS, one camera": (text("a.yaml", "model_type: PINHOLE\nprojection_parameters: {fx: 1}"), "one camera of VINS"),
    "VINS, no file": (text("a.yaml", "body_T_cam0: []\ncam0_calib: /dev/null"), "leads out of the folder"),
    "Kalibr omni": (lambda folder: kalibr(folder, "radtan", camera_model="omni"), "camera model 'omni'"),
    "Kalibr key": (lambda folder: kalibr(folder, "radtan", line_delay=1e-5), "'line_delay'"),
    "OKVIS key": (lambda folder: okvis(folder, "radtan", xi=1.0), "'xi'"),
    "OKVIS pose": (lambda folder: okvis(folder, "radtan", T_SC=[2.0] + [0.0] * 15), "T_SC is not a rotation matrix"),
    "OKVIS by columns": (
        lambda folder: okvis(folder, "radtan", T_SC=BODY_FROM_LEFT.T.ravel().tolist()), "T_SC .*no pose by rows",
    ),
    "OKVIS without a model": (lambda folder: okvis(folder, "fisheye", distortion_type=None), "model 'missing'"),
    "Kalibr without a model": (lambda folder: without("distortion_model", kalibr(folder, "fisheye")), "without a mod"),
    "Kalibr without a lens": (lambda folder: without("distortion_coeffs", kalibr(folder, "radtan")), "without coeffi"),
    "ROS without a model": (lambda folder: without("distortion_model", ros(folder, "fisheye")), "model 'missing'"),
    "a number of 400 digits": (lambda folder: okvis(folder, "radtan", T_SC=[10**400] * 16), "T_SC is missing"),
    "maplab": (text("a.yaml", "cameras:\n- camera: {type: pinhole}\n- camera: {}"), "'camera'"),
    "Basalt eucm": (lambda folder: basalt(folder, "ds", "eucm", ("alpha", "beta")), "camera model 'eucm'"),
    "Basalt key": (lambda folder: basalt(folder, "none", "pinhole", (), scale=2), "'scale'"),
    "Basalt lens": (lambda folder: basalt(folder, "ds", "ds", ("xi", "beta")), "'beta'"),
    "MATLAB unit": (lambda folder: matlab(folder, "radtan", WorldUnits="squares"), "WorldUnits 'squares'"),
    "MATLAB skew": (
        lambda folder: matlab(folder, "radtan", K=[[400, 3.0, 320], [0, 400, 240], [0, 0, 1]]), "skew of 3 px",
    ),
    "MAT-file": (text("a.mat", "MATLAB 5.0"), "jsonencode"),
    "Metashape k4": (lambda folder: metashape(folder, "metashape", more="<k4>0.1</k4>"), "'k4'"),
    "Metashape b2": (lambda folder: metashape(folder, "metashape", more="<b2>2.0</b2>"), "skew of 2 px"),
    "Metashape fisheye": (lambda folder: metashape(folder, "metashape", kind="fisheye"), "type frame"),
    "Agisoft, one camera": (text("a.xml", "<calibration><projection>frame</projection></calibration>"), "0 sensors"),
    "Calibmar": (text("a.yaml", "model: OPENCV\nparameters: [500, 500]\nwidth: 640"), "one camera of Calibmar"),
    "refractive COLMAP": (
        text("cameras.txt", "1 OPENCV 640 480 500 500 320 240 0 0 0 0 FLATPORT 0 0 1 0.05 0.01"), "refractive COLMAP",
    ),
    "two documents": (text("a.yaml", "M1: 1\n---\nM2: 1\n"), "another document"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_understood_is_refused_by_its_key(tmp_path, name):
    write, message = REFUSED[name]
    with pytest.raises(TwinError, match=message) as error:
        read_calibration(write(tmp_path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["radtan", "fisheye"])
def test_the_lens_models_are_those_of_opencv(kind):
    lens = np.array(RADTAN8 if kind == "radtan" else FISHEYE)
    project = cv2.projectPoints if kind == "radtan" else cv2.fisheye.projectPoints
    expected = project(points()[:, None], np.zeros(3), np.zeros(3), MATRICES[0], lens)[0].reshape(-1, 2)
    camera = RecordedCamera(SIZE, MATRICES[0], lens, kind)
    np.testing.assert_allclose(camera.project(points()), expected, atol=1e-9)
    assert camera.project(np.zeros((0, 3))).shape == (0, 2)


def wide_rig(kind="fisheye", across_deg=170.0, lens=(0.0, 0.0, 0.0, 0.0)):
    """Returns an equidistant or other rig whose images are `across_deg` wide, with converging cameras."""
    focal_px = SIZE[0] / np.radians(across_deg)
    matrix = np.array([[focal_px, 0, 319.5], [0, focal_px, 239.5], [0, 0, 1]])
    camera = RecordedCamera(SIZE, matrix, np.array(lens), kind)
    return StereoCalibration(camera, camera, RIGHT_FROM_LEFT)


def test_a_wide_lens_keeps_its_resolution_at_the_centre_and_says_what_is_lost():
    rig = wide_rig()
    found, focal_px, zero = rectification(rig, 1.0), rig.left.matrix[0, 0], np.zeros(4)
    assert found.rig.fx_px == pytest.approx(0.8 * focal_px, rel=1e-4)
    field = 2 * np.degrees(np.arctan(320 / (0.8 * focal_px)))
    assert f"{field:.0f} of 170 deg across, 80 % of the resolution at the centre" in found.sentence
    matrix, (rotation, shift) = rig.left.matrix, np.split(RIGHT_FROM_LEFT[:3].copy(), [3], axis=1)
    whole = cv2.fisheye.stereoRectify(matrix, zero, matrix, zero, SIZE, rotation.copy(), shift.copy(), 0, balance=0.0)
    assert whole[2][0, 0] < 0.6 * focal_px  # the loss without the choice


def test_a_narrow_fisheye_lens_fills_its_rectified_images():
    """All pixels come from the recorded image, and the smallest such focal length is chosen (steps of 0.8 %)."""
    rig = wide_rig(across_deg=50.0)
    found = rectification(rig, 1.0)
    for positions in found.maps:
        assert (positions > -0.6).all() and (positions < np.array(SIZE) - 0.4).all()
    assert found.rig.fx_px == pytest.approx(rig.left.matrix[0, 0], rel=0.1)


@pytest.mark.parametrize(("kind", "lens"), [("fisheye", FISHEYE), ("double_sphere", DOUBLE_SPHERE), ("radtan", RADTAN)])
def test_a_chosen_field_of_view_is_that_of_the_rectified_images(kind, lens):
    found = rectification(wide_rig(kind, 80.0, lens), 1.0, 60.0).rig
    assert 2 * np.degrees(np.arctan(SIZE[0] / 2 / found.fx_px)) == pytest.approx(60.0)


def test_beyond_the_largest_angle_of_a_polynomial_rectified_images_are_black():
    """With k1 = -0.5 alone, r (1 + k1 r^2) falls beyond r = (1.5)^-0.5: there, a second image would be shown."""
    rig = wide_rig("radtan", 170.0, (-0.5, 0.0, 0.0, 0.0))
    largest_deg = np.degrees(np.arctan(1.5**-0.5))
    with pytest.raises(TwinError, match=f"5 to {2 * largest_deg:.0f} deg"):
        rectification(rig, 1.0, 85.0)
    found = rectification(rig, 1.0, 76.0)
    assert f" of {2 * largest_deg:.0f} deg across" in found.kept
    v, u = np.mgrid[0 : SIZE[1] : 20, 0 : SIZE[0] : 20].reshape(2, -1)
    rays = np.column_stack([u, v, np.ones(len(u))]) @ np.linalg.inv(found.rig.matrix).T
    in_left = geometry.transform(found.left_from_rectified, rays)
    angle_deg = np.degrees(np.arctan2(np.hypot(*in_left.T[:2]), in_left[:, 2]))
    beyond = angle_deg > largest_deg + 0.1
    shown = angle_deg < largest_deg - 0.1
    assert beyond.sum() > 20 and shown.sum() > 300
    image = found.rectified(np.full((SIZE[1], SIZE[0], 3), 100, np.uint8), "left")
    assert not image[v[beyond], u[beyond]].any() and image[v[shown], u[shown]].all()


def test_the_maps_of_a_double_sphere_are_where_its_model_projects_the_rectified_rays():
    rig = wide_rig("double_sphere", 120.0, DOUBLE_SPHERE)
    found = rectification(rig, 1.0)
    v, u = np.mgrid[10:470:50, 10:630:50].reshape(2, -1)
    rays = np.column_stack([u, v, np.ones(len(u))]) @ np.linalg.inv(found.rig.matrix).T
    expected = double_sphere(geometry.transform(found.left_from_rectified, rays), *DOUBLE_SPHERE)
    expected = expected * rig.left.matrix[0, 0] + rig.left.matrix[:2, 2]
    np.testing.assert_allclose(found.maps[0][v, u], expected, atol=1e-3)  # float32


def test_a_pair_of_different_lens_models_is_rectified(tmp_path):
    """A point has the same row in both rectified images, and the disparity of its depth."""
    rig = StereoCalibration(wide_rig("radtan", 80.0, RADTAN).left, wide_rig(across_deg=100.0).left, RIGHT_FROM_LEFT)
    found = rectification(rig, 1.0)
    xyz = points(20.0)
    left = found.rig.project(xyz)
    right = left - np.column_stack([found.rig.fx_px * found.rig.baseline_m / xyz[:, 2], np.zeros(len(xyz))])
    in_left = geometry.transform(found.left_from_rectified, xyz)
    in_right = geometry.transform(rig.right_from_left, in_left)
    for pixels, camera, points_m, positions in (
        (left, rig.left, in_left, found.maps[0]), (right, rig.right, in_right, found.maps[1]),
    ):  # fmt: skip
        at = [cv2.remap(one, *pixels.astype(np.float32).T[..., None], cv2.INTER_LINEAR)[:, 0]
              for one in np.moveaxis(positions, -1, 0)]  # fmt: skip
        np.testing.assert_allclose(np.column_stack(at), camera.project(points_m), atol=0.05)


def test_a_field_of_view_that_cannot_be_is_refused():
    with pytest.raises(TwinError, match=r"--field: 100 deg \(allowed: 5 to 80 deg\)"):
        rectification(wide_rig(across_deg=80.0), 1.0, 100.0)
    flat = StereoCalibration(
        *[RecordedCamera(SIZE, MATRICES[0], np.zeros(0))] * 2, geometry.inverse(recorded.RIG.left_from_right)
    )
    with pytest.raises(TwinError, match="--field: 50 deg .*no value for a pair recorded rectified"):
        rectification(flat, 1.0, 50.0)


@pytest.mark.parametrize(
    ("unit", "length_m", "stated_m", "message"),
    [
        ("assumed", 4.33, None, r"baseline is 4.33 m \(or in mm, inches or squares .*0.01 to 1 m; --baseline"),
        ("assumed", 0.0043, None, "baseline is 0.0043 m"), ("unknown", 0.15, None, "is 0.15 in an unknown unit"),
        ("stated", 12.0, None, "0.001 to 10 m"), ("assumed", 0.15, 150.0, "--baseline: the baseline is 150 m"),
        ("stated", 2.0, None, None), ("assumed", 4.33, 0.11, None), ("unknown", 3.0, 0.11, None),
    ],
)  # fmt: skip
def test_an_implausible_baseline_is_asked_for(unit, length_m, stated_m, message):
    camera = RecordedCamera(SIZE, MATRICES[0], np.zeros(0))
    pose = geometry.pose(RIGHT_FROM_LEFT[:3, :3], length_m * np.array([-0.8, 0.6, 0.0]))
    given = StereoCalibration(camera, camera, pose, Path("rig.yaml"), unit=unit)
    if message is not None:
        with pytest.raises(TwinError, match=message):
            given.with_baseline(stated_m)
        return
    found = given.with_baseline(stated_m)
    expected = (stated_m or length_m) * np.array([-0.8, 0.6, 0.0])
    np.testing.assert_allclose(found.right_from_left[:3, 3], expected, rtol=1e-12)


CASES = {
    "K1_dist1.yml": None, "M1_dist1.yml": None, "opencv.xml": None, "opencv.json": None, "ros/left.yaml": None,
    "c20_orbslam3.yaml": None, "opencv_fisheye_no_model_key.yml": "fisheye", "skew_12px.yml": "skew of 12 px",
    "T_in_squares.yml": "baseline is 3.66926 m", "c02b_T_in_mm_small_rig.yaml": "baseline is 9.5 m",
    "other_image_size.yml": "about 978 x 662 px.*752 x 480 px", "calibmar/cam.yaml": "Calibmar",
    "colmap_refractive/cameras.txt": "refractive", "c21_vins_projection_parameters.yaml": "VINS",
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_files_that_were_misread_are_read_or_refused(outside_data, name):
    size = (640, 480) if name.startswith(("c", "ros")) else (752, 480)
    try:
        found = read_calibration(outside_data(f"cases/calibration/{name}")).with_baseline(None).for_images(*size)
    except TwinError as error:
        assert CASES[name] is not None
        assert re.search(CASES[name], str(error))
        return
    assert CASES[name] is None and (found.left.distortion.any() or size == (640, 480))


def test_a_number_without_a_point_in_yaml_and_tabs_in_json_are_read(tmp_path):
    (tmp_path / "sensor.yaml").write_text("gyroscope_noise_density: 2e-4\nmodel: 2e-4x\n")
    assert read_yaml(tmp_path / "sensor.yaml") == {"gyroscope_noise_density": 2e-4, "model": "2e-4x"}
    (tmp_path / "camera.json").write_text('{\n\t"a": {\n\t\t"b": [1e3, -2E-1]\n\t}\n}')
    assert read_yaml(tmp_path / "camera.json") == {"a": {"b": [1000.0, -0.2]}}
