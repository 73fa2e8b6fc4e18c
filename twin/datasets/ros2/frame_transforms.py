"""Poses in the messages of a ROS 2 bag, and the static transforms that join its coordinate frames."""

from pathlib import Path
from typing import Any

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.datasets.dataset import are_rotations
from twin.datasets.ros2.bag import Bag
from twin.errors import TwinError

#: Frame -> (parent, pose (4, 4) of the frame in its parent).
Transforms = dict[str, tuple[str, Array]]
_MOST_TRANSFORMS = 10_000


def static_transforms(bag: Bag) -> Transforms:
    """Returns the transforms in /tf_static; raises TwinError if one is not a pose, or there are more than 10,000."""
    found: Transforms = {}
    if bag.topics.get("/tf_static") != "tf2_msgs/msg/TFMessage":
        return found
    place = f"{bag.path}:/tf_static"
    for _, message in bag.messages("/tf_static"):
        for one in message.transforms:
            parent = one.header.frame_id.lstrip("/")
            found[one.child_frame_id.lstrip("/")] = parent, pose_of_transform(one.transform, Path(place))
        if len(found) > _MOST_TRANSFORMS:
            raise TwinError(place, f"has more than {_MOST_TRANSFORMS} frames")
    return found


def pose_of_transform(transform: Any, file: Path) -> Array:
    """Returns the pose (4, 4) of a message Transform or Pose; raises TwinError if the numbers are not a pose."""
    t = transform.translation if hasattr(transform, "translation") else transform.position
    q = transform.rotation if hasattr(transform, "rotation") else transform.orientation
    quaternion, position = np.array([q.w, q.x, q.y, q.z]), np.array([t.x, t.y, t.z])
    if not are_rotations(quaternion) or not np.isfinite(position).all():
        raise TwinError(str(file), "has a pose that is not a rotation and a translation", "unit quaternions, metres")
    return geometry.pose(geometry.rotation_from_wxyz(quaternion), position)


def relative_pose(transforms: Transforms, target: str, source: str) -> Array | None:
    """Returns the pose (4, 4) of the frame `source` in that of the frame `target`; None if no transforms join them."""
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
