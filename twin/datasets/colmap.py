"""COLMAP text models: cameras and rig, read and written; frames, images and 3D points of a run, written.

In COLMAP, the corner of the first pixel is at (0, 0), so pixel coordinates are larger by 0.5 than in OpenCV.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import Array, ElevationMap
from twin.datasets.calibration import RecordedCamera, StereoCalibration, camera_matrix, distortion_kind
from twin.datasets.calibration_values import size_of
from twin.datasets.image_copy import CopiedImage, copy_images
from twin.datasets.run_contents import RunContents
from twin.datasets.text_files import text_rows
from twin.errors import TwinError

MOST_POINTS = 20_000  # a map with more mapped cells is subsampled to about this number of points
_HIDDEN = 1.02  # a point is hidden if its depth exceeds this factor times that of another one at the same pixel
#: Camera models: positions of fx, fy, cx, cy in their parameters, positions of the OpenCV coefficients of distortion
#: (None: zero), and kind of distortion.
_MODELS: dict[str, tuple[tuple[int, int, int, int], tuple[int | None, ...], str]] = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), (), "radtan"),
    "PINHOLE": ((0, 1, 2, 3), (), "radtan"),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3, None, None, None), "radtan"),
    "RADIAL": ((0, 0, 1, 2), (3, 4, None, None), "radtan"),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7), "radtan"),
    "FULL_OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11), "radtan"),
    "OPENCV_FISHEYE": ((0, 1, 2, 3), (4, 5, 6, 7), "fisheye"),
}


def read_rig(file: Path) -> StereoCalibration:
    """Returns the calibration in cameras.txt and in rigs.txt beside it.

    The left camera is the reference camera of the first rig, the right camera its second one. Raises TwinError if there
    are fewer than two cameras or no rigs.txt, or a line of either file is not valid.
    """
    cameras = dict(_read_camera(file, number, parts) for number, parts in text_rows(file))
    rigs = file.with_name("rigs.txt")
    if len(cameras) < 2 or not rigs.is_file():
        raise TwinError(str(file), "has no baseline", "two cameras, and their rig in rigs.txt beside this file")
    number, parts = next(iter(text_rows(rigs)), (1, list[str]()))
    try:
        reference, second = int(parts[3]), int(parts[5])
        quaternion, translation = np.array(parts[7:11], float), np.array(parts[11:14], float)
        pose = geometry.pose(geometry.rotation_from_wxyz(quaternion), translation)
        return StereoCalibration(cameras[reference], cameras[second], pose, file)
    except (ValueError, IndexError, KeyError):
        allowed = "RIG_ID 2 CAMERA ID CAMERA ID 1 QW QX QY QZ TX TY TZ"
        raise TwinError(f"{rigs}:{number}", "is not the rig of two cameras", allowed) from None


def _read_camera(file: Path, number: int, parts: list[str]) -> tuple[int, RecordedCamera]:
    model = parts[1] if len(parts) > 1 else ""
    if model not in _MODELS:
        raise TwinError(f"{file}:{number}", f"camera model {model[:40]!r} is not supported", ", ".join(_MODELS))
    focal, distorted, kind = _MODELS[model]
    count = 1 + max(*focal, *(k for k in distorted if k is not None))
    if len(parts) > 4 + count:
        problem = f"{model} has {len(parts) - 4} parameters: cameras of refractive COLMAP (a port) are not read"
        raise TwinError(f"{file}:{number}", problem, f"{count} parameters")
    try:
        values = [float(part) for part in parts[4:]]
        fx, fy, cx, cy = (values[k] for k in focal)
        distortion = np.array([0.0 if k is None else values[k] for k in distorted])
        size = size_of([int(parts[2]), int(parts[3])], file)
        matrix = camera_matrix(fx, fy, cx - 0.5, cy - 0.5)
        return int(parts[0]), RecordedCamera(size, matrix, distortion, distortion_kind(kind, file))
    except (ValueError, IndexError):
        raise TwinError(f"{file}:{number}", "is not a camera", "CAMERA_ID MODEL WIDTH HEIGHT PARAMS") from None


def write_rig(folder: Path, rig: StereoCalibration) -> None:
    """Writes cameras.txt and rigs.txt: camera 1 (left) is the reference of rig 1, camera 2 is the right."""
    cameras = [f"{k} {_camera_text(camera)}" for k, (_, camera) in enumerate(rig.sides, 1)]
    _write_lines(folder / "cameras.txt", "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", *cameras)
    header = "# RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[] as (TYPE, ID, HAS_POSE, POSE)"
    _write_lines(folder / "rigs.txt", header, f"1 2 CAMERA 1 CAMERA 2 1 {_pose_text(rig.right_from_left)}")


def _camera_text(camera: RecordedCamera) -> str:
    assert camera.size_px is not None
    (width, height), matrix, distortion = camera.size_px, camera.matrix, camera.distortion
    values = [matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5]
    model = "PINHOLE"
    if distortion.any():
        model = "FULL_OPENCV"
        values += [*distortion, 0.0, 0.0, 0.0]
    return f"{model} {width} {height} " + " ".join(f"{value:.17g}" for value in values)


def _pose_text(camera_from_world: Array) -> str:
    """Returns a pose (4, 4) as QW QX QY QZ TX TY TZ."""
    values = [*geometry.quaternion_wxyz(camera_from_world[:3, :3]), *camera_from_world[:3, 3]]
    return " ".join(f"{value:.17g}" for value in values)


def _write_lines(file: Path, *lines: str) -> None:
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


class _View(NamedTuple):
    image: int  #: identifier of the image, from 1
    camera: int  #: identifier of its camera: 1 left, 2 right
    name: str  #: path of the image relative to the folder `images`
    camera_from_world: Array  #: (4, 4)
    pixels: Array  #: (m, 2) observed pixels; the centre of the first pixel is at (0, 0)
    points: NDArray[np.int64]  #: (m,) indices of the observed points, from 0


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the model to `sparse/0` and the stereo pairs of the keyframes (without any, all pairs) to `images`.

    Poses and calibration are the true ones if they are known, otherwise the final trajectory and the believed
    calibration. The 3D points are cells of the elevation map, with the colours of the orthomosaic. Their observations
    are exact projections: an image observes a cell unless another one at the same pixel is nearer by more than 2 %.
    """
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    frames = tuple(frame for frame in contents.pairs if frame.keyframe) or contents.pairs
    points, colours = _points(contents.elevation)
    images = copy_images(contents, lambda side, frame: folder / "images" / side / f"{frame.index:06d}", frames)
    views = [_view(contents, number, image, points) for number, image in enumerate(images, 1)]
    write_rig(model, contents.best_calibration)
    _write_frames(model / "frames.txt", views)
    _write_images(model / "images.txt", views)
    _write_points(model / "points3D.txt", points, colours, views)
    return [model, folder / "images"]


def _points(elevation: ElevationMap | None) -> tuple[Array, NDArray[np.uint8]]:
    """Returns points (n, 3) [m] of mapped cells in the world, about `MOST_POINTS` at most, and their colours (n, 3)."""
    if elevation is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    stride = max(1, int(np.ceil(np.sqrt(np.isfinite(elevation.height_m).sum() / MOST_POINTS))))
    x, y = np.meshgrid(*elevation.grid.centres())
    z, colours = elevation.height_m[::stride, ::stride].astype(np.float64), elevation.mosaic[::stride, ::stride]
    known = np.isfinite(z)
    points = np.column_stack([x[::stride, ::stride][known], y[::stride, ::stride][known], z[known]])
    return elevation.to_world(points), colours[known]


def _view(contents: RunContents, number: int, image: CopiedImage, points: Array) -> _View:
    """Returns the view of the points (n, 3) in an image, which is that of the left camera if its number is odd."""
    rig, world_from_left = contents.best_calibration, contents.poses.world_from_camera[image.frame.index]
    camera_from_world = geometry.inverse(world_from_left @ rig.left_from(image.camera))
    pixels, seen = _observed(geometry.transform(camera_from_world, points), dict(rig.sides)[image.camera])
    name, camera = f"{image.camera}/{image.file.name}", 1 if image.camera == "left" else 2
    return _View(number, camera, name, camera_from_world, pixels, seen)


def _observed(points_m: Array, camera: RecordedCamera) -> tuple[Array, NDArray[np.int64]]:
    """Returns the pixels (m, 2) and the indices (m,) of the points (n, 3) in camera axes that a camera observes."""
    assert camera.size_px is not None
    width, height = camera.size_px
    # far outside the field, the polynomial of a distortion folds back into the image
    across = np.array([width, height]) / np.diag(camera.matrix)[:2]
    ahead = (points_m[:, 2] > 1e-3) & (np.abs(points_m[:, :2]) < across * points_m[:, 2:]).all(axis=1)
    pixels = camera.project(np.where(ahead[:, None], points_m, 1.0))
    column_row = np.floor(pixels + 0.5)
    inside = ahead & (column_row >= 0).all(axis=1) & (column_row < [width, height]).all(axis=1)
    numbers = np.flatnonzero(inside)
    cell = (column_row[numbers, 1] * width + column_row[numbers, 0]).astype(np.int64)
    nearest = np.full(width * height, np.inf)
    np.minimum.at(nearest, cell, points_m[numbers, 2])
    kept = numbers[points_m[numbers, 2] <= _HIDDEN * nearest[cell]]
    return pixels[kept], kept


def _write_frames(file: Path, views: list[_View]) -> None:
    header = "# FRAME_ID, RIG_ID, RIG_FROM_WORLD, NUM_DATA_IDS, DATA_IDS[] as (SENSOR_TYPE, SENSOR_ID, DATA_ID)"
    lines = [
        f"{k} 1 {_pose_text(left.camera_from_world)} 2 CAMERA 1 {left.image} CAMERA 2 {right.image}"
        for k, (left, right) in enumerate(zip(views[::2], views[1::2], strict=True), 1)
    ]
    _write_lines(file, header, *lines)


def _write_images(file: Path, views: list[_View]) -> None:
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for view in views:
        lines.append(f"{view.image} {_pose_text(view.camera_from_world)} {view.camera} {view.name}")
        observations = zip(view.pixels + 0.5, view.points, strict=True)
        lines.append(" ".join(f"{x:.6f} {y:.6f} {point + 1}" for (x, y), point in observations))
    _write_lines(file, *lines)


def _write_points(file: Path, points: Array, colours: NDArray[np.uint8], views: list[_View]) -> None:
    tracks: list[list[str]] = [[] for _ in points]
    for view in views:
        for row, point in enumerate(view.points):
            tracks[point].append(f"{view.image} {row}")
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for number, (point, colour, track) in enumerate(zip(points, colours, tracks, strict=True), 1):
        if track:
            position = " ".join(f"{value:.9g}" for value in point)
            lines.append(f"{number} {position} {colour[0]} {colour[1]} {colour[2]} 0 {' '.join(track)}")
    _write_lines(file, *lines)
