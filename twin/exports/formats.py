"""Formats of `twin export`: the table of all formats, and the checks of a request."""

import difflib
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from twin.datasets.run_contents import POSES, RunContents
from twin.errors import TwinError


class ExportFormat(NamedTuple):
    """A format of `twin export`."""

    description: str  #: one line for the list of formats
    needs: tuple[str, ...]  #: contents without which the format cannot be written (`_NEEDS`)
    writer: str  #: module and function, imported when they are called, because writers need large packages

    def write(self, contents: RunContents, folder: Path) -> list[Path]:
        """Writes the contents to an existing folder; returns the files, or the folders with many files."""
        module, function = self.writer.split(":")
        return getattr(import_module(f"twin.{module}"), function)(contents, folder)


#: Name, needs, writer and description of each format, in the order in which `twin export --list` shows them.
_TABLE = (
    ("euroc", "images", "datasets.euroc:export",
     "EuRoC/ASL folder: stereo images, calibration, truth, sensor readings"),
    ("kitti", "pairs", "datasets.kitti:export",
     "KITTI odometry sequence: stereo pairs, calib.txt, times.txt, true poses"),
    ("tum", "", "datasets.tum:export", "TUM: trajectories of the left camera, lists of images"),
    ("colmap", "pairs poses", "datasets.colmap:export",
     "COLMAP text model: stereo rig, poses, 3D points of the map with tracks"),
    ("nerfstudio", "images poses", "exports.nerfstudio:export", "nerfstudio: transforms.json and images"),
    ("calibration", "", "datasets.calibration_files:export",
     "camera calibration in OpenCV, Kalibr and COLMAP form, true and believed"),
    ("ifdo", "images poses", "exports.ifdo:export", "iFDO v2.1 metadata of the images (JSON)"),
    ("metashape", "images poses", "exports.metashape:export",
     "Metashape reference CSV: position and attitude of each image"),
    ("truth", "images world", "exports.truth_images:export",
     "exact truth of each left image: depth, flow, normals, albedo, clear water, light, veil, labels"),
    ("mcap", "images", "datasets.ros2.bag_writer:export",
     "ROS 2 bag in MCAP: images, camera_info, tf, odometry, attitude, pressure, DVL"),
    ("cog", "map", "exports.cloud_optimised:export", "cloud-optimised GeoTIFF: elevation, sigma, error, orthomosaic"),
    ("ply", "map", "exports.point_cloud:export_ply", "point cloud of the map with colour and sigma, PLY"),
    ("laz", "map", "exports.point_cloud:export_laz", "point cloud of the map with colour and sigma, LAZ"),
    ("glb", "map", "exports.textured_mesh:export_glb", "mesh of the map with the orthomosaic as texture, binary glTF"),
    ("obj", "map", "exports.textured_mesh:export_obj",
     "mesh of the map with the orthomosaic as texture, Wavefront OBJ"),
)  # fmt: skip
#: Formats of the planned path of a scenario: description, suffix, and writer in `path_files`.
PATH_FORMATS = {
    "qgc": ("planned path: mission of QGroundControl for ArduSub", ".plan", "write_qgc"),
    "kml": ("planned path: KML 2.2, a line for each track", ".kml", "write_kml"),
    "gpx": ("planned path: GPX 1.1, a route", ".gpx", "write_gpx"),
    "csv": ("planned path: waypoints in the scene, in its CRS and on WGS 84", ".csv", "write_csv"),
}
FORMATS = {name: ExportFormat(text, tuple(needs.split()), writer) for name, needs, writer, text in _TABLE}


#: What a format may need: whether a run has it, the problem of one that has not, and a run that has it.
_NEEDS: dict[str, tuple[Callable[[RunContents], bool], str, str]] = {
    "images": (lambda run: bool(run.frames), "has no images",
               'a run of a scenario with record = "all" (every frame) or "keyframes"'),
    "pairs": (lambda run: bool(run.pairs), "has no stereo pairs",
              'a run of a scenario with record = "all" or "keyframes"'),
    "poses": (lambda run: not run.trajectories.keys().isdisjoint(POSES), "has neither a true nor a final trajectory",
              "a run with trajectory_truth.tum or trajectory_final.tum"),
    "map": (lambda run: run.elevation is not None, "has no elevation map", "a run with dem.tif"),
    "world": (lambda run: run.renders_again, "has no simulated world or no frames/truth.npz",
              "a run of `twin run` with rendered images, whose record is not none"),
}  # fmt: skip


def chosen_formats(names: Sequence[str]) -> list[str]:
    """Returns the formats in names, each once; a name may list several with commas; raises TwinError if unknown."""
    parts = [part.strip() for name in names for part in name.split(",") if part.strip()]
    known = [*FORMATS, *PATH_FORMATS]
    for part in parts:
        if part not in known:
            close = difflib.get_close_matches(part, known, 1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            raise TwinError("--to", f"{part[:40]!r} is not a format{hint}", ", ".join(known))
    if not parts:
        raise TwinError("--to", "is missing", ", ".join(known))
    return list(dict.fromkeys(parts))


def check_needs(name: str, contents: RunContents) -> None:
    for need in sorted(FORMATS[name].needs):
        is_met, problem, allowed = _NEEDS[need]
        if not is_met(contents):
            raise TwinError(f"--to {name}", f"{contents.folder} {problem}", allowed)
