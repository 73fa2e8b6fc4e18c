"""The elevation map as a triangle mesh with the orthomosaic as its texture: GLB (binary glTF) and OBJ.

Both are in scene coordinates [m], because most programs read meshes in single precision, too coarse for coordinates in
a CRS. In GLB, x is east, y up and z south; in OBJ, x is east, y north and z up. With a georeference, the extras of the
GLB scene and the comments of the OBJ file state the position of the scene origin in the CRS.
"""

from pathlib import Path

import numpy as np
import trimesh
from PIL import Image as PillowImage
from trimesh.exchange import obj
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from twin.core.geometry import Array
from twin.core.georeference import Georeference
from twin.datasets.run_contents import RunContents
from twin.exchange import geotiff, mesh
from twin.exchange.geotiff import Raster

_MOST_TEXTURE_PX = 8192  # largest side of a texture [px], which common graphics cards support


def export_glb(contents: RunContents, folder: Path) -> list[Path]:
    path, (surface, uv, image) = folder / "map.glb", _textured(contents)
    material = PBRMaterial(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0)
    surface.visual = TextureVisuals(uv, material)
    surface.vertices = surface.vertices @ mesh.GLB_FROM_WORLD.T
    path.write_bytes(mesh.glb(surface, **_origin(contents.georeference)))
    return [path]


def export_obj(contents: RunContents, folder: Path) -> list[Path]:
    """Writes map.obj and the files of its material and texture, and returns these files."""
    path, (surface, uv, image) = folder / "map.obj", _textured(contents)
    surface.visual = TextureVisuals(uv, SimpleMaterial(image=image, name="map"))
    lines = ["z-up, metres", *(f"{key}: {value}" for key, value in _origin(contents.georeference).items())]
    text, others = obj.export_obj(
        surface, include_normals=False, digits=9, return_texture=True, mtl_name="map.mtl", header="\n# ".join(lines)
    )
    path.write_text(text, encoding="utf-8")
    for name, data in others.items():
        (folder / name).write_bytes(data)
    return [path, *(folder / name for name in others)]


def _textured(contents: RunContents) -> tuple[trimesh.Trimesh, Array, PillowImage.Image]:
    """Returns the mesh in the scene, texture coordinates (n, 2) from the south-west, and orthomosaic."""
    # without a file of it, it is `ElevationMap.mosaic`, one pixel per cell
    elevation = contents.elevation
    assert elevation is not None  # by `ExportFormat.needs`
    texture = Raster(elevation.grid, elevation.mosaic)
    if contents.orthomosaic is not None:
        texture = geotiff.read_mosaic(contents.orthomosaic, _MOST_TEXTURE_PX)
    points, faces, _ = mesh.surface(elevation)
    grid = texture.grid
    u = (points[:, 0] - grid.west_m) / (grid.cols * grid.cell_m)
    v = 1 - (grid.north_m - points[:, 1]) / (grid.rows * grid.cell_m)
    image = PillowImage.fromarray(np.ascontiguousarray(texture.values))
    return trimesh.Trimesh(elevation.to_world(points), faces, process=False), np.column_stack([u, v]), image


def _origin(georeference: Georeference | None) -> dict[str, str]:
    tags = geotiff.placement_tags(georeference)
    return tags | {"CRS": geotiff.crs_of(georeference).to_wkt()} if tags else {}
