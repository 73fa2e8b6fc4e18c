"""Pose graphs on disk: the keyframe network as a g2o file, and g2o and TORO files of others as links.

Information on rotation is taken per radian, as gtsam takes it. A g2o file made by g2o itself has it per vector part of
a quaternion, which is half an angle: four times the number.
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
    """Poses (4, 4) by number, where the file has any, and the motions between them; overlap and points are unknown."""

    poses: dict[int, Array]
    links: list[Link]


def write(path: Path, result: SurveyResult) -> None:
    """Writes VERTEX_SE3:QUAT and EDGE_SE3:QUAT lines: quaternions xyzw, upper triangle of the information matrix."""
    poses = result.final.world_from_camera[result.keyframe_rows]
    vertices = "".join(f"VERTEX_SE3:QUAT {k} {pose}\n" for k, pose in enumerate(_texts(poses)))
    links = result.links
    upper = links.information[:, _ROTATION_LAST][:, :, _ROTATION_LAST][:, *_UPPER]
    edges = "".join(
        f"EDGE_SE3:QUAT {i} {j} {motion} {known}\n"
        for i, j, motion, known in zip(links.i, links.j, _texts(links.i_from_j), _lines(upper, "%.9g"), strict=True)
    )
    path.write_text(vertices + edges)


def read(path: Path) -> PoseGraph:
    """Reads VERTEX_SE3:QUAT and EDGE_SE3:QUAT (g2o), or VERTEX3 and EDGE3 (TORO: x y z roll pitch yaw) lines.

    Raises:
        TwinError: a line of these has too few or too many numbers.
    """
    poses, links = {}, []
    for count, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        tag, *words = line.split() or [""]
        if tag not in _READERS:
            continue
        size, motion = _READERS[tag]
        try:
            if tag.startswith("VERTEX"):
                (number, *values) = words
                poses[int(number)] = motion(_numbers(values, size))[0]
            else:
                i, j, *values = words
                links.append(_link(int(i), int(j), *motion(_numbers(values[:size], size)), _numbers(values[size:], 21)))
        except ValueError as error:
            raise TwinError(f"{path}:{count}", str(error), f"{tag} with its numbers") from None
    return PoseGraph(poses, links)


def _numbers(words: Sequence[str], size: int) -> Array:
    if len(words) != size:
        raise ValueError(f"has {len(words)} numbers where {size} belong")
    return np.array([float(word) for word in words])


def _link(i: int, j: int, i_from_j: Array, per_rotation: Array, upper: Array) -> Link:
    """A link from the upper triangle of an information matrix over [translation, the file's own three of rotation].

    Args:
        per_rotation: (3, 3) derivative of the file's own three by the rotation vector in j.
    """
    information = np.zeros((6, 6))
    information[_UPPER] = upper
    information += np.triu(information, 1).T
    own_from_motion = np.zeros((6, 6))
    own_from_motion[:3, 3:], own_from_motion[3:, :3] = np.eye(3), per_rotation
    cov = np.asarray(np.linalg.inv(own_from_motion.T @ information @ own_from_motion), np.float64)
    return Link(i, j, i_from_j, cov, np.nan, 0)


def _by_quaternion(values: Array) -> tuple[Array, Array]:
    return geometry.pose(geometry.rotation_from_wxyz(values[[6, 3, 4, 5]]), values[:3]), np.eye(3)


def _by_euler(values: Array) -> tuple[Array, Array]:
    """The pose of x y z roll pitch yaw, and the derivative of roll, pitch, yaw by the rotation vector."""
    roll, pitch = values[3:5]
    # the rotation vector in the body by roll, pitch, yaw: Goldstein's rates
    rates = np.array(
        [
            [1, 0, -np.sin(pitch)],
            [0, np.cos(roll), np.sin(roll) * np.cos(pitch)],
            [0, -np.sin(roll), np.cos(roll) * np.cos(pitch)],
        ]
    )
    return geometry.pose(geometry.rotation_from_rpy(*values[3:]), values[:3]), np.linalg.inv(rates)


_READERS = {
    "VERTEX_SE3:QUAT": (7, _by_quaternion),
    "EDGE_SE3:QUAT": (7, _by_quaternion),
    "VERTEX3": (6, _by_euler),
    "EDGE3": (6, _by_euler),
}


def _texts(poses: Array) -> list[str]:
    """x y z qx qy qz qw of each pose (n, 4, 4)."""
    return _lines(np.column_stack([poses[:, :3, 3], geometry.quaternions_xyzw(poses[:, :3, :3])]), "%.12g")


def _lines(rows: Array, number: str) -> list[str]:
    """The numbers of each row (n, k) as a line."""
    line = " ".join([number] * rows.shape[1]) + "\n"
    return (line * len(rows) % tuple(rows.ravel().tolist())).splitlines()
