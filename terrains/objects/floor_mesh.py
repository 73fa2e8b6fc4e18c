"""A mesh as the whole sea floor: turned upwards, centred, and divided into tiles that are drawn like objects.

Only tiles in view are drawn. All levels of detail of a tile have its full geometry, so there are no cracks between
tiles; the coarser levels have smoother colours, which filters the colours of vertices as a mip map filters a texture.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.terrains.objects.coloured_mesh import Mesh, median_edge_m
from twin.terrains.objects.detail import cell_colours, level_of
from twin.terrains.objects.mesh_file import MAX_FACES, TexturedMesh
from twin.terrains.objects.placed_object import PlacedObject, model_with
from twin.terrains.objects.texture_pyramid import Textures, textures_of

TILE_M = 1.0  #: side of a tile; larger if there were more than MAX_TILES tiles
MAX_TILES = 4000
LONGEST_EDGE_M = 0.5  #: longer edges are halved; for a mesh larger than 200 m, those longer than a 400th of it
MAX_DIVIDED = 2 * MAX_FACES  #: largest number of triangles after long edges have been halved
LARGEST_CELL_M = 0.1  #: largest side of the cells over which the colours of vertices are averaged
NO_GROUP = -1  #: `PlacedObject.group` of a tile


class FloorTile(NamedTuple):
    placed: PlacedObject  #: the triangles as an object
    texture: int  #: number of its texture in `FloorTiles.textures`; -1: the colours of the vertices
    uv: NDArray[np.float32]  #: (n, 3) texture coordinates of its vertices (across, down), and side of a texel there [m]


class FloorTiles(NamedTuple):
    tiles: tuple[FloorTile, ...]
    textures: Textures


def levelled(read: TexturedMesh, scale: float) -> TexturedMesh:
    """Returns a mesh [m] centred at x = y = 0; turned over if its volume is negative or most of a sheet faces down."""
    vertices, faces = read.mesh.vertices_m.astype(np.float64) * scale, read.mesh.faces
    a, b, c = np.moveaxis(vertices[faces] - vertices.mean(axis=0), 1, 0)
    up_m2 = _upward_m2(vertices, faces)
    area_m2, volume_m3 = float(up_m2.sum()), float(np.einsum("ij,ij->", a, np.cross(b, c)))
    is_sheet = abs(area_m2) > 0.01 * np.abs(up_m2).sum()
    if (area_m2 if is_sheet else volume_m3) < 0:
        faces = faces[:, ::-1]
    vertices -= (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    mesh = Mesh(vertices.astype(np.float32), np.ascontiguousarray(faces, np.int32), read.mesh.colours)
    return read._replace(mesh=mesh)


def divided(whole: TexturedMesh) -> TexturedMesh:
    """Returns a mesh whose long edges are halved until none is longer than allowed, without cracks.

    The limit is LONGEST_EDGE_M, or a 400th of the largest extent if that is longer: the rasterizer leaves out a
    triangle with a corner behind the camera. Raises ValueError if more than MAX_DIVIDED triangles would be needed.
    """
    longest_m = max(LONGEST_EDGE_M, float(np.ptp(whole.mesh.vertices_m, axis=0).max()) / 400)
    while True:
        faces = whole.mesh.faces
        corners = whole.mesh.vertices_m[faces].astype(np.float64)
        long = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2) > longest_m
        if not long.any():
            return whole
        if len(faces) + int(long.sum()) > MAX_DIVIDED:
            raise ValueError(f"has long triangles that make more than {MAX_DIVIDED} when divided")
        whole = _halved(whole, long)


def _halved(whole: TexturedMesh, long: NDArray[np.bool_]) -> TexturedMesh:
    """Returns a mesh with the marked edges (m, 3) halved; edge k of a triangle joins its corners k and k + 1."""
    mesh, n = whole.mesh, len(whole.mesh.vertices_m)
    ends = np.sort(np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], axis=2)[long], axis=1)
    pairs, number = np.unique(ends, axis=0, return_inverse=True)
    middle = np.full(long.shape, -1, np.int64)
    middle[long] = n + number.ravel()
    # turned so that the triangles with one halved edge have it first, those with two have them first and second
    count = long.sum(axis=1)
    first = np.where(count == 1, long.argmax(axis=1), np.where(count == 2, (long.argmin(axis=1) + 1) % 3, 0))
    turn = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(mesh.faces.astype(np.int64), turn, axis=1).T
    ab, bc, ca = np.take_along_axis(middle, turn, axis=1).T
    pieces = {
        0: [(a, b, c)],
        1: [(a, ab, c), (ab, b, c)],
        2: [(a, ab, c), (ab, bc, c), (ab, b, bc)],
        3: [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)],
    }
    parts = [(np.stack(piece, axis=1)[count == k], whole.texture[count == k]) for k in pieces for piece in pieces[k]]
    positions = mesh.vertices_m[pairs].mean(axis=1, dtype=np.float64)
    colours = np.rint(mesh.colours[pairs].mean(axis=1))
    return TexturedMesh(
        Mesh(
            np.concatenate([mesh.vertices_m, positions.astype(np.float32)]),
            np.concatenate([faces for faces, _ in parts]).astype(np.int32),
            np.concatenate([mesh.colours, colours.astype(np.uint8)]),
        ),
        np.concatenate([whole.uv, whole.uv[pairs].mean(axis=1)]),
        np.concatenate([texture for _, texture in parts]),
        whole.images,
    )


def raised(whole: TexturedMesh, height_m: float) -> TexturedMesh:
    vertices = whole.mesh.vertices_m + np.array([0, 0, height_m], np.float32)
    return whole._replace(mesh=whole.mesh._replace(vertices_m=vertices))


def upward_part(mesh: Mesh) -> Mesh:
    return mesh._replace(faces=mesh.faces[_upward_m2(mesh.vertices_m.astype(np.float64), mesh.faces) > 0])


def downward_part(mesh: Mesh) -> Mesh:
    return mesh._replace(faces=mesh.faces[_upward_m2(mesh.vertices_m.astype(np.float64), mesh.faces) < 0])


def tiles_of(whole: TexturedMesh) -> FloorTiles:
    """Returns a mesh floor in square tiles by the centres of the triangles, separate ones for each texture."""
    mesh, texture = whole.mesh, whole.texture
    centres = mesh.vertices_m[mesh.faces].mean(axis=1)[:, :2]
    side_m = TILE_M
    while True:
        column, row = np.floor((centres - centres.min(axis=0)) / side_m).astype(np.int64).T
        keys, tile = np.unique(np.stack([texture, row, column], axis=1), axis=0, return_inverse=True)
        if len(keys) <= MAX_TILES or (keys[:, 1:] == 0).all():
            break
        side_m *= 1.5
    uv, colours = _texture_places(whole), _colour_levels(whole)
    order = np.argsort(tile.ravel(), kind="stable")
    parts = np.split(order, np.cumsum(np.bincount(tile.ravel()))[:-1])
    tiles = tuple(_tile(mesh, part, uv, colours, int(key[0])) for part, key in zip(parts, keys, strict=True))
    return FloorTiles(tiles, textures_of(whole.images))


def _tile(
    mesh: Mesh, part: NDArray[np.int64], uv: NDArray[np.float32], colours: list[tuple[NDArray[np.uint8], float]],
    texture: int,
) -> FloorTile:  # fmt: skip
    used, faces = np.unique(mesh.faces[part], return_inverse=True)
    kept = colours if texture < 0 else colours[:1]
    faces = np.ascontiguousarray(faces.reshape(-1, 3), np.int32)
    full = level_of(Mesh(mesh.vertices_m[used], faces, kept[0][0][used]), 0.0)
    levels = tuple(full._replace(mesh=full.mesh._replace(colours=values[used]), cell_m=side) for values, side in kept)
    return FloorTile(PlacedObject(model_with(levels), np.eye(4), 1.0, NO_GROUP), texture, uv[used])


def _texture_places(whole: TexturedMesh) -> NDArray[np.float32]:
    """Returns (n, 3): texture coordinates of the vertices, from the upper left, and side of a texel there [m]."""
    # root of the ratio of the areas of a triangle on the floor and in the texture; the mean at a vertex
    mesh, n = whole.mesh, len(whole.mesh.vertices_m)
    corners, places = mesh.vertices_m[mesh.faces].astype(np.float64), whole.uv[mesh.faces].astype(np.float64)
    floor_m2 = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    first, second = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
    texels = np.array([image.shape[0] * image.shape[1] for image in whole.images] or [0.0], np.float64)
    area = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) * texels[whole.texture]
    side_m = np.sqrt(floor_m2 / np.maximum(area, 1e-12))
    total = np.bincount(mesh.faces.ravel(), np.repeat(side_m, 3), n)
    count = np.bincount(mesh.faces.ravel(), minlength=n)
    u, v = whole.uv.T
    return np.stack([u, 1 - v, total / np.maximum(count, 1)], axis=1).astype(np.float32)


def _colour_levels(whole: TexturedMesh) -> list[tuple[NDArray[np.uint8], float]]:
    """Returns colours (n, 3) of the vertices, each with its side of averaging [m]; one if all have a texture."""
    mesh = whole.mesh
    levels, cell_m = [(mesh.colours, 0.0)], np.inf if (whole.texture >= 0).all() else median_edge_m(mesh)
    while cell_m <= LARGEST_CELL_M:
        levels.append((cell_colours(mesh, cell_m), cell_m))
        cell_m *= np.sqrt(2)
    return levels


def _upward_m2(vertices: Array, faces: NDArray[np.int32]) -> Array:
    """Returns twice the area (m,) of the triangles projected onto a level plane; negative where they face down [m2]."""
    a, b, c = np.moveaxis(vertices[faces][:, :, :2], 1, 0)
    return (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
