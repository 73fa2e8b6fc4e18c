"""Pose graph files: writing the keyframe network as g2o, reading g2o and TORO files as links.

In g2o files, as read and written here and by GTSAM, the information of a rotation refers to the rotation vector
[1/rad^2]. g2o itself refers it to the vector part of the quaternion (half the rotation vector), so its values are four
times as large.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.links import Link
from twin.core.records import SurveyResult
from twin.errors import TwinError

_ROTATION_LAST = [3, 4, 5, 0, 1, 2]  # g2o and TORO order translation first
_UPPER = np.triu_indices(6)


class PoseGraph(NamedTuple):
    """Contents of a pose graph file.

    Args:
        poses: pose (4, 4) of each vertex, by its number; empty if the file has only edges.
        links: one link per edge; its overlap is NaN and its number of matched points 0, as the formats have neither.
    """

    poses: dict[int, Array]
    links: list[Link]


def write(path: Path, result: SurveyResult) -> None:
    """Writes the final keyframe poses and the links as VERTEX_SE3:QUAT and EDGE_SE3:QUAT lines (g2o).

    Quaternions are ordered xyzw. The information matrices are written as upper triangles.
    """
    poses = result.final.world_from_camera[result.keyframe_rows]
    vertices = "".join(f"VERTEX_SE3:QUAT {k} {pose}\n" for k, pose in enumerate(_pose_texts(poses)))
    links = result.links
    upper = links.information[:, _ROTATION_LAST][:, :, _ROTATION_LAST][:, *_UPPER]
    motions, informations = _pose_texts(links.i_from_j), _row_texts(upper, "%.9g")
    edges = "".join(
        f"EDGE_SE3:QUAT {i} {j} {motion} {information}\n"
        for i, j, motion, information in zip(links.i, links.j, motions, informations, strict=True)
    )
    path.write_text(vertices + edges)


def read(path: Path) -> PoseGraph:
    """Reads VERTEX_SE3:QUAT and EDGE_SE3:QUAT lines (g2o) or VERTEX3 and EDGE3 lines (TORO: x y z roll pitch yaw).

    Lines with other tags are skipped.

    Raises:
        TwinError: a line has the wrong number of values, or one of them is not a number.
    """
    poses, links = {}, []
    for count, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        tag, *words = line.split() or [""]
        if tag not in _POSE_FORMATS:
            continue
        size, parse = _POSE_FORMATS[tag]
        try:
            if tag.startswith("VERTEX"):
                (number, *values) = words
                poses[int(number)] = parse(_floats(values, size))[0]
            else:
                i, j, *values = words
                links.append(_link(int(i), int(j), *parse(_floats(values[:size], size)), _floats(values[size:], 21)))
        except ValueError as error:
            raise TwinError(f"{path}:{count}", str(error), f"{tag} followed by its values") from None
    return PoseGraph(poses, links)


def _floats(words: Sequence[str], size: int) -> Array:
    """Returns the words as floats (size,). Raises ValueError if there are not `size` words."""
    if len(words) != size:
        raise ValueError(f"has {len(words)} values instead of {size}")
    return np.array([float(word) for word in words])


def _link(i: int, j: int, i_from_j: Array, rotation_jacobian: Array, upper: Array) -> Link:
    """Returns a link with the covariance of [rotation vector, translation] in the frame of vertex j.

    Args:
        rotation_jacobian: (3, 3) derivative of the file's rotation parameters with respect to the rotation vector.
        upper: (21,) upper triangle of the information matrix of [translation, rotation parameters of the file].
    """
    information = np.zeros((6, 6))
    information[_UPPER] = upper
    information += np.triu(information, 1).T
    file_from_motion = np.zeros((6, 6))
    file_from_motion[:3, 3:], file_from_motion[3:, :3] = np.eye(3), rotation_jacobian
    cov = np.asarray(np.linalg.inv(file_from_motion.T @ information @ file_from_motion), np.float64)
    return Link(i, j, i_from_j, cov, np.nan, 0)


def _pose_of_quaternion(values: Array) -> tuple[Array, Array]:
    """Returns the pose of x y z qx qy qz qw, and the identity as the Jacobian of its rotation parameters."""
    return geometry.pose(geometry.rotation_from_wxyz(values[[6, 3, 4, 5]]), values[:3]), np.eye(3)


def _pose_of_euler_angles(values: Array) -> tuple[Array, Array]:
    """Returns the pose of x y z roll pitch yaw, and the Jacobian of the angles with respect to the rotation vector."""
    roll, pitch = values[3:5]
    # derivative of the rotation vector in the body axes by roll, pitch and yaw (Goldstein, Classical Mechanics)
    rates = np.array(
        [
            [1, 0, -np.sin(pitch)],
            [0, np.cos(roll), np.sin(roll) * np.cos(pitch)],
            [0, -np.sin(roll), np.cos(roll) * np.cos(pitch)],
        ]
    )
    return geometry.pose(geometry.rotation_from_rpy(*values[3:]), values[:3]), np.linalg.inv(rates)


#: By tag: number of values that describe the pose, and the function that converts them.
_POSE_FORMATS = {
    "VERTEX_SE3:QUAT": (7, _pose_of_quaternion),
    "EDGE_SE3:QUAT": (7, _pose_of_quaternion),
    "VERTEX3": (6, _pose_of_euler_angles),
    "EDGE3": (6, _pose_of_euler_angles),
}


def _pose_texts(poses: Array) -> list[str]:
    """Returns "x y z qx qy qz qw" of each pose (n, 4, 4)."""
    return _row_texts(np.column_stack([poses[:, :3, 3], geometry.quaternions_xyzw(poses[:, :3, :3])]), "%.12g")


def _row_texts(rows: Array, number_format: str) -> list[str]:
    """Returns each row of numbers (n, k) as text, separated by spaces."""
    line = " ".join([number_format] * rows.shape[1]) + "\n"
    return (line * len(rows) % tuple(rows.ravel().tolist())).splitlines()
