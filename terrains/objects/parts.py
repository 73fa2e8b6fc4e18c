"""Parts of a mesh with their bounds, so that the parts that an image does not show need not be drawn.

A part is a run of consecutive triangles, which are neighbours in the built-in shapes and in most mesh files. Its bounds
are a box and a cone that contains the normals of its triangles (Shirman & Abi-Ezzi 1993).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.kernels import kernel
from twin.terrains.objects.mesh import Mesh

PART_FACES = 128  #: triangles in a part; the last part may have fewer
THIN = 1e-6  #: a triangle with a smaller ratio of height to length has no reliable normal


class Parts(NamedTuple):
    """Bounds of the n parts of a mesh, in the axes of the object.

    With c the centre of a part, p a corner and m the unit normal of any of its triangles, the angle between m and
    `axis` is at most the one whose cosine and sine are `cos_sin`, and m (p - c) >= -`behind_m`.

    Args:
        centre_m: (n, 3) centre of the bounding box.
        half_m: (n, 3) half of its extent.
        axis: (n, 3) unit vector, axis of the cone of the normals.
        cos_sin: (n, 2) cosine and sine of the largest angle between the axis and a normal; at most 90 deg.
        behind_m: (n,) largest distance of the centre in front of the plane of a triangle; inf if normals differ from
            the axis by 90 deg or more, or are not known.
    """

    centre_m: Array
    half_m: Array
    axis: Array
    cos_sin: Array
    behind_m: Array


#: Stands for the bounds of a mesh whose bounds are not known, so that all its parts are drawn.
UNKNOWN = Parts(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 2)), np.empty(0))


def parts_of(mesh: Mesh) -> Parts:
    """Returns the bounds of the parts of a mesh."""
    n = -(-len(mesh.faces) // PART_FACES)
    parts = Parts(np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 2)), np.empty(n))
    _bound(np.ascontiguousarray(mesh.vertices_m), mesh.faces, *parts)
    return parts


@kernel(error_model="numpy")
def _bound(vertices, faces, centre_m, half_m, axis, cos_sin, behind_m):
    """Fills the fields of `Parts` for the vertices (k, 3) and triangles (m, 3) of a mesh."""
    normal = np.empty((PART_FACES, 3))
    for p in range(centre_m.shape[0]):
        first, end = p * PART_FACES, min((p + 1) * PART_FACES, faces.shape[0])
        for k in range(3):
            low, high = np.inf, -np.inf
            for f in range(first, end):
                for corner in range(3):
                    low = min(low, np.float64(vertices[faces[f, corner], k]))
                    high = max(high, np.float64(vertices[faces[f, corner], k]))
            centre_m[p, k], half_m[p, k] = (low + high) / 2, (high - low) / 2
        known, mean_x, mean_y, mean_z = True, 0.0, 0.0, 0.0
        for f in range(first, end):
            x, y, z, is_thin = _normal(vertices, faces[f])
            normal[f - first, 0], normal[f - first, 1], normal[f - first, 2] = x, y, z
            mean_x, mean_y, mean_z = mean_x + x, mean_y + y, mean_z + z
            known = known and not is_thin
        length = max(np.sqrt(mean_x**2 + mean_y**2 + mean_z**2), 1e-12)
        axis[p, 0], axis[p, 1], axis[p, 2] = mean_x / length, mean_y / length, mean_z / length
        cosine, behind = 1.0, -np.inf
        for f in range(first, end):
            along, gap = 0.0, 0.0
            for k in range(3):
                along += normal[f - first, k] * axis[p, k]
                gap += normal[f - first, k] * (centre_m[p, k] - vertices[faces[f, 0], k])
            cosine, behind = min(cosine, along), max(behind, gap)
        known = known and cosine > 0
        cos_sin[p, 0], cos_sin[p, 1] = (cosine, np.sqrt(1 - cosine**2)) if known else (0.0, 1.0)
        behind_m[p] = behind if known else np.inf


@kernel(error_model="numpy", forceinline=True)
def _normal(vertices, face):
    """Returns the unit normal x, y, z of a triangle, and whether the triangle is thin."""
    a, b, c = vertices[face[0]], vertices[face[1]], vertices[face[2]]
    ab_x, ab_y, ab_z = np.float64(b[0]) - a[0], np.float64(b[1]) - a[1], np.float64(b[2]) - a[2]
    ac_x, ac_y, ac_z = np.float64(c[0]) - a[0], np.float64(c[1]) - a[1], np.float64(c[2]) - a[2]
    x, y, z = ab_y * ac_z - ab_z * ac_y, ab_z * ac_x - ab_x * ac_z, ab_x * ac_y - ab_y * ac_x
    length = np.sqrt(x * x + y * y + z * z)
    size = max(abs(ab_x), abs(ab_y), abs(ab_z), abs(ac_x), abs(ac_y), abs(ac_z))
    per_length = 1 / max(length, 1e-300)
    return x * per_length, y * per_length, z * per_length, length <= THIN * size**2
