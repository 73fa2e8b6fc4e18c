"""Meshes from files: PLY, OBJ and GLB, with the colours of their vertices or their texture."""

import io
import json
import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.user_files import IMAGE_FORMATS, read_bytes, reading, resolved
from twin.errors import TwinError
from twin.terrains.file_header import eight_bits
from twin.terrains.objects.coloured_mesh import Mesh, joined, welded_faces, with_colours

MAX_FACES = 2_000_000  #: a mesh takes about 100 bytes per triangle, with its levels of detail
MAX_BYTES = 500_000_000  #: size of the largest file that is read
MAX_TEXELS = 250_000_000  #: largest number of texels of all textures of a floor together
TEXTURED_FACES = 200_000  #: largest number of triangles of a divided mesh, whose corners sample the texture
_Z_FROM_Y_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float32)


class TexturedMesh(NamedTuple):
    """Mesh whose triangles have the colours of textures or of their vertices."""

    mesh: Mesh  #: triangles, with the colours of their vertices; a vertex without a colour is white
    #: (n, 2) float32 texture coordinates, which increase to the right and upwards; textures repeat beyond 0 to 1
    uv: NDArray[np.float32]
    texture: NDArray[np.int32]  #: (m,) number, from 0, of the texture of each triangle; -1: the colours of its vertices
    images: tuple[NDArray[np.uint8], ...]  #: the textures, (h, w, 3) each


def read_mesh(file: Path, field: str, albedo: tuple[float, float, float], y_up: bool = False) -> Mesh:
    """Returns the mesh of a PLY, OBJ or GLB file, in its unit; a mesh far from the origin is moved to it.

    A mesh may be open, as photogrammetric models are, but no edge may belong to more than two triangles, of which those
    with the same corners as an earlier one are left out. A texture is sampled at the vertices, after the triangles have
    been divided. `albedo`, 0 to 1, is that of a mesh without colours; with `y_up`, y of the file points up, not z.

    Raises TwinError, with the key `field`, if the file is missing, unreadable or too large, has no triangles or extent,
    or is not manifold.
    """
    grey = np.rint(np.asarray(albedo) * 255)
    with _parts_of(file, field) as parts:
        meshes = [_coloured(part, grey, TEXTURED_FACES // len(parts)) for part in parts]
    return _checked([mesh for mesh in meshes if len(mesh.faces)], file, field, y_up)


def read_textured_mesh(file: Path, field: str, y_up: bool = False) -> TexturedMesh:
    """Returns the mesh of a file with its textures, as `read_mesh`; raises TwinError also if it has no colours."""
    meshes, uvs, numbers, images, coloured = [], [], [], [], False
    with _parts_of(file, field) as parts:
        for part in parts:
            found, colours = _texture_of(part), _own_colours(part)
            if not len(part.faces):
                continue
            uv, number = np.zeros((len(part.vertices), 2), np.float32), -1
            if found is not None:
                image, at = found
                uv, colours = np.nan_to_num(np.asarray(at, np.float32)[:, :2], posinf=0.0, neginf=0.0), None
                number = next((k for k, other in enumerate(images) if other is image), len(images))
                images += [image] if number == len(images) else []
            coloured = coloured or found is not None or colours is not None
            meshes.append(with_colours(part.vertices, part.faces, 255 if colours is None else colours))
            uvs.append(uv)
            numbers.append(np.full(len(part.faces), number, np.int32))
    mesh = _checked(meshes, file, field, y_up)
    if not coloured:
        raise TwinError(field, f"{file.name!r} has no colours", "a mesh with a texture or with colours of its vertices")
    n_texels = sum(image.size[0] * image.size[1] for image in images)
    if n_texels > MAX_TEXELS:
        raise TwinError(field, f"{file.name!r} has textures of {n_texels} texels", f"at most {MAX_TEXELS} texels")
    return TexturedMesh(mesh, np.concatenate(uvs), np.concatenate(numbers), tuple(_rgb(image) for image in images))


@contextmanager
def _parts_of(file: Path, field: str) -> Iterator[list[Any]]:
    """Gives the trimesh meshes of a file, whose size is checked first; any exception within becomes a TwinError."""
    with reading(file, field, FORMATS, MAX_BYTES):
        if (n_faces := face_count(file)) > MAX_FACES:
            raise TwinError(field, f"{file.name!r} has {n_faces} triangles", f"at most {MAX_FACES} triangles")
        parts = _loaded(file, field)
        for part in parts:
            part.update_faces(part.unique_faces())
            part.remove_unreferenced_vertices()  # they would count in extent and position
        yield _near_origin(parts)


def _loaded(file: Path, field: str) -> list[Any]:
    import trimesh  # imported here: it takes 0.3 s, and most scenarios have no mesh files
    from PIL import Image
    from trimesh.resolvers import FilePathResolver

    unread: list[str] = []  # trimesh goes on without the files that it cannot read

    class Resolver(FilePathResolver):
        def get(self, name: str) -> bytes:
            try:
                folder = resolved(file).parent
                near = [resolved(folder / part.strip()) for part in (name, Path(name).name)]
                found = [path for path in near if path.is_relative_to(folder) and path.exists()]
                data = read_bytes(found[0], field, FORMATS, MAX_BYTES)
                if not name.lower().endswith((".mtl", ".bin")):
                    Image.open(io.BytesIO(data)).close()
            except (OSError, ValueError, IndexError, TwinError):
                unread.append(name.strip())
                raise
            return data

    loaded: Any = trimesh.load(file, process=False, resolver=Resolver(str(file)))
    if unread:
        problem = f"{file.name!r} needs the file {unread[0]!r}, which is not beside it or cannot be read"
        raise TwinError(field, problem, "a mesh with all its material and texture files, or one that names none")
    parts = loaded.dump() if isinstance(loaded, trimesh.Scene) else loaded
    parts = parts if isinstance(parts, list | tuple) else [parts]
    return [part for part in parts if isinstance(part, trimesh.Trimesh)]


def _near_origin(parts: list[Any]) -> list[Any]:
    """Returns trimesh meshes, together centred at the origin if they are more than 8 of their sizes away."""
    # Georeferenced models have coordinates of 1e5 to 1e7 m, which single precision rounds to steps of up to 1 m.
    corners = [np.asarray(part.vertices) for part in parts if len(part.vertices)]
    if not corners:
        return parts
    low, high = np.min([c.min(axis=0) for c in corners], axis=0), np.max([c.max(axis=0) for c in corners], axis=0)
    centre = (low + high) / 2
    if np.isfinite(centre).all() and np.abs(centre).max() > 8 * (high - low).max():
        for part in parts:
            part.vertices = np.asarray(part.vertices) - centre
    return parts


def _coloured(part: Any, grey: Array, most_faces: int) -> Mesh:
    """Returns a mesh with the colours of texture (divided up to `most_faces`), vertices or material, else `grey`."""
    import trimesh

    if (texture := _texture_of(part)) is None:
        colours = _own_colours(part)
        return with_colours(part.vertices, part.faces, grey if colours is None else colours)
    image, uv = texture
    vertices, faces, at = np.asarray(part.vertices), np.asarray(part.faces), {"uv": np.asarray(uv)}
    while 0 < len(faces) * 4 <= most_faces:
        divided: Any = trimesh.remesh.subdivide(vertices, faces, vertex_attributes=at)
        vertices, faces, at = divided
    return with_colours(vertices, faces, _sampled(_rgb(image), at["uv"]))


def _own_colours(part: Any) -> Any:
    """Returns the colours of vertices (n, 3) or material (3,), 0 to 255, or None."""
    # The factor of a textured material is not used: trimesh writes one of 0.4 that is not intended.
    if hasattr(part.visual, "vertex_colors") and part.visual.defined:
        return np.asarray(part.visual.vertex_colors)[:, :3]
    material = getattr(part.visual, "material", None)
    factor = getattr(material, "baseColorFactor", getattr(material, "diffuse", None))  # of GLB, of OBJ
    is_given = factor is not None and tuple(factor[:3]) != _UNSTATED
    return np.asarray(factor)[:3].astype(int) if is_given else None


def _texture_of(part: Any) -> tuple[Any, Any] | None:
    """Returns PIL image and texture coordinates (n, 2) of a trimesh mesh; None if it lacks either."""
    material, uv = getattr(part.visual, "material", None), getattr(part.visual, "uv", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is None or uv is None or len(uv) != len(part.vertices):
        return None
    if image.format not in (None, *IMAGE_FORMATS) or image.width * image.height > MAX_TEXELS:  # None: of one colour
        raise ValueError(f"a texture is a {image.format} of {image.width} x {image.height} pixels")
    return image, uv


def _rgb(image: Any) -> NDArray[np.uint8]:
    """Returns the colours (h, w, 3) of a PIL image; 16-bit grey, which Pillow would clip at 255, is scaled."""
    if not image.mode.startswith("I"):
        return np.asarray(image.convert("RGB"), np.uint8)
    values = np.clip(np.asarray(image), 0, 65535)
    return np.repeat(eight_bits(values, int(values.max()))[..., None], 3, axis=2)


def _sampled(image: NDArray[np.uint8], uv: Array) -> NDArray[np.uint8]:
    """Returns the colours (n, 3) of an image (h, w, 3) at texture coordinates (n, 2), repeated beyond 0 to 1."""
    height, width = image.shape[:2]
    u, v = (np.where((part < 0) | (part > 1), part % 1.0, part) for part in uv.T)
    col = np.minimum((u * width).astype(np.int64), width - 1)
    row = np.minimum(((1 - v) * height).astype(np.int64), height - 1)
    return image[row, col]


def _checked(meshes: list[Mesh], file: Path, field: str, y_up: bool) -> Mesh:
    if not meshes:
        raise TwinError(field, f"{file.name!r} has no triangles", FORMATS)
    mesh = joined(meshes)
    if (found := _problem(mesh)) is not None:
        problem, allowed = found
        raise TwinError(field, f"{file.name!r} {problem}", allowed)
    return mesh._replace(vertices_m=mesh.vertices_m @ _Z_FROM_Y_UP.T) if y_up else mesh


def _problem(mesh: Mesh) -> tuple[str, str] | None:
    if len(mesh.faces) > MAX_FACES:
        return f"has {len(mesh.faces)} triangles", f"at most {MAX_FACES} triangles"
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices_m):
        return "has triangles with corners that do not exist", FORMATS
    if not np.isfinite(mesh.vertices_m).all():
        return "has corners that are not finite", "finite coordinates"
    if np.ptp(mesh.vertices_m[mesh.faces.ravel()], axis=0).max() == 0:
        return "has no extent", "a mesh with an extent"
    if n_edges := crowded_edges(mesh):
        problem = f"is not manifold: {n_edges} edges belong to more than two triangles"
        return problem, "a mesh whose edges belong to one or two triangles each"
    return None


def crowded_edges(mesh: Mesh) -> int:
    """Returns the number of edges that belong to more than two triangles; equal positions are one corner."""
    faces = welded_faces(mesh)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, count = np.unique(edges[:, 0] * (len(mesh.vertices_m) + 1) + edges[:, 1], return_counts=True)
    return int((count > 2).sum())


FORMATS = "a PLY, OBJ or GLB file with triangles"
_UNSTATED = (102, 102, 102)  # colour that trimesh gives to an OBJ file without one
_LONGEST_HEADER = 65_536  # largest number of bytes of a PLY header, and of a part of an OBJ line read at once
_MOST_ELEMENTS = 20_000_000  # largest number of elements of an accessor of a GLB file
_LONGEST_JSON = 16_777_216  # largest number of bytes of the description in a GLB file


def face_count(file: Path) -> int:
    """Returns the number of triangles that a file declares (of a PLY file, of faces); ValueError for other formats."""
    counters = {".ply": _ply_faces, ".obj": _obj_faces, ".glb": _glb_faces}
    if file.suffix.lower() not in counters:
        raise ValueError("is not a mesh file")
    return counters[file.suffix.lower()](file)


def _ply_faces(file: Path) -> int:
    with file.open("rb") as stream:
        header = stream.read(_LONGEST_HEADER)
    if not header.startswith(b"ply") or b"end_header" not in header:
        raise ValueError("has no PLY header")
    for line in header.partition(b"end_header")[0].splitlines():
        words = line.split()
        if words[:2] == [b"element", b"face"] and len(words) == 3 and words[2].isdigit():
            return int(words[2])
    raise ValueError("is a point cloud without faces")


def _obj_faces(file: Path) -> int:
    count = 0
    with file.open("rb") as stream:
        while line := stream.readline(_LONGEST_HEADER):
            if line.startswith((b"f ", b"f\t")):
                count += max(1, len(line.split()) - 3)
    return count


def _glb_faces(file: Path) -> int:
    """Returns the number of triangles of a binary glTF file: a mesh counts for each node that places it."""
    with file.open("rb") as stream:
        start = stream.read(20)
        if len(start) < 20 or start[:4] != b"glTF" or start[16:] != b"JSON":
            raise ValueError("has no GLB header")
        length = struct.unpack("<I", start[12:16])[0]
        if length > _LONGEST_JSON:
            raise ValueError(f"has a description of {length} bytes")
        text = stream.read(length)
    try:
        tree = json.loads(text)
        accessors = tree.get("accessors", [])
        instances = Counter(node.get("mesh") for node in tree.get("nodes", []))
        if (most := max((int(accessor["count"]) for accessor in accessors), default=0)) > _MOST_ELEMENTS:
            raise ValueError(f"{most} elements of an accessor")  # trimesh makes an array of one without data
        count = 0
        for number, mesh in enumerate(tree.get("meshes", [])):
            parts = [part.get("indices", part.get("attributes", {}).get("POSITION")) for part in mesh["primitives"]]
            count += max(1, instances[number]) * sum(int(accessors[k]["count"]) // 3 for k in parts)
        return count
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError) as error:
        raise ValueError(f"has an invalid description: {error}") from error
