"""Formats of maps, and the ROS 2 bag. Each function imports its writer only when it is called."""

from __future__ import annotations

from pathlib import Path

from twin.exchange.export_format import ExportFormat, Need
from twin.exchange.run_contents import RunContents


def _mcap(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the ROS 2 bag with the name ros2_bag."""
    from twin.exchange import ros2

    return ros2.export(contents, folder)


def _cog(contents: RunContents, folder: Path) -> list[Path]:
    """Writes dem.tif, dem_sigma.tif, orthomosaic.tif and, if the true elevations are known, dem_error.tif."""
    from twin.exchange import cloud_optimised

    return cloud_optimised.export(contents, folder)


def _ply(contents: RunContents, folder: Path) -> list[Path]:
    """Writes map.ply."""
    from twin.exchange import point_cloud

    return point_cloud.export_ply(contents, folder)


def _laz(contents: RunContents, folder: Path) -> list[Path]:
    """Writes map.laz."""
    from twin.exchange import point_cloud

    return point_cloud.export_laz(contents, folder)


def _glb(contents: RunContents, folder: Path) -> list[Path]:
    """Writes map.glb."""
    from twin.exchange import textured_mesh

    return textured_mesh.export_glb_file(contents, folder)


def _obj(contents: RunContents, folder: Path) -> list[Path]:
    """Writes map.obj, its material and its texture."""
    from twin.exchange import textured_mesh

    return textured_mesh.export_obj_files(contents, folder)


_MAP: frozenset[Need] = frozenset({"map"})
MAP_FORMATS: dict[str, ExportFormat] = {
    "mcap": ExportFormat(
        "ROS 2 bag in MCAP: images, camera_info, tf, odometry, attitude, pressure, DVL", frozenset({"images"}), _mcap
    ),
    "cog": ExportFormat("cloud-optimised GeoTIFF: elevation, sigma, error, orthomosaic", _MAP, _cog),
    "ply": ExportFormat("point cloud of the map with colour and sigma, PLY", _MAP, _ply),
    "laz": ExportFormat("point cloud of the map with colour and sigma, LAZ", _MAP, _laz),
    "glb": ExportFormat("mesh of the map with the orthomosaic as texture, binary glTF", _MAP, _glb),
    "obj": ExportFormat("mesh of the map with the orthomosaic as texture, Wavefront OBJ", _MAP, _obj),
}
