"""Meshes from files: PLY, OBJ and GLB, with the colours of their vertices or their texture."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.user_files import IMAGE_FORMATS, reading
from twin.errors import TwinError
from twin.terrains.file_header import eight_bits
from twin.terrains.objects.mesh import Mesh, joined, welded_faces
from twin.terrains.objects.mesh_header import FORMATS, face_count

MAX_FACES = 2_000_000  #: a mesh takes about 100 bytes per triangle, with its levels of detail
MAX_BYTES = 500_000_000  #: size of the largest file that is read
MAX_TEXELS = 250_000_000  #: largest number of texels of all textures of a floor together
TEXTURED_FACES = 200_000  #: largest number of triangles of a divided mesh, whose corners sample the texture


def read_mesh(file: Path, field: str, albedo: tuple[float, float, float], y_up: bool = False) -> Mesh:
    """Returns the mesh of a file, in the unit of the file; a mesh far from the origin is moved to it.

    A mesh may be open, as photogrammetric models are, but no edge may belong to more than two triangles. A texture is
    sampled at the vertices, after the triangles have been divided.

    Args:
        file: path of a PLY, OBJ or GLB file.
        field: scenario key of the file, for error messages.
        albedo: albedo of a mesh without colours, 0 to 1.
        y_up: whether y of the file points up, instead of z.
    Raises:
        TwinError: the file is missing, unreadable, too large, or is a mesh without triangles, without extent or not
            manifold.
    """
    parts = _read(
        file, field, lambda loaded: [_coloured(part, albedo, TEXTURED_FACES // len(loaded)) for part in loaded]
    )
    mesh = _joined([part for part in parts if len(part.faces)])
    _check(mesh, file, field)
    return _upright(mesh, y_up)


class TexturedMesh(NamedTuple):
    """Mesh whose triangles have the colours of textures or of their vertices.

    Args:
        mesh: triangles, with the colours of their vertices; a vertex without a colour is white.
        uv: (n, 2) float32 texture coordinates of the vertices, which increase to the right and upwards; textures repeat
            beyond 0 to 1.
        texture: (m,) int32 number, from 0, of the texture of each triangle; -1: the colours of its vertices.
        images: the textures, (h, w, 3) uint8 each.
    """

    mesh: Mesh
    uv: NDArray[np.float32]
    texture: NDArray[np.int32]
    images: tuple[NDArray[np.uint8], ...]


def read_textured_mesh(file: Path, field: str, y_up: bool = False) -> TexturedMesh:
    """Returns the mesh of a file with its textures, in the unit of the file; a mesh far from the origin is moved to it.

    Args:
        file: path of a PLY, OBJ or GLB file.
        field: scenario key of the file, for error messages.
        y_up: whether y of the file points up, instead of z.
    Raises:
        TwinError: the file is missing, unreadable, too large, or is a mesh without triangles, without extent, not
            manifold or without colours.
    """
    parts = [part for part in _read(file, field, lambda loaded: [_part(p) for p in loaded]) if len(part.mesh.faces)]
    mesh = _joined([part.mesh for part in parts])
    _check(mesh, file, field)
    if not any(part.coloured for part in parts):
        raise TwinError(field, f"{file.name!r} has no colours", "a mesh with a texture or with colours of its vertices")
    images, numbers = [], []
    for part in parts:
        number = -1
        if part.image is not None:
            number = next((k for k, image in enumerate(images) if image is part.image), len(images))
            images += [part.image] if number == len(images) else []
        numbers.append(np.full(len(part.mesh.faces), number, np.int32))
    n_texels = sum(image.size[0] * image.size[1] for image in images)
    if n_texels > MAX_TEXELS:
        raise TwinError(field, f"{file.name!r} has textures of {n_texels} texels", f"at most {MAX_TEXELS} texels")
    uv = np.concatenate([part.uv for part in parts])
    arrays = tuple(_rgb(image) for image in images)
    return TexturedMesh(_upright(mesh, y_up), uv, np.concatenate(numbers), arrays)


class _Part(NamedTuple):
    """Mesh of one material.

    Args:
        mesh: triangles, with the colours of their vertices.
        uv: (n, 2) texture coordinates of the vertices.
        image: PIL image of the texture; None without a texture.
        coloured: whether the file gives the mesh a texture or colours.
    """

    mesh: Mesh
    uv: NDArray[np.float32]
    image: Any
    coloured: bool


def _part(part: Any) -> _Part:
    """Returns a trimesh mesh with its texture, else with the colours of its vertices or its material, else white."""
    n, texture, factor = len(part.vertices), _texture_of(part), _base_colour(part)
    colours = np.full((n, 3), 255, np.uint8)
    if texture is not None:
        image, uv = texture
        finite = np.nan_to_num(np.asarray(uv, np.float32)[:, :2], posinf=0.0, neginf=0.0)
        return _Part(_mesh(part.vertices, part.faces, colours), finite, image, True)
    coloured = hasattr(part.visual, "vertex_colors") and part.visual.defined
    if coloured:
        colours = np.asarray(part.visual.vertex_colors)[:, :3]
    elif factor is not None:
        coloured, colours = True, np.broadcast_to(factor, (n, 3))
    return _Part(_mesh(part.vertices, part.faces, colours), np.zeros((n, 2), np.float32), None, coloured)


def _read(file: Path, field: str, convert: Callable[[list[Any]], list[Any]]) -> list[Any]:
    """Returns the result of `convert` for the trimesh meshes of a file, whose size is checked first."""
    with reading(file, field, FORMATS, MAX_BYTES):
        if (n_faces := face_count(file)) > MAX_FACES:
            raise TwinError(field, f"{file.name!r} has {n_faces} triangles", f"at most {MAX_FACES} triangles")
        return convert(_near_origin(_parts(_loaded(file, field))))


def _near_origin(parts: list[Any]) -> list[Any]:
    """Returns trimesh meshes; moves them together so that their centre is the origin if it is far from it.

    The centre is that of their bounding box. It is far from the origin if the magnitude of one of its coordinates
    exceeds 8 times the largest side of the box. Georeferenced models have coordinates of 1e5 to 1e7 m, which single
    precision rounds to steps of up to 1 m.
    """
    corners = [np.asarray(part.vertices) for part in parts if len(part.vertices)]
    if not corners:
        return parts
    low, high = np.min([c.min(axis=0) for c in corners], axis=0), np.max([c.max(axis=0) for c in corners], axis=0)
    centre = (low + high) / 2
    if np.isfinite(centre).all() and np.abs(centre).max() > 8 * (high - low).max():
        for part in parts:
            part.vertices = np.asarray(part.vertices) - centre
    return parts


def _upright(mesh: Mesh, y_up: bool) -> Mesh:
    """Returns a mesh with z up; `y_up`: its y points up."""
    return mesh._replace(vertices_m=mesh.vertices_m @ _Z_FROM_Y_UP.T) if y_up else mesh


_Z_FROM_Y_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float32)


def _loaded(file: Path, field: str) -> Any:
    """Returns the trimesh scene or mesh of a file."""
    import trimesh  # imported here: it takes 0.3 s, and most scenarios have no mesh files
    from PIL import Image
    from trimesh.resolvers import FilePathResolver

    unread: list[str] = []  # trimesh goes on without the files that it cannot read

    class Resolver(FilePathResolver):
        def get(self, name: str) -> bytes:
            try:
                data = super().get(name)
                if not name.lower().endswith((".mtl", ".bin")):
                    Image.open(io.BytesIO(data)).close()
            except (OSError, ValueError):
                unread.append(name.strip())
                raise
            return data

    loaded = trimesh.load(file, process=False, resolver=Resolver(str(file)))
    if unread:
        problem = f"{file.name!r} needs the file {unread[0]!r}, which is not beside it or cannot be read"
        raise TwinError(field, problem, "a mesh with all its material and texture files, or one that names none")
    return loaded


def _parts(loaded: Any) -> list[Any]:
    """Returns the triangle meshes of a trimesh scene or mesh, in the axes of the file."""
    import trimesh

    if isinstance(loaded, trimesh.Scene):
        loaded = loaded.dump()
    parts = loaded if isinstance(loaded, list | tuple) else [loaded]
    return [part for part in parts if isinstance(part, trimesh.Trimesh)]


def _coloured(part: Any, albedo: tuple[float, float, float], most_faces: int) -> Mesh:
    """Returns a trimesh mesh as a mesh with the colours of its texture, vertices or material; `albedo` if it has none.

    A textured mesh is divided into at most `most_faces` triangles, or not at all.
    """
    found = _part(part)
    if found.image is not None:
        return _textured(part, most_faces)
    if found.coloured:
        return found.mesh
    return _mesh(part.vertices, part.faces, np.broadcast_to(np.rint(np.asarray(albedo) * 255), (len(part.vertices), 3)))


def _mesh(vertices: Any, faces: Any, colours: Any) -> Mesh:
    return Mesh(
        np.ascontiguousarray(vertices, np.float32),
        np.ascontiguousarray(faces, np.int32),
        np.ascontiguousarray(colours, np.uint8),
    )


def _textured(part: Any, most_faces: int) -> Mesh:
    """Returns a trimesh mesh with the colours of its texture at its vertices.

    All triangles are divided into four, repeatedly, as long as this makes at most `most_faces`.
    """
    import trimesh

    texture = _texture_of(part)
    assert texture is not None
    image, uv = texture
    divided: Any = np.asarray(part.vertices), np.asarray(part.faces), {"uv": np.asarray(uv)}
    while 0 < len(divided[1]) * 4 <= most_faces:
        divided = trimesh.remesh.subdivide(*divided[:2], vertex_attributes=divided[2])
    vertices, faces, attributes = divided
    return _mesh(vertices, faces, _sampled(_rgb(image), attributes["uv"]))


def _rgb(image: Any) -> NDArray[np.uint8]:
    """Returns the colours (h, w, 3) of a PIL image; grey levels of 16 bits become 8 bits.

    Pillow gives grey images of 16 bits a mode of integers ("I;16", "I"), whose conversion to RGB clips at 255.
    """
    if not image.mode.startswith("I"):
        return np.asarray(image.convert("RGB"), np.uint8)
    values = np.clip(np.asarray(image), 0, 65535)
    grey = eight_bits(values, int(values.max()))
    return np.repeat(grey[..., None], 3, axis=2)


def _base_colour(part: Any) -> tuple[int, ...] | None:
    """Returns red, green and blue, 0 to 255, of the baseColorFactor of a glTF material; None if it states none.

    It is used without a texture only: trimesh, for example, writes textures with a factor of 0.4 that is not intended.
    """
    factor = getattr(getattr(part.visual, "material", None), "baseColorFactor", None)
    return None if factor is None else tuple(int(value) for value in np.asarray(factor)[:3])


def _texture_of(part: Any) -> tuple[Any, Any] | None:
    """Returns PIL image and texture coordinates (n, 2) of a trimesh mesh; None if it lacks either."""
    material, uv = getattr(part.visual, "material", None), getattr(part.visual, "uv", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is None or uv is None or len(uv) != len(part.vertices):
        return None
    if image.format not in (None, *IMAGE_FORMATS) or image.width * image.height > MAX_TEXELS:  # None: of one colour
        raise ValueError(f"a texture is a {image.format} of {image.width} x {image.height} pixels")
    return image, uv


def _sampled(image: NDArray[np.uint8], uv: Array) -> NDArray[np.uint8]:
    """Returns the colours (n, 3) of an image (h, w, 3) at texture coordinates (n, 2), repeated beyond 0 to 1."""
    height, width = image.shape[:2]
    col = np.floor((uv[:, 0] % 1.0) * width).astype(np.int64) % width
    row = np.floor(((1 - uv[:, 1]) % 1.0) * height).astype(np.int64) % height
    return image[row, col]


def _joined(parts: list[Mesh]) -> Mesh:
    return joined(parts) if parts else _mesh(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)))


def _check(mesh: Mesh, file: Path, field: str) -> None:
    """Raises TwinError if a mesh is empty, too large, invalid, without extent or not manifold."""
    if len(mesh.faces) == 0:
        raise TwinError(field, f"{file.name!r} has no triangles", FORMATS)
    if len(mesh.faces) > MAX_FACES:
        raise TwinError(field, f"{file.name!r} has {len(mesh.faces)} triangles", f"at most {MAX_FACES} triangles")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices_m):
        raise TwinError(field, f"{file.name!r} has triangles with corners that do not exist", FORMATS)
    if not np.isfinite(mesh.vertices_m).all():
        raise TwinError(field, f"{file.name!r} has corners that are not finite", "finite coordinates")
    if np.ptp(mesh.vertices_m[mesh.faces.ravel()], axis=0).max() == 0:
        raise TwinError(field, f"{file.name!r} has no extent", "a mesh with an extent")
    if n_edges := crowded_edges(mesh):
        raise TwinError(
            field, f"{file.name!r} is not manifold: {n_edges} edges belong to more than two triangles",
            "a mesh whose edges belong to one or two triangles each",
        )  # fmt: skip


def crowded_edges(mesh: Mesh) -> int:
    """Returns the number of edges that belong to more than two triangles; equal positions count as one corner."""
    faces = welded_faces(mesh)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, count = np.unique(edges[:, 0] * (len(mesh.vertices_m) + 1) + edges[:, 1], return_counts=True)
    return int((count > 2).sum())
