"""Share of the scattered light of lamps that relief and objects hide from the floor.

The scattered light of a lamp arrives from a halo around it, of which relief hides a part. Light that is turned by t is
taken as scattered once: its path is the triangle of lamp, scattering and floor, with the angles s t at the lamp and (1
- s) t at the floor, s even from 0 to 1. If x is the angle at the lamp and F(x) the share beyond it (`lamp_mixture`),
the share turned by more than t is F(t) - t F'(t), as x is even from 0 to t. Paths with equal shares are weighted with
the lamp's beam and with the cosine at the floor.

The share is computed on a coarse grid of pixels, from those around shadows outwards as far as relief hides light.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.height_field import rises
from twin.core.records import Array, Depth
from twin.core.threads import in_row_bands
from twin.imaging.light.lamps import LightSources, beam_share
from twin.imaging.light.optics import Lit
from twin.imaging.light.phase_function import BandWater
from twin.imaging.light.shading import HIDDEN_STEPS
from twin.imaging.light.shadows import occluded, point_of, tops_of
from twin.imaging.light.spread import LAMP_SIGMA_RAD, NODES_M, lamp_mixture
from twin.imaging.light.water import Medium
from twin.imaging.scene.facets import Heights
from twin.kernels import kernel

PATHS, CORE_RAD = 22, np.deg2rad(2.0)  # paths of equal shares; light turned by less is as good as straight
MOST_TURNED, TURN_STEPS = 0.95 * np.pi, 500  # largest angle t of a path [rad], steps of its table
FEW = 8  # if the floor sees the lamp and none of this number of paths is blocked, no more are tested
SEQUENCE = 1.2207440846057596 ** -np.arange(1.0, 4.0)  # steps of a sequence of low discrepancy in 3 dimensions
BEAM_STEPS = 256  # steps of sqrt(1 - cos(angle from the axis)) from 0 to 1
STEP_TAN = 0.04  # spacing of the pixels that are tested, in focal lengths
#: A hidden share up to LEAST_HIDDEN counts as none, and ends the growing; up to twice as much, twice the excess counts.
MOST_HIDDEN, LEAST_HIDDEN = 0.99, 0.04
#: Light of an open floor that reaches a shadow over two reflections, from the floor and from what hides the lamp
#: (measured by the reference behind a step, a box and a wall of albedo 0.5: 0.015 to 0.03).
REFLECTED = 0.015
ALIKE = 0.05  # relative difference of depths at which the weight of a tested pixel for another one is halved
OTHER_SIDE = 0.02  # factor of this weight if one of the pixels is in the shadow and the other is not
UNRESOLVED_CELLS = 1.5  # distance within which nodes do not resolve the side of an object


class LampHalos:
    """Occlusion of the scattered light of lamps, `sources` of both cameras, in the green band of the water.

    `tops_m` are the heights of the nodes of the floor with the objects on it; None: no objects.
    """

    def __init__(
        self, floor: Heights, sources: list[LightSources], water: Medium, tops_m: NDArray[np.float32] | None = None
    ):
        height = np.ascontiguousarray(floor.height_m if tops_m is None else tops_m, np.float32)
        grid = height, *tops_of(height), floor.west_m, floor.south_m, floor.spacing_m
        near_m = 0.0 if tops_m is None else UNRESOLVED_CELLS * floor.spacing_m
        self._solid, self._sources = (grid, float(height.max()), near_m), sources
        # that of green, unless another colour scatters alone
        band = water.bands[1] if water.scattering_per_m[1] > 0 else water.bands[int(np.argmax(water.scattering_per_m))]
        self._halo = _halo_of(band) if water.scatters_repeatedly else None
        cosine = 1 - np.linspace(0.0, 1.0, BEAM_STEPS + 1) ** 2
        self._beams = np.array([beam_share(cosine, beam) for beam in sources[0].beam])

    def hide(self, lit: Lit, depth: Depth, focal_px: float, world_from_camera: Array, camera: int) -> None:
        """Adds the hidden share of the scattered light of each lamp to its mask in `lit`, see `optics.SceneView`."""
        sources, pose = self._sources[camera], np.ascontiguousarray(world_from_camera)
        n = len(sources.beam)
        if self._halo is None or not n:
            return
        lamps = geometry.transform(pose, sources.position_m), sources.axis @ pose[:3, :3].T, self._beams
        scene = self._solid, depth, focal_px, pose, lamps, self._halo, lit
        in_row_bands(lambda first, end: _hide(*scene, first, end), n, len(depth))


@lru_cache(maxsize=64)
def _halo_of(water: BandWater) -> tuple[Array, Array, Array]:
    """Returns the halo of a lamp at distances `NODES_M`: shares of CORE_RAD, factors REFLECTED, and paths."""
    # The share (nodes,) of the scattered light turned by less than CORE_RAD, the factor (nodes,) by which less light is
    # missing than hidden; paths (nodes, PATHS, 4): direction of the scattering from the floor, its component towards
    # the lamp first, and its distance / that of the lamp.
    weights, turn = lamp_mixture(water, NODES_M, "particle"), np.linspace(CORE_RAD, MOST_TURNED, TURN_STEPS)
    square = (turn / LAMP_SIGMA_RAD[:, None]) ** 2
    beyond = weights @ ((1 + square) * np.exp(-square / 2)) / np.maximum(weights.sum(1, keepdims=True), 1e-300)
    beyond = np.minimum.accumulate(np.minimum(beyond, 1.0), axis=1)
    share, place, azimuth = ((0.5 + np.arange(PATHS)[:, None] * SEQUENCE) % 1.0).T
    turned = np.array([np.interp(-row[0] * (1 - share), -row, turn) for row in beyond])
    at_lamp, azimuth = turned * place, 2 * np.pi * azimuth
    at_floor = turned - at_lamp
    direction = np.cos(at_floor), np.sin(at_floor) * np.cos(azimuth), np.sin(at_floor) * np.sin(azimuth)
    dark = np.maximum(1 - REFLECTED / -np.expm1(-water.scattering_per_m * np.array(NODES_M)), 0.0)
    return 1 - beyond[:, 0], dark, np.stack([*direction, np.sin(at_lamp) / np.sin(turned)], axis=-1)


@kernel(error_model="numpy")
def _hide(solid, depth, focal, pose, lamps, halo, lit, first, end):
    """Adds the hidden share to the masks of the lamps `first` to `end` - 1 in `lit` (lamps, H, W)."""
    height, width = depth.shape
    stride = max(int(np.rint(STEP_TAN * focal)), 2)
    rows, cols = (height - 2) // stride + 2, (width - 2) // stride + 2
    stack = np.empty(12 * rows * cols, np.int32)
    for k in range(first, end):
        lamp = lamps[0][k], lamps[1][k], lamps[2][k]
        hidden, n = np.full((rows, cols), -1.0), _around_shadows(lit[k], stride, rows, cols, stack)
        while n:
            n -= 1
            r, c = stack[n] // cols, stack[n] % cols
            if hidden[r, c] >= 0:
                continue
            v, u = min(r * stride, height - 1), min(c * stride, width - 1)
            hidden[r, c] = 0.0
            if depth[v, u] < np.inf:
                point, dark = point_of(depth, focal, pose, v, u), lit[k, v, u] == 0
                share = min(hidden_share(solid, point, lamp, halo, dark), MOST_HIDDEN)
                hidden[r, c] = max(min(share, 2 * (share - LEAST_HIDDEN)), 0.0)
            if hidden[r, c] > 0:
                for i in range(max(r - 1, 0), min(r + 2, rows)):
                    for j in range(max(c - 1, 0), min(c + 2, cols)):
                        if hidden[i, j] < 0:
                            stack[n], n = i * cols + j, n + 1
        _interpolate(hidden, stride, depth, lit[k])


@kernel
def _around_shadows(lit, stride, rows, cols, stack):
    """Fills `stack` with the numbers of the tested pixels that are the corners of a cell with a shadow."""
    n = 0
    for r in range(rows - 1):
        for c in range(cols - 1):
            if lit[r * stride : (r + 1) * stride + 1, c * stride : (c + 1) * stride + 1].min() == 0:
                first = r * cols + c
                stack[n], stack[n + 1], stack[n + 2], stack[n + 3] = first, first + 1, first + cols, first + cols + 1
                n += 4
    return n


@kernel(error_model="numpy")
def hidden_share(solid, point, lamp, halo, dark):
    """Returns the share (0 to 1) of the scattered light of a lamp that a point of the floor lacks."""
    # `solid`: grid (`Shadows`), highest node, distance of blockers [m]; `lamp`: position [m], axis, beam; `dark`: in
    # shadow
    (position, axis, beam), (core, dark_part, paths) = lamp, halo
    ax, ay, az = position[0] - point[0], position[1] - point[1], position[2] - point[2]
    d = np.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax / d, ay / d, az / d
    slope = _slope(solid[0], point)
    facing = az - ax * slope[0] - ay * slope[1]
    own = facing * _beam_at(beam, -(ax * axis[0] + ay * axis[1] + az * axis[2]))
    if own <= 0:
        return 0.0  # no light of the lamp, in the model of the floor's light
    # two axes across the direction to the lamp (Duff et al. 2017)
    sign = 1.0 if az >= 0 else -1.0
    a = -1 / (sign + az)
    b = ax * ay * a
    node = _nearest_node(d)
    total = core[node] * own
    hidden = total if dark else 0.0
    per_path = (1 - core[node]) / paths.shape[1]
    for k in range(paths.shape[1]):
        if k == FEW and hidden == 0:
            return 0.0
        along, e, f, reach = paths[node, k, 0], paths[node, k, 1], paths[node, k, 2], d * paths[node, k, 3]
        dx = along * ax + e * (1 + sign * ax * ax * a) + f * b
        dy = along * ay + e * sign * b + f * (sign + ay * ay * a)
        dz = along * az - e * sign * ax - f * ay
        to = reach * dx, reach * dy, reach * dz
        x, y, z = d * ax - to[0], d * ay - to[1], d * az - to[2]  # from the scattering to the lamp
        cosine = -(x * axis[0] + y * axis[1] + z * axis[2]) / np.sqrt(x * x + y * y + z * z)
        light = per_path * (dz - dx * slope[0] - dy * slope[1]) * _beam_at(beam, cosine)
        if light > 0:
            total += light
            start = point[0] + to[0], point[1] + to[1], point[2] + to[2]
            if _blocks(solid, point, to, True) or _blocks(solid, start, (x, y, z), False):
                hidden += light
    return hidden / total * dark_part[node]


@kernel(inline="always")
def _slope(grid, point):
    height, _, _, west, south, spacing = grid
    col, row = (point[0] - west) / spacing, (point[1] - south) / spacing
    c, r = min(max(int(col), 0), height.shape[1] - 2), min(max(int(row), 0), height.shape[0] - 2)
    east, north = rises(height[r, c], height[r, c + 1], height[r + 1, c], height[r + 1, c + 1], col - c, row - r)
    return east / spacing, north / spacing


@kernel(inline="always")
def _beam_at(beam, cosine):
    """Returns the relative intensity at the cosine of the angle from the axis; 0 beyond 90 deg."""
    return beam[int(np.sqrt(max(1 - cosine, 0.0)) * (beam.size - 1))] if cosine > 0 else 0.0


@kernel(inline="always")
def _nearest_node(distance_m):
    nearest = 0
    for k in range(len(NODES_M)):
        nearest = k if NODES_M[k] <= distance_m * 1.2 else nearest
    return nearest


@kernel(error_model="numpy")
def _blocks(solid, start, to, from_floor):
    """Returns whether the floor blocks the way from `start` to `start` + `to` [m]."""
    (height, cell_tops, block_tops, west, south, spacing), highest, near = solid
    x, y, z = start
    first = near / max(np.sqrt(to[0] * to[0] + to[1] * to[1]), 1e-9) if from_floor else 0.0
    last = min((highest - z) / to[2], 1.0) if to[2] > 0 else 1.0
    if first >= last or (z > highest and z + to[2] > highest):
        return False
    col, row = (x + first * to[0] - west) / spacing, (y + first * to[1] - south) / spacing
    part = last - first
    way = part * to[0] / spacing, part * to[1] / spacing, part * to[2]
    return occluded(height, cell_tops, block_tops, col, row, z + first * to[2], *way)


@kernel(error_model="numpy")
def _interpolate(hidden, stride, depth, lit):
    """Adds the hidden share of tested pixels to all: weighted means of the four around each."""
    # bilinear weights times nearness in depth; those in the same light or shadow count most
    rows, cols = hidden.shape
    height, width = depth.shape
    for r in range(rows - 1):
        for c in range(cols - 1):
            if max(hidden[r, c], hidden[r, c + 1], hidden[r + 1, c], hidden[r + 1, c + 1]) <= 0:
                continue
            top, left = r * stride, c * stride
            bottom, right = min(top + stride, height - 1), min(left + stride, width - 1)
            for v in range(top, bottom + (r == rows - 2)):
                for u in range(left, right + (c == cols - 2)):
                    down, across = (v - top) / (bottom - top), (u - left) / (right - left)
                    total = found = 0.0
                    for i in range(2):
                        for j in range(2):
                            y, x = bottom if i else top, right if j else left
                            weight = (down if i else 1 - down) * (across if j else 1 - across) + 1e-6
                            weight /= ALIKE + abs(depth[y, x] / depth[v, u] - 1)
                            weight *= 1.0 if (lit[y, x] ^ lit[v, u]) & 1 == 0 else OTHER_SIDE
                            if depth[y, x] < np.inf:
                                total += weight
                                found += weight * max(hidden[r + i, c + j], 0.0)
                    if total > 0:
                        lit[v, u] |= np.uint8(2 * int(np.rint(HIDDEN_STEPS * found / total)))
