"""Parts of a mesh with their bounds, so that the parts that an image does not show need not be drawn.

A part is a run of consecutive triangles, which are neighbours in the built-in shapes and in most mesh files. Its bounds
are a box and a cone that contains the normals of its triangles (Shirman & Abi-Ezzi 1993).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.terrains.objects.coloured_mesh import Mesh

PART_FACES = 128  #: triangles in a part; the last part may have fewer
THIN = 1e-6  #: a triangle with a smaller ratio of height to length has no reliable normal


class Parts(NamedTuple):
    """Bounds of the n parts of a mesh, in the axes of the object.

    With c the centre of a part, p a corner and m the unit normal of any of its triangles, the angle between m and
    `axis` is at most the one whose cosine and sine are `cos_sin`, and m (p - c) >= -`behind_m`.
    """

    centre_m: Array  #: (n, 3) centre of the bounding box
    half_m: Array  #: (n, 3) half of its extent
    axis: Array  #: (n, 3) unit vector, axis of the cone of the normals
    cos_sin: Array  #: (n, 2) cosine and sine of the largest angle between the axis and a normal; at most 90 deg
    #: (n,) largest distance of the centre in front of the plane of a triangle; inf if normals differ from the axis by
    #: 90 deg or more, or are not known
    behind_m: Array


#: Stands for the bounds of a mesh whose bounds are not known, so that all its parts are drawn.
UNKNOWN = Parts(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 2)), np.empty(0))


def parts_of(mesh: Mesh) -> Parts:
    """Returns the bounds of the parts of a mesh."""
    n = -(-len(mesh.faces) // PART_FACES)
    faces = np.pad(mesh.faces, ((0, n * PART_FACES - len(mesh.faces)), (0, 0)), mode="edge")
    corners = mesh.vertices_m[faces].astype(np.float64)
    normals, thin = _normals(corners)
    corners, normals = corners.reshape(n, -1, 3, 3), normals.reshape(n, -1, 3)
    low, high, mean = corners.min(axis=(1, 2)), corners.max(axis=(1, 2)), normals.sum(axis=1)
    centre, axis = (low + high) / 2, mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    cosine = np.minimum((normals @ axis[..., None])[..., 0].min(axis=1), 1.0)
    behind = (normals * (centre[:, None] - corners[:, :, 0])).sum(axis=2).max(axis=1)
    known = (cosine > 0) & ~thin.reshape(n, -1).any(axis=1)
    cosine, sine = np.where(known, cosine, 0.0), np.where(known, np.sqrt(1 - cosine**2), 1.0)
    return Parts(centre, (high - low) / 2, axis, np.stack([cosine, sine], axis=1), np.where(known, behind, np.inf))


def _normals(corners: Array) -> tuple[Array, Array]:
    """Returns the unit normals (m, 3) of triangles (m, 3, 3), and whether each triangle is thin (m,)."""
    ab, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    x, y, z = np.cross(ab, ac).T
    length, size = np.sqrt(x * x + y * y + z * z), np.abs(np.concatenate([ab, ac], axis=1)).max(axis=1)
    return np.stack([x, y, z], axis=1) / np.maximum(length, 1e-300)[:, None], length <= THIN * size**2
