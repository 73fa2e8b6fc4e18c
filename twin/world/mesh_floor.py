"""Sea floor that is a mesh, e.g. a photogrammetric model: its tiles, and its surface as seen from above.

Plan, clearance, placed objects and the surrogate use a height grid of its highest surface; the truth of the map is the
highest surface at each cell. Below the rendered tiles lies a height grid of the lowest surface that faces up, lowered
so that it is seen only through holes of the mesh; holes have the height and the colour of the nearest node of the mesh.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, minimum_filter

from twin import terrains
from twin.core.records import Array, Image, MapGrid
from twin.errors import TwinError
from twin.imaging.scene.mesh_raster import DrawnMesh, Target, draw_meshes
from twin.imaging.scene.object_shadows import FROM_ABOVE
from twin.imaging.scene.object_view import Objects, draw_objects
from twin.scenario.model import Scenario, TerrainConfig
from twin.terrains.holes import known_nodes
from twin.terrains.objects.coloured_mesh import Mesh, extent, median_edge_m
from twin.terrains.objects.floor_mesh import FloorTiles, divided, downward_part, levelled, raised, tiles_of, upward_part
from twin.terrains.objects.mesh_file import TexturedMesh, read_textured_mesh
from twin.terrains.terrain import InputStatement, texture_shape
from twin.terrains.vertical_axis import ASSUMED
from twin.world.top_surface import FROM_BELOW, OVERHANG_M, Layer, TopSurface, row_blocks, true_heights, view_from_above

FIELD = "terrain.mesh_file"
_COVERING = "a mesh that covers the planned area"
FINEST_GRID_M = 0.005  #: least spacing of the height grid
MOST_NODES = 2_000_000  #: most nodes of the height grid; its spacing exceeds `terrain.grid_m` if necessary
MARGIN_M = 0.005  #: distance by which the height grid below the mesh is lowered


class MeshFloor(NamedTuple):
    terrain: terrains.Terrain  #: height grid of the highest surface, with its colours as texture
    under: terrains.Terrain  #: height grid below the mesh; it is rendered together with the mesh
    tiles: FloorTiles  #: the mesh, divided into tiles


def load_mesh_floor(scenario: Scenario) -> MeshFloor:
    """Reads the mesh floor of a scenario and computes its height grids; raises TwinError if it is unusable."""
    t = scenario.terrain
    assert t.mesh_file is not None  # `scenario_checks.floor_contradictions`
    file = Path(t.mesh_file)
    y_up = t.mesh_up == "y" or (t.mesh_up is None and file.suffix.lower() == ".glb")
    read = read_textured_mesh(file, FIELD, y_up)
    whole = _divided(levelled(read, t.mesh_scale), file)
    grid = _node_grid(whole.mesh, t.grid_m, file)
    top = -_depth([whole.mesh], grid, FROM_ABOVE)
    covered = np.isfinite(top)
    if not covered.any():
        raise TwinError(FIELD, f"{file.name!r} has no surface that faces up", _COVERING)
    lowest_m = top[covered].min()
    whole, top = raised(whole, -lowest_m), top - lowest_m
    upward = upward_part(whole.mesh)
    tiles = tiles_of(whole)
    rows, cols = distance_transform_edt(~covered, return_distances=False, return_indices=True)  # pyright: ignore
    drawn, nearest = Objects((), floor=tiles), (rows, cols)
    top_m = top[nearest]
    colours = _colours(drawn, grid, grid.cell_m)[0][nearest]
    low = _lowest(upward, grid)
    under_m = np.asarray(minimum_filter(np.where(np.isfinite(low), low, top_m), 3) - MARGIN_M, np.float32)
    texture = _texture(drawn, grid, colours, scenario)
    terrain = replace(_terrain(top_m, grid, texture, covered), stated=_stated(read, t, grid.cell_m, covered))
    return MeshFloor(terrain, _terrain(under_m, grid, colours, covered), tiles)


def _stated(read: TexturedMesh, t: TerrainConfig, spacing_m: float, covered: NDArray[np.bool_]) -> InputStatement:
    heights, up = read.mesh.vertices_m[:, 2], "by the format of the file" if t.mesh_up is None else "terrain.mesh_up"
    return InputStatement(
        Path(t.mesh_file or "").name, "", None, spacing_m, "edges of the mesh, terrain.grid_m", t.mesh_scale,
        "terrain.mesh_scale" if "mesh_scale" in t.model_fields_set else ASSUMED, "up", up, float(heights.min()),
        float(heights.max()), "", float(1 - covered.mean()), f"{len(read.images) or 'no'} textures of the mesh",
    )  # fmt: skip


def floor_surface(floor: MeshFloor, grid: MapGrid) -> TopSurface:
    """Returns the highest surface of a mesh floor at the cell centres of a grid; in its holes, that of `floor.under`.

    A cell is overhung if the highest surface that faces down lies more than OVERHANG_M above the lowest that faces up.
    """
    meshes = [tile.placed.model.levels[0].mesh for tile in floor.tiles.tiles]
    top = -_depth(meshes, grid, FROM_ABOVE)
    low = _depth([upward_part(mesh) for mesh in meshes], grid, FROM_BELOW)
    roof = -_depth([downward_part(mesh) for mesh in meshes], grid, FROM_ABOVE)
    under = true_heights(grid, floor.under.height_at)
    return TopSurface(np.where(np.isfinite(top), top, under), overhung=roof - low > OVERHANG_M)


def _divided(whole: TexturedMesh, file: Path) -> TexturedMesh:
    if not np.isfinite(extent(whole.mesh)).all():
        raise TwinError(FIELD, f"{file.name!r} is too large", _COVERING)
    try:
        return divided(whole)
    except ValueError as error:
        raise TwinError(FIELD, f"{file.name!r} {error}", "triangles of similar width and length") from None


def _node_grid(mesh: Mesh, coarsest_m: float, file: Path) -> MapGrid:
    """Returns the grid whose cell centres are the nodes of the height grid, centred at the origin as the mesh is."""
    # spacing: the median edge length, at least FINEST_GRID_M, at most `coarsest_m`, or as MOST_NODES requires
    low, high = extent(mesh)
    size = (high - low)[:2]
    wanted_m = min(max(median_edge_m(mesh), FINEST_GRID_M), coarsest_m)
    step_m = max(wanted_m, float(np.sqrt(size.prod() / MOST_NODES)), float(size.max()) / MOST_NODES)
    n = np.floor(size / step_m + 1e-3).astype(int) + 1  # an extent of single precision may be too small
    if n.min() < 2:
        raise TwinError(FIELD, f"{file.name!r} covers {size[0]:.3g} m x {size[1]:.3g} m", _COVERING)
    step_m = min(step_m, float((size / (n - 1)).min()) * (1 - 1e-6))  # rays along the border might pass by the mesh
    west_m, north_m = -(n[0] - 1) * step_m / 2, (n[1] - 1) * step_m / 2
    return MapGrid(west_m - step_m / 2, north_m + step_m / 2, step_m, int(n[1]), int(n[0]))


def _depth(meshes: Sequence[Mesh], grid: MapGrid, axes: Array) -> Layer:
    """Returns the depth (rows, cols) at which vertical rays through the cell centres first meet meshes; inf: never."""
    depth = np.full((grid.rows, grid.cols), np.inf, np.float32)
    draw_meshes([DrawnMesh(mesh, axes) for mesh in meshes], view_from_above(grid), Target(depth))
    return depth


def _lowest(upward: Mesh, grid: MapGrid) -> Layer:
    """Returns the least height (rows, cols) of the surfaces that face up, at the centre and the vertices in a cell."""
    low = _depth([upward], grid, FROM_BELOW)
    x, y, z = upward.vertices_m[np.unique(upward.faces)].T
    col, row = (x - grid.west_m) / grid.cell_m, (grid.north_m - y) / grid.cell_m
    cells = np.clip(row, 0, grid.rows - 1).astype(np.int64), np.clip(col, 0, grid.cols - 1).astype(np.int64)
    np.minimum.at(low, cells, z)
    return low


def _colours(drawn: Objects, grid: MapGrid, row_m: float) -> tuple[Image, NDArray[np.bool_]]:
    """Returns the colours (rows, cols, 3) of the mesh from above, and whether each cell (rows, cols) shows the mesh."""
    stretch = grid.cell_m / row_m
    axes = np.diag([1.0, stretch, 1.0, 1.0]) @ FROM_ABOVE
    colours, seen = np.zeros((grid.rows, grid.cols, 3), np.uint8), np.zeros((grid.rows, grid.cols), np.bool_)
    square = replace(grid, north_m=grid.north_m * stretch)
    for rows in row_blocks(grid):
        shape = rows.stop - rows.start, grid.cols
        normal, uv = (np.empty((*shape, 3), np.float32) for _ in range(2))
        label = np.zeros(shape, np.uint16)
        target = Target(np.full(shape, np.inf, np.float32), colours[rows], normal, label, uv)
        view = view_from_above(square, rows.start)
        draw_objects(drawn, target, axes, view)
        seen[rows] = label > 0
    return colours, seen


def _texture(drawn: Objects, grid: MapGrid, colours: Image, scenario: Scenario) -> Image:
    """Returns the texture (h, w, 3) of the highest surface, between the outermost nodes of the height grid."""
    t, ny, nx = scenario.terrain, grid.rows, grid.cols
    size_m = (nx - 1) * grid.cell_m, (ny - 1) * grid.cell_m
    texel_m = terrains.TextureSource(scenario.texel_m, coarsen=t.texture_px_m is None).texel_m(size_m)
    rows, cols = texture_shape((ny, nx), grid.cell_m, texel_m)
    west_m, north_m = grid.west_m + grid.cell_m / 2, grid.north_m - grid.cell_m / 2
    texels = MapGrid(west_m, north_m, size_m[0] / cols, rows, cols)
    texture, seen = _colours(drawn, texels, size_m[1] / rows)
    row, col = np.nonzero(~seen)
    node_row, node_col = (row + 0.5) / rows * (ny - 1), (col + 0.5) / cols * (nx - 1)
    texture[row, col] = colours[np.rint(node_row).astype(int), np.rint(node_col).astype(int)]
    return texture


def _terrain(height_m: Layer, grid: MapGrid, texture: Image, covered: NDArray[np.bool_]) -> terrains.Terrain:
    west_m, south_m = grid.west_m + grid.cell_m / 2, grid.north_m - (grid.rows - 0.5) * grid.cell_m
    heights = np.ascontiguousarray(height_m[::-1], np.float32)
    texel_m = (grid.cols - 1) * grid.cell_m / texture.shape[1]
    return terrains.Terrain(
        heights, grid.cell_m, west_m, south_m, np.ascontiguousarray(texture), texel_m,
        None if covered.all() else ~covered[::-1], known=known_nodes(covered[::-1]),
    )  # fmt: skip
