"""The elevation map as a triangle mesh with the orthomosaic as its texture: GLB (binary glTF) and OBJ.

Both are in scene coordinates [m], because most programs read coordinates of meshes in single precision, which is too
coarse for coordinates in a coordinate reference system (CRS). In GLB, x is east, y up and z south, as glTF is y-up; in
OBJ, x is east, y north and z up. With a georeference, the extras of the GLB scene and the comments of the OBJ file
state the position of the scene origin in the CRS.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image as PillowImage
from rasterio.enums import Resampling
from trimesh.exchange.gltf import export_glb
from trimesh.exchange.obj import export_obj
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from twin.core.georeference import Georeference
from twin.core.height_field import raster_triangles
from twin.core.raster_files import open_raster
from twin.core.records import ElevationMap, MapGrid
from twin.exchange import geotiff
from twin.exchange.mesh import GLB_FROM_WORLD, MAX_VERTICES
from twin.exchange.run_contents import RunContents

_MOST_TEXTURE_PX = 8192  # largest side of a texture [px], which common graphics cards support


def export_glb_file(contents: RunContents, folder: Path) -> list[Path]:
    """Writes map.glb and returns its path, as a list of one."""
    path, (mesh, texture) = folder / "map.glb", _mesh(contents)
    material = PBRMaterial(baseColorTexture=texture, metallicFactor=0.0, roughnessFactor=1.0)
    mesh.visual = TextureVisuals(_uv(mesh), material)
    mesh.vertices = mesh.vertices @ GLB_FROM_WORLD.T
    scene = trimesh.Scene([mesh] if len(mesh.faces) else [])
    scene.metadata.update(_origin(contents.georeference))
    path.write_bytes(export_glb(scene))
    return [path]


def export_obj_files(contents: RunContents, folder: Path) -> list[Path]:
    """Writes map.obj and the files of its material and texture, and returns these files."""
    path, (mesh, texture) = folder / "map.obj", _mesh(contents)
    mesh.visual = TextureVisuals(_uv(mesh), SimpleMaterial(image=texture, name="map"))
    lines = ["z-up, metres", *(f"{key}: {value}" for key, value in _origin(contents.georeference).items())]
    text, others = export_obj(
        mesh, include_normals=False, digits=9, return_texture=True, mtl_name="map.mtl", header="\n# ".join(lines)
    )
    path.write_text(text, encoding="utf-8")
    for name, data in others.items():
        (folder / name).write_bytes(data)
    return [path, *(folder / name for name in others)]


def textured_mesh(elevation: ElevationMap, texture_grid: MapGrid, max_vertices: int = MAX_VERTICES) -> trimesh.Trimesh:
    """Returns the mesh of a map in scene coordinates, with texture coordinates.

    Vertices are the centres of the mapped cells, subsampled to about `max_vertices`. Triangles connect neighbouring
    vertices and face up in the frame of the map; cells that belong to no triangle are left out. Texture coordinates are
    (0, 0) in the south-west and (1, 1) in the north-east corner of the texture.

    Args:
        elevation: the map.
        texture_grid: grid of the pixels of the texture; row 0 is the northernmost.
        max_vertices: approximate largest number of vertices.
    """
    stride = max(1, int(np.ceil(np.sqrt(elevation.height_m.size / max_vertices))))
    x, y = (values[::stride] for values in elevation.grid.centres())
    height = elevation.height_m[::stride, ::stride]
    east, north = np.meshgrid(x, y)
    points = np.stack([east, north, height], axis=-1).reshape(-1, 3).astype(np.float64)
    used, faces = np.unique(raster_triangles(np.isfinite(height)), return_inverse=True)
    width_m, height_m = texture_grid.cols * texture_grid.cell_m, texture_grid.rows * texture_grid.cell_m
    u = (points[used, 0] - texture_grid.west_m) / width_m
    v = 1 - (texture_grid.north_m - points[used, 1]) / height_m
    visual = TextureVisuals(np.column_stack([u, v]))
    return trimesh.Trimesh(elevation.to_world(points[used]), faces.reshape(-1, 3), visual=visual, process=False)


def _mesh(contents: RunContents) -> tuple[trimesh.Trimesh, PillowImage.Image]:
    """Returns the mesh of a run and its texture.

    The texture is the orthomosaic; without a file of the orthomosaic, it is `ElevationMap.mosaic`, one pixel per cell.
    """
    elevation = contents.elevation
    assert elevation is not None  # by `ExportFormat.needs`
    if contents.orthomosaic is None:
        texture, grid = elevation.mosaic, elevation.grid
    else:
        texture, grid = _texture(contents.orthomosaic)
    return textured_mesh(elevation, grid), PillowImage.fromarray(texture)


def _uv(mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """Returns the texture coordinates (n, 2) of a mesh."""
    assert isinstance(mesh.visual, TextureVisuals)
    return np.asarray(mesh.visual.uv)


def _texture(file: Path) -> tuple[NDArray[np.uint8], MapGrid]:
    """Returns the orthomosaic (H, W, 3), averaged to at most `_MOST_TEXTURE_PX` pixels per side, and its grid."""
    with open_raster(file) as source:
        grid, _ = geotiff.scene_placement(source)
        step = int(np.ceil(max(source.width, source.height) / _MOST_TEXTURE_PX))
        rows, cols = max(1, source.height // step), max(1, source.width // step)
        whole = (0, min(rows * step, source.height)), (0, min(cols * step, source.width))
        bands = source.read((1, 2, 3), window=whole, out_shape=(3, rows, cols), resampling=Resampling.average)
    pixels = MapGrid(grid.west_m, grid.north_m, grid.cell_m * step, rows, cols)
    return np.ascontiguousarray(np.moveaxis(bands, 0, 2)), pixels


def _origin(georeference: Georeference | None) -> dict[str, str]:
    """Returns the position of the scene origin in the CRS, and the CRS, as texts; empty without a georeference."""
    tags = geotiff.placement_tags(georeference)
    return tags | {"CRS": geotiff.crs_of(georeference).to_wkt()} if tags else {}
