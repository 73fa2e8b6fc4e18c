"""Number of triangles that a mesh file declares, found without loading the mesh, because it may be very large."""

import json
import struct
from collections import Counter
from pathlib import Path

FORMATS = "a PLY, OBJ or GLB file with triangles"
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
