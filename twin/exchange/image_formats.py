"""Formats of images, poses and calibrations. Each function imports its writer only when it is called."""

from __future__ import annotations

from pathlib import Path

from twin.exchange.export_format import ExportFormat
from twin.exchange.run_contents import RunContents


def _euroc(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the EuRoC/ASL folder mav0."""
    from twin.exchange import euroc

    return euroc.export(contents, folder)


def _kitti(contents: RunContents, folder: Path) -> list[Path]:
    """Writes a KITTI odometry sequence."""
    from twin.exchange import kitti

    return kitti.export(contents, folder)


def _tum(contents: RunContents, folder: Path) -> list[Path]:
    """Writes trajectories and image lists in the TUM layout."""
    from twin.exchange import tum

    return tum.export(contents, folder)


def _colmap(contents: RunContents, folder: Path) -> list[Path]:
    """Writes a COLMAP text model and its images."""
    from twin.exchange import colmap

    return colmap.export(contents, folder)


def _nerfstudio(contents: RunContents, folder: Path) -> list[Path]:
    """Writes a nerfstudio data set."""
    from twin.exchange import nerfstudio

    return nerfstudio.export(contents, folder)


def _calibration(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the believed calibration and, if known, the true one."""
    from twin.exchange import camera_files

    return camera_files.export(contents, folder)


def _ifdo(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the images and their metadata in iFDO format."""
    from twin.exchange import ifdo

    return ifdo.export(contents, folder)


def _metashape(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the images and the reference CSV files of Metashape."""
    from twin.exchange import metashape

    return metashape.export(contents, folder)


def _truth(contents: RunContents, folder: Path) -> list[Path]:
    """Writes the true layers of the recorded left images."""
    from twin.exchange import truth_images

    return truth_images.export(contents, folder)


IMAGE_FORMATS: dict[str, ExportFormat] = {
    "euroc": ExportFormat(
        "EuRoC/ASL folder: stereo images, calibration, truth, sensor readings", frozenset({"images"}), _euroc
    ),
    "kitti": ExportFormat(
        "KITTI odometry sequence: stereo pairs, calib.txt, times.txt, true poses", frozenset({"pairs"}), _kitti
    ),
    "tum": ExportFormat("TUM: trajectories of the left camera, lists of images", frozenset(), _tum),
    "colmap": ExportFormat(
        "COLMAP text model: stereo rig, poses, 3D points of the map with tracks", frozenset({"pairs", "poses"}), _colmap
    ),
    "nerfstudio": ExportFormat("nerfstudio: transforms.json and images", frozenset({"images", "poses"}), _nerfstudio),
    "calibration": ExportFormat(
        "camera calibration in OpenCV, Kalibr and COLMAP form, true and believed", frozenset(), _calibration
    ),
    "ifdo": ExportFormat("iFDO v2.1 metadata of the images (JSON)", frozenset({"images", "poses"}), _ifdo),
    "metashape": ExportFormat(
        "Metashape reference CSV: position and attitude of each image", frozenset({"images", "poses"}), _metashape
    ),
    "truth": ExportFormat(
        "exact truth of each left image: depth, flow, normals, albedo, clear water, light, veil, labels",
        frozenset({"images", "world"}),
        _truth,
    ),
}
