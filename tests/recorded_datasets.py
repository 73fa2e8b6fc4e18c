"""Small recorded data sets for tests: a stereo pair that moves over hills, written in the layouts of other programs."""

from pathlib import Path

import cv2
import numpy as np
import seafloor_scene as scene
import yaml

from twin.core import geometry
from twin.core.records import Frame, StereoRig, Trajectory
from twin.datasets import euroc
from twin.datasets.run_contents import RecordedFrame, RunContents

_BODY_FROM_CAMERA = geometry.pose(np.eye(3), np.array([0.1, 0, 0]))
RIG = StereoRig(240, 180, float(120 / np.tan(np.deg2rad(30))), 0.15, 5.0, _BODY_FROM_CAMERA)


def hills():
    """Returns a floor with hills of 0.1 m."""
    nodes = np.linspace(-4, 4, 81)
    x, y = np.meshgrid(nodes, nodes)
    return scene.Seafloor(
        0.05 * np.sin(2.1 * x + 0.4) * np.cos(1.7 * y), 0.1, -4.0, -4.0, scene.smooth_texture(3, 1024, 1.5), 0.008
    )


def poses(n: int, step_m: float = 0.03) -> np.ndarray:
    """Returns n true poses (n, 4, 4) along x."""
    return np.array([scene.down_camera(step_m * k - 0.2, 0.0, 1.6, (0.02, 0.0, 0.1)) for k in range(n)])


def frames(path: np.ndarray, rig: StereoRig = RIG, noise: float = 1.5) -> list[Frame]:
    """Returns the frames (stereo pairs) at poses (n, 4, 4)."""
    floor, rng = hills(), np.random.default_rng(4)

    def image(pose):
        gray = scene.digitise(scene.render_view(floor, rig, pose, samples=1)[0], rng, noise)
        return np.repeat(gray[..., None], 3, axis=2)

    shift = rig.left_from_right
    return [Frame(k, k / rig.frame_rate_hz, image(pose), image(pose @ shift)) for k, pose in enumerate(path)]


def trajectory(path: np.ndarray, rig: StereoRig = RIG) -> Trajectory:
    """Returns the true trajectory of `frames`."""
    return Trajectory(np.arange(len(path)) / rig.frame_rate_hz, path)


def write_euroc(folder: Path, given: list[Frame], path: np.ndarray) -> Path:
    """Writes frames and the true poses (n, 4, 4) of the left camera as an EuRoC folder."""
    images, listed = folder.with_name(f"{folder.name}-images"), []
    images.mkdir(parents=True)
    for frame in given:
        files = {"left": images / f"{frame.index}_left.png", "right": images / f"{frame.index}_right.png"}
        for side, file in files.items():
            if getattr(frame, side) is not None:
                cv2.imwrite(str(file), getattr(frame, side)[..., ::-1])
        right = None if frame.right is None else files["right"]
        listed.append(RecordedFrame(frame.index, frame.time_s, files["left"], right, False))
    euroc.export(RunContents(folder, folder.name, {}, RIG, None, {"truth": trajectory(path)}, tuple(listed)), folder)
    return folder


def write_folder(folder: Path, given: list[Frame], swapped: bool = False) -> Path:
    """Writes a plain folder with times.txt and an OpenCV calibration; `swapped` exchanges left and right images."""
    for side in ("left", "right"):
        (folder / side).mkdir(parents=True)
    for frame in given:
        for side, image in (("left", frame.left), ("right", frame.right)):
            name = {"left": "right", "right": "left"}[side] if swapped else side
            cv2.imwrite(str(folder / name / f"{frame.index:04d}.png"), image[..., ::-1])
    (folder / "times.txt").write_text("".join(f"{frame.time_s + 100:.6f}\n" for frame in given))
    write_opencv(folder / "calibration.yaml")
    return folder


def write_opencv(file: Path, rig: StereoRig = RIG, **changed) -> Path:
    """Writes an OpenCV calibration of a rectified rig by OpenCV itself; `changed` replaces or removes (None) keys."""
    values = {
        "image_width": rig.width_px, "image_height": rig.height_px, "M1": rig.matrix, "D1": np.zeros((1, 5)),
        "M2": rig.matrix, "D2": np.zeros((1, 5)), "R": np.eye(3), "T": np.array([[-rig.baseline_m], [0], [0]]),
    }  # fmt: skip
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    for key, value in (values | changed).items():
        if value is not None:
            storage.write(key, value)
    storage.release()
    return file


def write_kalibr(file: Path, rig: StereoRig = RIG, **cam1) -> Path:
    """Writes a Kalibr camchain of a rectified rig; `cam1` replaces or removes (None) keys of the second camera."""
    camera = {
        "camera_model": "pinhole", "intrinsics": [rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px],
        "distortion_model": "radtan", "distortion_coeffs": [0.0] * 4, "resolution": [rig.width_px, rig.height_px],
    }  # fmt: skip
    pose = np.eye(4)
    pose[0, 3] = -rig.baseline_m
    second = {key: value for key, value in (camera | {"T_cn_cnm1": pose.tolist()} | cam1).items() if value is not None}
    file.write_text(yaml.safe_dump({"cam0": camera, "cam1": second}))
    return file


def write_colmap(file: Path, rig: StereoRig = RIG) -> Path:
    """Writes COLMAP cameras.txt and rigs.txt of a rectified rig."""
    line = f"PINHOLE {rig.width_px} {rig.height_px} {rig.fx_px!r} {rig.fy_px!r} {rig.cx_px + 0.5} {rig.cy_px + 0.5}\n"
    file.write_text(f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 {line}2 {line}")
    file.with_name("rigs.txt").write_text(f"# rigs\n1 2 CAMERA 1 CAMERA 2 1 1 0 0 0 {-rig.baseline_m} 0 0\n")
    return file
