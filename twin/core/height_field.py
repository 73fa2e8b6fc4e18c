"""Floor as heights on a regular grid, whose cells are split along the diagonal from south-west to north-east."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.records import MapGrid, StereoRig
from twin.kernels import kernel

#: Columns of the grid of rays. A cell that the edge of the second image cuts is weighted by its fraction inside; the
#: error of an overlap is therefore far smaller than the share of one cell.
RAY_COLUMNS = 24
_BEAM_RINGS, _BEAM_RAYS = 2, 8  # rays of the altimeter's beam: one on its axis, and rings around it
#: A floor point is occluded if its ray meets the floor earlier by more than this fraction of its range.
HIDDEN_BEFORE = 1e-3


class HeightField(NamedTuple):
    """Floor as a triangulated height grid. There is no floor in cells with a NaN corner and outside the grid."""

    height_m: Array  #: (ny, nx) heights of the nodes, row 0 = south, column 0 = west
    spacing_m: float  #: distance between neighbouring nodes
    #: west_m, south_m: position of node (0, 0).
    west_m: float
    south_m: float
    #: lowest_m, highest_m: height of the lowest and of the highest node.
    lowest_m: float
    highest_m: float


def height_field(height_m: NDArray[np.floating], spacing_m: float, west_m: float, south_m: float) -> HeightField:
    """Returns the height field with node heights (ny, nx) [m]: at least 2 x 2 nodes, at least one of them finite."""
    height = np.ascontiguousarray(height_m, np.float64)
    lowest_m, highest_m = float(np.nanmin(height)), float(np.nanmax(height))
    return HeightField(height, float(spacing_m), float(west_m), float(south_m), lowest_m, highest_m)


def map_height_field(height_m: NDArray[np.floating], grid: MapGrid) -> HeightField:
    """Returns the height field of a map with heights (rows, cols) [m]; its nodes are the centres of the cells."""
    south_m = grid.north_m - (grid.rows - 0.5) * grid.cell_m
    return height_field(height_m[::-1], grid.cell_m, grid.west_m + grid.cell_m / 2, south_m)


def ray_grid(rig: StereoRig, n_columns: int) -> Array:
    """Returns the centres (n, 2) [px] of equal, nearly square cells that tile an image, with `n_columns` columns."""
    n_rows = max(1, round(n_columns * rig.height_px / rig.width_px))
    u = (np.arange(n_columns) + 0.5) * rig.width_px / n_columns - 0.5
    v = (np.arange(n_rows) + 0.5) * rig.height_px / n_rows - 0.5
    return np.stack([part.ravel() for part in np.meshgrid(u, v)], axis=1)


def cast_pixels(field: HeightField, poses: Array, rig: StereoRig, pixels: Array) -> Array:
    """Returns the depth (n, m) of the floor along the optical axis [m] at pixels (m, 2) of n images; inf: none."""
    return _cast_directions(field, np.ascontiguousarray(poses, np.float64), rig.normalised(pixels))


@kernel
def _cast_directions(field, poses, directions):
    depth = np.empty((len(poses), len(directions)))
    for i in range(len(poses)):
        for k in range(len(directions)):
            depth[i, k] = cast_camera_ray(field, poses[i], directions[k, 0], directions[k, 1])
    return depth


@kernel(allocates=False)
def cast_camera_ray(field, pose, a, b):
    """Returns the depth at which the ray through the normalised point (a, b) meets the floor; inf if it does not."""
    dx = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2]
    dy = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2]
    dz = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2]
    return cast_ray(field, pose[0, 3], pose[1, 3], pose[2, 3], dx, dy, dz)


def nearest_echo_m(field: HeightField, world_from_camera: Array, beam_deg: float) -> float:
    """Returns the distance to the nearest of the points where rays of a beam around the optical axis meet the floor."""
    radii = np.tan(np.deg2rad(beam_deg / 2)) * np.arange(_BEAM_RINGS + 1) / _BEAM_RINGS
    angles = np.arange(_BEAM_RAYS) * (2 * np.pi / _BEAM_RAYS)
    rays = np.stack([np.outer(radii, np.cos(angles)).ravel(), np.outer(radii, np.sin(angles)).ravel()], axis=1)
    depths = [cast_camera_ray(field, world_from_camera, a, b) for a, b in rays.tolist()]
    return float(np.min(np.array(depths) * np.sqrt(1 + (rays**2).sum(axis=1))))


@kernel(allocates=False)
def cast_ray(field, ox, oy, oz, dx, dy, dz):
    """Returns the smallest t >= 0 at which the ray o + t d meets the floor; 0 if o lies below the floor.

    Cell by cell (Amanatides & Woo 1987) between the highest and the lowest node. inf if the ray starts outside the
    grid, leaves it or enters a cell without floor first.
    """
    dz = dz if dz != 0 else 1e-12
    rows, cols = field.height_m.shape
    t = max(0.0, (field.highest_m - oz) / dz) if dz < 0 else 0.0
    t_last = ((field.lowest_m if dz < 0 else field.highest_m) - oz) / dz + 1e-9
    col, col_rate = (ox - field.west_m) / field.spacing_m, dx / field.spacing_m
    row, row_rate = (oy - field.south_m) / field.spacing_m, dy / field.spacing_m
    c, r = int(np.floor(col + t * col_rate)), int(np.floor(row + t * row_rate))
    if c == cols - 1 and col + t * col_rate <= cols - 1:
        c -= 1
    if r == rows - 1 and row + t * row_rate <= rows - 1:
        r -= 1
    while 0 <= c < cols - 1 and 0 <= r < rows - 1:
        t_col = (c + (col_rate > 0) - col) / col_rate if col_rate != 0 else np.inf
        t_row = (r + (row_rate > 0) - row) / row_rate if row_rate != 0 else np.inf
        end = max(t, min(t_col, t_row, t_last))
        met = _meet_cell(field.height_m, r, c, col - c, row - r, oz, col_rate, row_rate, dz, t, end)
        if not met > end:  # a hit, or NaN: a corner without height
            return np.inf if np.isnan(met) else met
        if end >= t_last:
            return np.inf
        t = end
        if t_col <= t_row:
            c += 1 if col_rate > 0 else -1
        else:
            r += 1 if row_rate > 0 else -1
    return np.inf


@kernel(allocates=False)
def _meet_cell(height, r, c, u0, v0, z0, u_rate, v_rate, z_rate, start, end):
    """Returns the least t in [start, end] where a ray meets the floor of a cell; else inf, NaN if a corner is NaN."""
    # The ray is (u0, v0, z0) + t (u_rate, v_rate, z_rate), with u (east) and v (north) from 0 to 1 over the cell.
    h00, h01, h10, h11 = height[r, c], height[r, c + 1], height[r + 1, c], height[r + 1, c + 1]
    top = max(max(h00, h01), max(h10, h11))
    if np.isnan(h00 + h01 + h10 + h11):
        return np.nan
    if z0 + (end if z_rate < 0 else start) * z_rate > top:
        return np.inf
    side_rate = u_rate - v_rate  # the diagonal is u = v
    middle = (v0 - u0) / side_rate if side_rate != 0 else end
    middle = min(max(middle, start), end)
    for part in range(2):
        a, b = (start, middle) if part == 0 else (middle, end)
        t = (a + b) / 2
        du, dv = rises(h00, h01, h10, h11, u0 + t * u_rate, v0 + t * v_rate)
        gap_a = z0 + a * z_rate - (h00 + (u0 + a * u_rate) * du + (v0 + a * v_rate) * dv)
        gap_b = z0 + b * z_rate - (h00 + (u0 + b * u_rate) * du + (v0 + b * v_rate) * dv)
        if gap_a <= 0:
            return a
        if gap_b <= 0:
            return a + (b - a) * gap_a / (gap_a - gap_b)
    return np.inf


def grid_triangles(vertices: NDArray[Any]) -> NDArray[Any]:
    """Returns the triangles (2 (rows - 1) (cols - 1), 3) of a grid, counter-clockwise from above, cell by cell.

    Rows of the vertex numbers (rows, cols) run from south to north, columns from west to east.
    """
    sw, se, ne, nw = vertices[:-1, :-1], vertices[:-1, 1:], vertices[1:, 1:], vertices[1:, :-1]
    return np.stack([sw, se, ne, sw, ne, nw], axis=-1).reshape(-1, 3)


def raster_triangles(valid: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Returns triangles (n, 3), counter-clockwise from above: indices of valid cells, row by row from the north."""
    cells = np.arange(valid.size).reshape(valid.shape)
    triangles = grid_triangles(cells[::-1])
    return triangles[valid.reshape(-1)[triangles].all(axis=1)]


@kernel(allocates=False)
def rises(south_west, south_east, north_west, north_east, east_part, north_part):
    """Returns the rise over a cell towards east and north of its triangle at a point, given as parts of the cell."""
    lower = east_part >= north_part
    east = south_east - south_west if lower else north_east - north_west
    return east, north_east - south_east if lower else north_west - south_west


def map_slopes(height_m: Array, cell_m: float) -> tuple[Array, Array]:
    """Returns the slopes of a map, row 0 = north, to east and north, each (rows, cols); 0 along an axis of one cell."""
    south, east = (
        np.gradient(height_m, cell_m, axis=axis) if height_m.shape[axis] > 1 else np.zeros_like(height_m)
        for axis in (0, 1)
    )
    return np.asarray(east, np.float64), -np.asarray(south, np.float64)


def image_overlap(field: HeightField, first: Array, second: Array, rig: StereoRig) -> Array:
    """Returns the overlap (n,) of pairs of images: the share of the floor in the first that the second shows too.

    The floor at each cell of a grid over the first image is weighted by the part of the cell that projects into the
    second, 0 if occluded. NaN if no cell shows floor. Poses (n, 4, 4) are world_from_camera.
    """
    pixels = ray_grid(rig, RAY_COLUMNS)
    cell = rig.width_px / RAY_COLUMNS, rig.height_px / (len(pixels) // RAY_COLUMNS)
    camera = (rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px, float(rig.width_px), float(rig.height_px))
    first, second = (np.ascontiguousarray(p, np.float64).reshape(-1, 4, 4) for p in (first, second))
    return _overlaps(field, first, second, camera, rig.normalised(pixels), cell)


@kernel
def _overlaps(field, first, second, camera, directions, cell):
    result = np.empty(len(first))
    for i in range(len(first)):
        pose, shared, count = first[i], 0.0, 0
        for k in range(len(directions)):
            a, b = directions[k, 0], directions[k, 1]
            depth = cast_camera_ray(field, pose, a, b)
            if depth < np.inf:
                count += 1
                x = pose[0, 3] + depth * (pose[0, 0] * a + pose[0, 1] * b + pose[0, 2])
                y = pose[1, 3] + depth * (pose[1, 0] * a + pose[1, 1] * b + pose[1, 2])
                z = pose[2, 3] + depth * (pose[2, 0] * a + pose[2, 1] * b + pose[2, 2])
                shared += _share_seen(field, second[i], camera, cell, x, y, z, depth)
        result[i] = shared / count if count else np.nan
    return result


@kernel(allocates=False)
def _share_seen(field, pose, camera, cell, x, y, z, depth):
    """Returns the share (0 to 1) of a cell [px] of the first image, at (x, y, z), that the second camera sees."""
    # `camera` is fx, fy, cx, cy, width and height; `depth` is that of the centre in the first camera [m]
    fx, fy, cx, cy, width, height = camera
    dx, dy, dz = x - pose[0, 3], y - pose[1, 3], z - pose[2, 3]
    depth2 = pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz
    if depth2 <= 0 or depth <= 0:
        return 0.0
    u = fx * (pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz) / depth2 + cx + 0.5
    v = fy * (pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz) / depth2 + cy + 0.5
    scale = depth / depth2
    in_u = min(max(min(u, width - u) / (scale * cell[0]) + 0.5, 0.0), 1.0)
    in_v = min(max(min(v, height - v) / (scale * cell[1]) + 0.5, 0.0), 1.0)
    if in_u * in_v == 0:
        return 0.0
    seen = cast_ray(field, pose[0, 3], pose[1, 3], pose[2, 3], dx, dy, dz) >= 1 - HIDDEN_BEFORE
    return in_u * in_v if seen else 0.0
