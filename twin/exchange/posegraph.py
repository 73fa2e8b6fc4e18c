"""Pose graph files: writes the keyframe network as g2o, and reads g2o and TORO files.

In g2o files, as read and written here and by GTSAM, the information of a rotation refers to the rotation vector
[1/rad^2]. In g2o itself it refers to the vector part of the quaternion (for small rotations half the rotation vector),
so its values are four times as large.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.links import Link
from twin.core.records import SurveyResult
from twin.errors import TwinError
from twin.exchange.posegraph_connections import connection_warnings
from twin.exchange.posegraph_lines import IgnoredLines, Layout, Rows, read_rows

_ROTATION_LAST = [3, 4, 5, 0, 1, 2]  # g2o and TORO put the translation first
_UPPER = np.triu_indices(6)


class PoseGraph(NamedTuple):
    """Contents of a pose graph file.

    Args:
        poses: pose (4, 4) of each vertex, by its number; empty if the file has only edges.
        links: one link per edge; overlap is NaN and the number of matched points 0, as the formats contain neither.
        ignored: the ignored lines, one entry per unknown tag.
        warnings: sentences, with file and line, on unknown tags, nodes without an edge, nodes without a vertex, and
            separate connected components of the graph.
    """

    poses: dict[int, Array]
    links: list[Link]
    ignored: tuple[IgnoredLines, ...] = ()
    warnings: tuple[str, ...] = ()


def write(path: Path, result: SurveyResult) -> None:
    """Writes the final keyframe poses and the links as VERTEX_SE3:QUAT and EDGE_SE3:QUAT lines (g2o).

    Quaternions are ordered xyzw. Information matrices are those of [translation, rotation vector] and are written as
    upper triangles, row by row.
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
    """Returns the graph in the lines VERTEX_SE3:QUAT and EDGE_SE3:QUAT (g2o), VERTEX3 and EDGE3 (TORO) of a file.

    Poses in TORO lines are x y z roll pitch yaw. Other lines are ignored; a warning in the result reports them.

    Raises:
        TwinError: the file cannot be read or has no such line; a line has the wrong number of values, a node number
            that is not an integer, a value that is not a finite number, a quaternion that is not of unit length, a
            pitch of +-90 deg or an information matrix that is not positive definite; a node is defined twice, or an
            edge joins a node with itself.
    """
    rows, ignored = read_rows(path, _LAYOUTS)
    vertices = [(rows[tag], *_poses(path, rows[tag], convert)) for tag, convert in _VERTICES.items()]
    edges = [(rows[tag], *_poses(path, rows[tag], convert)) for tag, convert in _EDGES.items()]
    if not any(len(part.line) for part, *_ in vertices + edges):
        others = "".join(f"; {ignored_warning(path, lines)}" for lines in ignored)
        raise TwinError(str(path), f"has no vertex and no edge{others}", ", ".join(_LAYOUTS))
    poses: dict[int, Array] = {}
    for part, pose, _ in vertices:
        _check_once(path, part, poses)
        poses.update(zip(part.nodes[:, 0].tolist(), pose, strict=True))
    links = [link for part, pose, jacobian in edges for link in _links(path, part, pose, jacobian)]
    nodes = np.concatenate([part.nodes[:, 0] for part, *_ in vertices])
    node_lines = np.concatenate([part.line for part, *_ in vertices])
    pairs = np.concatenate([part.nodes for part, *_ in edges])
    pair_lines = np.concatenate([part.line for part, *_ in edges])
    warnings = [ignored_warning(path, lines) for lines in ignored]
    warnings += connection_warnings(path, (nodes, node_lines), (pairs, pair_lines))
    return PoseGraph(poses, links, ignored, tuple(warnings))


def ignored_warning(path: Path, lines: IgnoredLines) -> str:
    """Returns a sentence, with file and line, that reports the ignored lines of an unknown tag."""
    tag = f"with the unknown tag {lines.tag[:40]!r}"
    ignored = f"1 line {tag} is ignored" if lines.n_lines == 1 else f"{lines.n_lines} lines {tag} are ignored"
    return f"{path}:{lines.first_line}: {ignored}"


def _check_once(path: Path, part: Rows, poses: Mapping[int, Array]) -> None:
    """Raises TwinError if a vertex is defined twice: in `part`, or in `part` and in `poses`."""
    numbers, counts = np.unique(part.nodes, return_counts=True)
    twice = {*numbers[counts > 1].tolist(), *(poses.keys() & set(numbers.tolist()))}
    if twice:
        line = int(part.line[np.isin(part.nodes[:, 0], list(twice))][-1])
        node = int(part.nodes[part.line == line, 0][0])
        raise TwinError(f"{path}:{line}", f"node {node} is defined twice", "one vertex per node")


def _poses(path: Path, part: Rows, convert: _Convert) -> tuple[Array, Array]:
    """Returns the poses (n, 4, 4) of all lines of a tag, and the Jacobians (n, 3, 3) of their rotation parameters.

    A Jacobian is the derivative of the rotation parameters in the file with respect to the rotation vector.

    Args:
        path: the file, for messages.
        part: lines of one tag, whose values begin with a pose.
        convert: function that converts the values to rotations.

    Raises:
        TwinError: a rotation is invalid.
    """
    if not len(part.line):
        return np.zeros((0, 4, 4)), np.zeros((0, 3, 3))
    rotation, jacobian, problem = convert(part.values)
    if problem.text and problem.rows.any():
        line = int(part.line[problem.rows][0])
        raise TwinError(f"{path}:{line}", problem.text, problem.allowed)
    poses = np.zeros((len(rotation), 4, 4))
    poses[:, :3, :3], poses[:, :3, 3], poses[:, 3, 3] = rotation, part.values[:, :3], 1.0
    return poses, jacobian


def _links(path: Path, part: Rows, i_from_j: Array, jacobian: Array) -> list[Link]:
    """Returns the links of all edges of a tag; covariances are of [rotation vector, translation] in the axes of node j.

    Args:
        path: the file, for messages.
        part: the edges; the last 21 values are the upper triangle of the information matrix of [translation, rotation
            parameters of the file].
        i_from_j: (n, 4, 4) motions.
        jacobian: (n, 3, 3) derivative of the file's rotation parameters with respect to the rotation vector.

    Raises:
        TwinError: an edge joins a node with itself, or its information matrix is not positive definite.
    """
    loops = part.nodes[:, 0] == part.nodes[:, 1]
    if loops.any():
        k = int(loops.argmax())
        raise TwinError(f"{path}:{part.line[k]}", f"joins node {part.nodes[k, 0]} with itself", "two different nodes")
    information = np.zeros((len(part.line), 6, 6))
    information[:, *_UPPER] = part.values[:, -21:]
    information += np.triu(information, 1).transpose(0, 2, 1)
    _check_definite(path, part, information)
    file_from_motion = np.zeros_like(information)
    file_from_motion[:, :3, 3:], file_from_motion[:, 3:, :3] = np.eye(3), jacobian
    covs = np.linalg.inv(file_from_motion.transpose(0, 2, 1) @ information @ file_from_motion)
    columns = part.nodes[:, 0].tolist(), part.nodes[:, 1].tolist(), i_from_j, covs
    return [Link(*row, np.nan, 0) for row in zip(*columns, strict=True)]


def _check_definite(path: Path, part: Rows, information: Array) -> None:
    """Raises TwinError at the first edge whose information matrix is not positive definite to numerical precision."""
    scale = np.sqrt(np.maximum(np.einsum("nkk->nk", information), np.finfo(float).tiny))
    scaled = information / scale[:, :, None] / scale[:, None, :]  # units of rotation and translation differ
    try:
        np.linalg.cholesky(scaled - 1e-12 * np.eye(6))
    except np.linalg.LinAlgError:
        smallest = np.linalg.eigvalsh(scaled)[:, 0]
        k = int((smallest <= 1e-12).argmax())
        eigenvalue = np.linalg.eigvalsh(information[k])[0]
        kind = "singular" if smallest[k] > -1e-12 else "indefinite"
        problem = f"the information matrix is {kind}: its least eigenvalue is {eigenvalue:.3g}"
        raise TwinError(f"{path}:{part.line[k]}", problem, "a positive definite matrix") from None


class _Problem(NamedTuple):
    """A problem in some lines: mask (n,) of these lines, description ("" for no problem), and the allowed values."""

    rows: NDArray[np.bool_]
    text: str
    allowed: str


_Convert = Callable[[Array], tuple[Array, Array, _Problem]]


def _from_quaternions(values: Array) -> tuple[Array, Array, _Problem]:
    """Returns the rotations of values x y z qx qy qz qw (n, 7 or more).

    Returns:
        Rotations (n, 3, 3), Jacobians (n, 3, 3) (identities, see `_poses`), and the problem of the rows whose
        quaternion is not of unit length.
    """
    length = np.linalg.norm(values[:, 3:7], axis=1)
    bad = np.abs(length - 1) > _QUATERNION_TOLERANCE
    text = f"the quaternion has the length {length[bad][0]:.3g}" if bad.any() else ""
    quaternion = np.where(bad[:, None], [1.0, 0.0, 0.0, 0.0], values[:, [6, 3, 4, 5]])
    jacobian = np.broadcast_to(np.eye(3), (len(values), 3, 3))
    return geometry.rotation_from_wxyz(quaternion), jacobian, _Problem(bad, text, "a quaternion x y z w of length 1")


def _from_euler_angles(values: Array) -> tuple[Array, Array, _Problem]:
    """Returns the rotations of values x y z roll pitch yaw (n, 6 or more) with angles in radians.

    Returns:
        Rotations (n, 3, 3), Jacobians (n, 3, 3) (see `_poses`), and the problem of the rows with a pitch of +-90 deg.
    """
    from scipy.spatial.transform import Rotation  # imported here as in `geometry.rotation_from_wxyz`

    roll, pitch = values[:, 3:5].T
    bad = np.abs(np.cos(pitch)) < 1e-6
    # derivative of the body-axes rotation vector with respect to roll, pitch, yaw (Goldstein, Classical Mechanics)
    rates = np.zeros((len(values), 3, 3))
    rates[:, 0, 0], rates[:, 0, 2] = 1.0, -np.sin(pitch)
    rates[:, 1, 1], rates[:, 1, 2] = np.cos(roll), np.sin(roll) * np.cos(pitch)
    rates[:, 2, 1], rates[:, 2, 2] = -np.sin(roll), np.cos(roll) * np.cos(pitch)
    rates[bad] = np.eye(3)
    rotation = Rotation.from_euler("ZYX", values[:, [5, 4, 3]]).as_matrix()
    problem = _Problem(bad, "the pitch is 90 deg, where roll and yaw are not distinct", "a pitch below 90 deg")
    return rotation, np.asarray(np.linalg.inv(rates), np.float64), problem


#: Largest accepted deviation of a quaternion's length from 1; files have at least six digits.
_QUATERNION_TOLERANCE = 1e-3
#: Function that converts the values of poses to rotations, by tag.
_VERTICES: dict[str, _Convert] = {"VERTEX_SE3:QUAT": _from_quaternions, "VERTEX3": _from_euler_angles}
_EDGES: dict[str, _Convert] = {"EDGE_SE3:QUAT": _from_quaternions, "EDGE3": _from_euler_angles}
_LAYOUTS = {
    "VERTEX_SE3:QUAT": Layout(1, 7),
    "EDGE_SE3:QUAT": Layout(2, 28),
    "VERTEX3": Layout(1, 6),
    "EDGE3": Layout(2, 27),
}


def _pose_texts(poses: Array) -> list[str]:
    """Returns the text "x y z qx qy qz qw" of each of the poses (n, 4, 4)."""
    return _row_texts(np.column_stack([poses[:, :3, 3], geometry.quaternions_xyzw(poses[:, :3, :3])]), "%.12g")


def _row_texts(rows: Array, number_format: str) -> list[str]:
    """Returns the text of each row of an array (n, k): its numbers in a printf format, separated by spaces."""
    line = " ".join([number_format] * rows.shape[1]) + "\n"
    return (line * len(rows) % tuple(rows.ravel().tolist())).splitlines()
