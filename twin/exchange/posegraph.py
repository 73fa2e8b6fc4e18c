"""Writer of the keyframe network as a pose graph in g2o format.

As in GTSAM, the information of a rotation refers to the rotation vector [1/rad^2]. In g2o itself it refers to the
vector part of the quaternion (half the rotation vector, if small), so its values are four times as large.
"""

from pathlib import Path

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import SurveyResult

_ROTATION_LAST = [3, 4, 5, 0, 1, 2]  # g2o puts the translation first
_UPPER = np.triu_indices(6)


def write(path: Path, result: SurveyResult) -> None:
    """Writes the final keyframe poses and the links as VERTEX_SE3:QUAT and EDGE_SE3:QUAT lines (g2o).

    Quaternions are xyzw. Information matrices, of [translation, rotation vector], are upper triangles, row by row.
    """
    poses = result.final.world_from_camera[result.keyframe_rows]
    vertices = "".join(f"VERTEX_SE3:QUAT {k} {pose}\n" for k, pose in enumerate(_pose_texts(poses)))
    links = result.links
    upper = links.information[:, _ROTATION_LAST][:, :, _ROTATION_LAST][:, *_UPPER]
    motions, informations = _pose_texts(links.i_from_j), _row_texts(upper, "%.7g")
    edges = "".join(
        f"EDGE_SE3:QUAT {i} {j} {motion} {information}\n"
        for i, j, motion, information in zip(links.i, links.j, motions, informations, strict=True)
    )
    path.write_text(vertices + edges)


def _pose_texts(poses: Array) -> list[str]:
    """Returns the text "x y z qx qy qz qw" of each of the poses (n, 4, 4)."""
    rows = np.column_stack([poses[:, :3, 3], geometry.quaternions_xyzw(poses[:, :3, :3])])
    return _row_texts(np.round(rows, 10) + 0.0, "%.12g")


def _row_texts(rows: Array, number_format: str) -> list[str]:
    line = " ".join([number_format] * rows.shape[1]) + "\n"
    return (line * len(rows) % tuple(rows.ravel().tolist())).replace("e+0", "e").splitlines()
