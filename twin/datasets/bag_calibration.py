"""Calibration of a stereo rig from ROS messages: sensor_msgs/CameraInfo (REP 104) and /tf_static."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.datasets.calibration import RecordedCamera, StereoCalibration, checked, distortion_kind
from twin.errors import TwinError

_UNIT_QUATERNION = 0.01  # largest deviation of the norm of a quaternion from 1
Transforms = dict[str, tuple[str, Array]]


def stereo_calibration(
    left: Any, right: Any, rectified: bool, right_from_left: Array | None, file: Path
) -> StereoCalibration:
    """Returns the calibration in two messages CameraInfo.

    The projection matrices P of a pair refer to rectified axes, x_rectified = R x, and P_right[0, 3] = -fx baseline. A
    point x of the left camera is therefore at R_right^T (R_left x + (t, 0, 0)) in the right one, with t = P[0, 3] /
    P[0, 0] of the right camera minus that of the left one (definition of sensor_msgs/CameraInfo).

    Args:
        left, right: messages of the two cameras: `k`, `d`, `distortion_model`, `r`, `p`, `width`, `height`.
        rectified: whether the images are rectified, so that P instead of K and D is their calibration.
        right_from_left: (4, 4) pose of the left camera in the axes of the right one, from /tf_static; used only if the
            projection matrices have no baseline. None: not recorded.
        file: bag and topic, for messages.

    Raises:
        TwinError: the messages have no baseline, or a value is impossible or not supported.
    """
    cameras = [_camera(info, rectified, file) for info in (left, right)]
    turns = [np.eye(3) if rectified else _rotation(info, file) for info in (left, right)]
    offset_m = _offset_m(right, file) - _offset_m(left, file)
    if offset_m != 0:
        shift = np.array([offset_m, 0.0, 0.0])
        pose = geometry.pose(turns[1].T @ turns[0], turns[1].T @ shift)
    elif right_from_left is not None:
        pose = right_from_left
    else:
        allowed = "P[3] = -fx * baseline of the right camera, or both cameras in /tf_static"
        raise TwinError(str(file), "has no baseline", allowed)
    return checked(StereoCalibration(cameras[0], cameras[1], pose, file))


def add_transforms(found: Transforms, message: Any, file: Path) -> None:
    """Adds the transforms of a message tf2_msgs/TFMessage to `found`: frame -> (parent, pose of the frame in it).

    Raises:
        TwinError: a transform is not a pose.
    """
    for one in message.transforms:
        found[one.child_frame_id.lstrip("/")] = one.header.frame_id.lstrip("/"), pose_of_transform(one.transform, file)


def pose_of_transform(transform: Any, file: Path) -> Array:
    """Returns the pose (4, 4) of a message Transform (`translation`, `rotation`) or Pose (`position`, `orientation`).

    Raises:
        TwinError: the numbers are not a pose.
    """
    t = transform.translation if hasattr(transform, "translation") else transform.position
    q = transform.rotation if hasattr(transform, "rotation") else transform.orientation
    quaternion, position = np.array([q.w, q.x, q.y, q.z]), np.array([t.x, t.y, t.z])
    finite = np.isfinite(quaternion).all() and np.isfinite(position).all()
    if not finite or not abs(np.linalg.norm(quaternion) - 1) < _UNIT_QUATERNION:
        raise TwinError(str(file), "has a pose that is not a rotation and a translation", "unit quaternions, metres")
    return geometry.pose(geometry.rotation_from_wxyz(quaternion), position)


def relative_pose(transforms: Transforms, target: str, source: str) -> Array | None:
    """Returns the pose (4, 4) of the frame `source` in the axes of the frame `target`; None if no transforms join them.

    Args:
        transforms: frame -> (parent, pose of the frame in its parent).
        target, source: names of frames.
    """
    if target == source:
        return np.eye(4)
    to_target, to_source = _ancestors(transforms, target), _ancestors(transforms, source)
    common = next((frame for frame in to_source if frame in to_target), None)
    return None if common is None else geometry.inverse(to_target[common]) @ to_source[common]


def _ancestors(transforms: Transforms, frame: str) -> dict[str, Array]:
    """Returns the pose (4, 4) of a frame in itself (the identity) and in each of its ancestors, nearest first."""
    found = {frame: np.eye(4)}
    while frame in transforms and transforms[frame][0] not in found:
        parent, pose = transforms[frame]
        found[parent] = pose @ found[frame]
        frame = parent
    return found


def _camera(info: Any, rectified: bool, file: Path) -> RecordedCamera:
    """Returns the camera of a message CameraInfo.

    Raises:
        TwinError: the images are not rectified, and their lens model is not supported, they are binned, or they show
            only a region of interest.
    """
    size = (int(info.width), int(info.height)) if info.width and info.height else None
    if rectified:
        return RecordedCamera(size, np.array(info.p, float).reshape(3, 4)[:, :3], np.zeros(0))
    distortion = np.array(info.d, float)
    if not distortion.any():
        distortion = np.zeros(0)
    kind = distortion_kind(info.distortion_model or "none", file)
    if kind == "fisheye":
        distortion = distortion[:4]
    _check_full_image(info, file)
    return RecordedCamera(size, np.array(info.k, float).reshape(3, 3), distortion, kind)


def _check_full_image(info: Any, file: Path) -> None:
    """Raises TwinError if a message CameraInfo belongs to binned images or to a part of the images."""
    part = info.roi.width not in (0, info.width) or info.roi.height not in (0, info.height)
    if part or info.binning_x > 1 or info.binning_y > 1:
        raise TwinError(str(file), "images of a region of interest or binned ones are not supported", "full images")


def _rotation(info: Any, file: Path) -> Array:
    """Returns the rectifying rotation R (3, 3) of a message CameraInfo; the identity if it is not set.

    Raises:
        TwinError: R is not a rotation matrix.
    """
    rotation = np.array(info.r, float).reshape(3, 3)
    if not rotation.any():
        return np.eye(3)
    if not np.isfinite(rotation).all() or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        raise TwinError(str(file), "R is not a rotation matrix")
    return geometry.nearest_rigid(geometry.pose(rotation, np.zeros(3)))[:3, :3]


def _offset_m(info: Any, file: Path) -> float:
    """Returns P[0, 3] / P[0, 0] [m]: minus the position of a camera along the baseline; 0 unless P[0, 0] > 0.

    Raises:
        TwinError: P[0, 0] or P[0, 3] is not finite.
    """
    fx, shift = float(info.p[0]), float(info.p[3])
    if not np.isfinite([fx, shift]).all():
        raise TwinError(str(file), "P is not a set of finite numbers")
    return shift / fx if fx > 0 else 0.0
