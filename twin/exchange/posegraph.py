"""The key-point network as a g2o file: what pose-graph tools read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from twin import geometry
from twin.geometry import Array
from twin.records import SurveyResult

_ROTATION_LAST = [3, 4, 5, 0, 1, 2]  # g2o orders translation first


def write(path: Path, result: SurveyResult) -> None:
    """Writes VERTEX_SE3:QUAT and EDGE_SE3:QUAT lines: quaternions xyzw, upper triangle of the information matrix."""
    poses = result.final.world_from_camera[result.key_frames]
    lines = [f"VERTEX_SE3:QUAT {k} {_pose(pose)}" for k, pose in enumerate(poses)]
    for link in result.links:
        information = np.linalg.inv(link.cov)[np.ix_(_ROTATION_LAST, _ROTATION_LAST)]
        upper = " ".join(f"{v:.9g}" for v in information[np.triu_indices(6)])
        lines.append(f"EDGE_SE3:QUAT {link.i} {link.j} {_pose(link.i_from_j)} {upper}")
    path.write_text("\n".join(lines) + "\n")


def _pose(pose: Array) -> str:
    return " ".join(f"{v:.12g}" for v in [*pose[:3, 3], *geometry.quaternion_xyzw(pose[:3, :3])])
