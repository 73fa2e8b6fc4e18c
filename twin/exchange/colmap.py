"""Writer of COLMAP text models: cameras, rig, frames, images and 3D points of the elevation map with their tracks."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import Array, ElevationMap
from twin.exchange.camera_files import colmap_pose, write_colmap_cameras
from twin.exchange.image_copy import copy_image
from twin.exchange.run_contents import CameraIntrinsics, RecordedFrame, RigCalibration, RunContents, project

MOST_POINTS = 20_000  # a map with more mapped cells is subsampled to about this number of points


class _View(NamedTuple):
    """One image of the model, with its observations.

    Args:
        image, camera: identifiers of the image and of its camera, from 1.
        name: path of the image relative to the folder `images`.
        camera_from_world: (4, 4) pose of the world in the axes of the camera.
        pixels: (m, 2) observed pixels; the centre of the first pixel is at (0, 0).
        points: (m,) indices of the observed points, from 0.
    """

    image: int
    camera: int
    name: str
    camera_from_world: Array
    pixels: Array
    points: NDArray[np.int64]


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the model to `sparse/0` and the stereo pairs of the keyframes to `images`; returns both folders.

    If no keyframe has a stereo pair, all stereo pairs are written. The poses are the true ones if they are known,
    otherwise those of the final trajectory. The calibration is the true one if it is known (it is not for recorded
    data), otherwise the believed one.

    The 3D points are cells of the elevation map with the colours of the orthomosaic; without a map there are none.
    Their observations are exact projections: an image observes a cell that is projected into it, unless another cell
    that is projected to the same pixel is nearer by more than 2 %. In COLMAP, the corner of the first pixel is at
    (0, 0), so pixel coordinates are larger by 0.5 than in OpenCV.

    Raises:
        TwinError: an image is truncated or not a PNG image.
        OSError: a file cannot be read or written.
    """
    rig = contents.true or contents.believed
    model = folder / "sparse" / "0"
    for name in (model, folder / "images" / "left", folder / "images" / "right"):
        name.mkdir(parents=True, exist_ok=True)
    frames = tuple(frame for frame in contents.pairs if frame.keyframe) or contents.pairs
    points, colours = _points(contents.elevation)
    views = []
    for k, frame in enumerate(frames):
        views += _views(contents, rig, frame, k, (points, folder))
        contents.progress((k + 1) / len(frames))
    write_colmap_cameras(model, rig)
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


def _views(
    contents: RunContents, rig: RigCalibration, frame: RecordedFrame, k: int, target: tuple[Array, Path]
) -> list[_View]:
    """Copies the images of a stereo pair and returns their views: left, right.

    Args:
        contents: poses, and quality of JPEG images.
        rig: calibration of the cameras.
        frame: frame of the stereo pair.
        k: number of the stereo pair in the model, from 0.
        target: points (n, 3) in the world [m], and folder of the export.
    """
    points, folder = target
    world_from_left = contents.poses.world_from_camera[frame.index]
    views = []
    sides = (("left", frame.left, np.eye(4), rig.left), ("right", frame.right, rig.left_from_right, rig.right))
    for number, (side, file, left_from_camera, camera) in enumerate(sides, 1):
        assert file is not None
        copied = copy_image(file, folder / "images" / side / f"{frame.index:06d}", contents.jpeg_quality)
        camera_from_world = geometry.inverse(world_from_left @ left_from_camera)
        pixels, seen = _observed(geometry.transform(camera_from_world, points), camera)
        views.append(_View(2 * k + number, number, f"{side}/{copied.name}", camera_from_world, pixels, seen))
    return views


def _observed(points_m: Array, camera: CameraIntrinsics) -> tuple[Array, NDArray[np.int64]]:
    """Returns the pixels (m, 2) and the indices (m,) of those points that a camera observes.

    Of the points projected to the same pixel, it observes the nearest one and those whose depth is at most 2 % larger.

    Args:
        points_m: (n, 3) points in camera axes.
        camera: camera model.
    """
    ahead = points_m[:, 2] > 1e-3
    pixels = project(np.where(ahead[:, None], points_m, 1.0), camera)
    (width, height), column_row = camera.size_px, np.floor(pixels + 0.5)
    inside = ahead & (column_row >= 0).all(axis=1) & (column_row < [width, height]).all(axis=1)
    numbers = np.flatnonzero(inside)
    cell = (column_row[numbers, 1] * width + column_row[numbers, 0]).astype(np.int64)
    nearest = np.full(width * height, np.inf)
    np.minimum.at(nearest, cell, points_m[numbers, 2])
    kept = numbers[points_m[numbers, 2] <= 1.02 * nearest[cell]]
    return pixels[kept], kept


def _write_frames(file: Path, views: list[_View]) -> None:
    """Writes frames.txt: for each stereo pair the pose of the world in the left camera, and the image identifiers."""
    header = "# FRAME_ID, RIG_ID, RIG_FROM_WORLD, NUM_DATA_IDS, DATA_IDS[] as (SENSOR_TYPE, SENSOR_ID, DATA_ID)"
    lines = [
        f"{k} 1 {colmap_pose(left.camera_from_world)} 2 CAMERA 1 {left.image} CAMERA 2 {right.image}"
        for k, (left, right) in enumerate(zip(views[::2], views[1::2], strict=True), 1)
    ]
    file.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")


def _write_images(file: Path, views: list[_View]) -> None:
    """Writes images.txt: for each image a line with the pose of the world in its camera, and a line of observations."""
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for view in views:
        lines.append(f"{view.image} {colmap_pose(view.camera_from_world)} {view.camera} {view.name}")
        corner = view.pixels + 0.5
        lines.append(
            " ".join(f"{x:.6f} {y:.6f} {point + 1}" for (x, y), point in zip(corner, view.points, strict=True))
        )
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_points(file: Path, points: Array, colours: NDArray[np.uint8], views: list[_View]) -> None:
    """Writes points3D.txt: the points that at least one image observes, each with its observations (track)."""
    tracks: list[list[str]] = [[] for _ in points]
    for view in views:
        for row, point in enumerate(view.points):
            tracks[point].append(f"{view.image} {row}")
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for number, (point, colour, track) in enumerate(zip(points, colours, tracks, strict=True), 1):
        if track:
            position = " ".join(f"{value:.9g}" for value in point)
            lines.append(f"{number} {position} {colour[0]} {colour[1]} {colour[2]} 0 {' '.join(track)}")
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
