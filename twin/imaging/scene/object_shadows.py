"""Shadows that objects cast on the floor, on each other and on themselves, in the light of lamps and sun.

For each light, the objects are drawn into a depth image as seen from it (shadow map, Williams 1978), which spans the
points that the camera sees, with pixels about twice as large: lamps are not points, and their shadows are not sharper.
A point is in the shadow where the map shows an object nearer to the light by more than a bias of some pixels.
"""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import Array, Depth, StereoRig
from twin.core.threads import in_row_bands
from twin.imaging.scene.facets import Heights
from twin.imaging.scene.mesh_raster import NEAR_M, ObjectView, Projection, Target, draw_meshes
from twin.imaging.scene.object_view import Objects
from twin.kernels import kernel

FROM_ABOVE: Array = np.diag([1.0, -1.0, -1.0, 1.0])  #: axes east, south, down
STRIDE_PX = 8  #: spacing of the pixels whose points determine the extent of a map
MAP_PX = 2.0  #: size of the pixels of a map, in pixels of the image
MARGIN_PX = 2.0  #: margin of a map around these points, in its pixels
WIDEST_TANGENT = 5.0  #: largest tangent of half the field of view of a map; points outside the map count as lit
BIAS_PX = 1.5  #: least distance of an occluder from a point of an object that faces the light, in pixels of the map
STEEPEST = 8.0  #: largest tangent of the angle of incidence by which the bias grows


#: View from a light: light_from_camera (4, 4), the projection of its shadow map, and rows and columns of the map.
_LightView = tuple[Array, Projection, tuple[int, int]]


class ObjectShadows:
    """Shadow casting by objects; lamps are in the axes of left and right camera, `to_sun` in those of the world."""

    def __init__(self, objects: Objects, rig: StereoRig, lamp_positions_m: list[Array], to_sun: Array | None):
        self._objects, self._focal_px = objects, rig.focal_px
        self._lamps, self._to_sun = lamp_positions_m, to_sun

    def darken(
        self, lit: NDArray[np.uint8], depth: Depth, view: ObjectView, world_from_camera: Array,
        moment: tuple[int, float],
    ) -> None:  # fmt: skip
        """Sets `lit` (lamps, H, W) to 0 where an object occludes a lamp or the sun (the last mask), or faces away."""
        # `depth` is that of floor and objects; `moment`: camera (0 left, 1 right), and time of the survey [s]
        camera, time_s = moment
        points = self._sampled_points(depth)
        if not len(points):
            return
        camera_from_world = geometry.inverse(world_from_camera)
        for k in range(len(lit)):
            if k < len(self._lamps[camera]):
                light = _lamp_view(self._lamps[camera][k], points, depth.shape)
            else:
                assert self._to_sun is not None
                light = _sun_view(camera_from_world[:3, :3] @ self._to_sun, points, depth.shape)
            if light is None:
                continue
            light_from_camera, projection, shape = light
            nearest = np.full(shape, np.inf, np.float32)
            casting = self._objects.in_view(light_from_camera @ camera_from_world, projection, shape, time_s)
            draw_meshes(casting, projection, Target(nearest))
            matrix = np.ascontiguousarray(light_from_camera[:3])
            scene = lit[k], depth, self._focal_px, *view, nearest, matrix, projection
            in_row_bands(partial(_darken, *scene), len(depth))

    def _sampled_points(self, depth: Depth) -> Array:
        height, width = depth.shape
        rows = np.unique(np.append(np.arange(0, height, STRIDE_PX), height - 1))
        cols = np.unique(np.append(np.arange(0, width, STRIDE_PX), width - 1))
        z = depth[np.ix_(rows, cols)].astype(np.float64)
        x = (cols - (width - 1) / 2) / self._focal_px * z
        y = (rows[:, None] - (height - 1) / 2) / self._focal_px * z
        return np.stack([x, y, z], axis=-1)[np.isfinite(z)]


def heights_with(objects: Objects, floor: Heights) -> NDArray[np.float32]:
    """Returns the heights of the nodes of a floor (rows, cols) with the objects on it, but for plants that sway [m]."""
    (rows, cols), per_m = floor.height_m.shape, 1 / floor.spacing_m
    view = Projection(per_m, -floor.west_m * per_m, floor.south_m * per_m + rows - 1, -np.inf, False)
    down_m = np.ascontiguousarray(-floor.height_m[::-1], np.float32)
    drawn = objects.in_view(FROM_ABOVE, view, (rows, cols), 0.0)
    still = [item for item in drawn if not objects.placed[item.label - 1].model.sways]
    draw_meshes(still, view, Target(down_m))
    return np.ascontiguousarray(-down_m[::-1])


def _lamp_view(lamp_m: Array, points: Array, shape: tuple[int, int]) -> _LightView | None:
    """Returns the view from a lamp, its axis in the mean direction of the points; None if no point is ahead."""
    away = points - lamp_m
    rotation = _axes_along((away / np.linalg.norm(away, axis=1, keepdims=True)).mean(axis=0))
    seen = away @ rotation
    ahead = seen[seen[:, 2] > NEAR_M]
    if not len(ahead):
        return None
    tangents = np.clip(ahead[:, :2] / ahead[:, 2:], -WIDEST_TANGENT, WIDEST_TANGENT)
    return _view_of(tangents, shape, geometry.pose(rotation, lamp_m), NEAR_M, True)


def _sun_view(to_sun: Array, points: Array, shape: tuple[int, int]) -> _LightView:
    rotation = _axes_along(-to_sun)
    return _view_of((points @ rotation)[:, :2], shape, geometry.pose(rotation, np.zeros(3)), -np.inf, False)


def _view_of(
    places: Array, shape: tuple[int, int], camera_from_light: Array, near_m: float, perspective: bool
) -> _LightView:
    """Returns the view of places (n, 2) [tangents or m], with pixels of `MAP_PX` for an image of (rows, cols)."""
    low, high = places.min(axis=0), places.max(axis=0)
    scale = float(np.sqrt(shape[0] * shape[1] / np.maximum(high - low, 1e-3).prod())) / MAP_PX
    low, high = low - MARGIN_PX / scale, high + MARGIN_PX / scale
    cols, rows = np.ceil((high - low) * scale).astype(int) + 1
    projection = Projection(scale, -low[0] * scale, -low[1] * scale, near_m, perspective)
    return geometry.inverse(camera_from_light), projection, (int(rows), int(cols))


def _axes_along(forward: Array) -> Array:
    """Returns a rotation (3, 3) whose third column is along `forward`."""
    z = forward / np.linalg.norm(forward)
    x = np.cross(np.eye(3)[np.abs(z).argmin()], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


@kernel(error_model="numpy")
def _darken(lit, depth, focal, normal, label, nearest, matrix, projection, first, end):
    """Sets `lit` (H, W) to 0 in rows where the map `nearest` shows an object that occludes, or objects face away."""
    # the bias is one pixel on the floor, BIAS_PX (1 + t) on objects, t the tangent of incidence up to STEEPEST
    height, width = depth.shape
    x = (np.arange(width) - 0.5 * (width - 1)) / focal
    cell, reach, bias = np.empty(width, np.int32), np.empty(width), np.empty(width)
    in_map = nearest.reshape(-1)
    for v in range(first, end):
        y = (v - 0.5 * (height - 1)) / focal
        _find_cells(depth[v], x, y, matrix, projection, nearest.shape, cell, reach, bias)
        for u in range(width):
            if cell[u] < 0:
                continue
            factor = 1.0
            if label[v, u]:
                cosine = _cosine(depth[v, u], x[u], y, normal[v, u], matrix, projection[4])
                if cosine <= 0:
                    lit[v, u] = 0
                    continue
                tangent = np.sqrt(max(1 - cosine * cosine, 0.0)) / cosine
                factor = BIAS_PX * (1 + min(tangent, STEEPEST))
            if in_map[cell[u]] < reach[u] - bias[u] * factor:
                lit[v, u] = 0


@kernel(error_model="numpy", forceinline=True)
def _find_cells(depth, x, y, matrix, projection, shape, cell, reach, bias):
    """Computes the pixels of the map that show the points of a row (w,), numbered row by row; -1 outside the map."""
    scale, cx, cy, _, perspective = projection
    rows, cols = shape
    for u in range(depth.size):
        z = np.float64(depth[u])
        right, down = x[u] * z, y * z
        a = matrix[0, 0] * right + matrix[0, 1] * down + matrix[0, 2] * z + matrix[0, 3]
        b = matrix[1, 0] * right + matrix[1, 1] * down + matrix[1, 2] * z + matrix[1, 3]
        c = matrix[2, 0] * right + matrix[2, 1] * down + matrix[2, 2] * z + matrix[2, 3]
        share = 1 / c if perspective else 1.0
        col, row = np.rint(scale * a * share + cx), np.rint(scale * b * share + cy)
        there = (z < np.inf) & (share > 0) & (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
        cell[u] = np.int32(row if there else 0.0) * np.int32(cols) + np.int32(col if there else 0.0)
        cell[u] = cell[u] if there else np.int32(-1)
        reach[u] = c
        bias[u] = 1 / (scale * share)


@kernel(error_model="numpy", forceinline=True)
def _cosine(depth, x, y, normal, matrix, perspective):
    z = np.float64(depth)
    x, y = x * z, y * z
    nx, ny, nz = normal[0], normal[1], normal[2]
    na = matrix[0, 0] * nx + matrix[0, 1] * ny + matrix[0, 2] * nz
    nb = matrix[1, 0] * nx + matrix[1, 1] * ny + matrix[1, 2] * nz
    nc = matrix[2, 0] * nx + matrix[2, 1] * ny + matrix[2, 2] * nz
    if not perspective:
        return -nc
    a = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]
    b = matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]
    c = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
    return -(na * a + nb * b + nc * c) / np.sqrt(a * a + b * b + c * c)
