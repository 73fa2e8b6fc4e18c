"""Writer of iFDO files (image FAIR Digital Object, version 2.1): metadata of an image set of marine imaging."""

from __future__ import annotations

import hashlib
import json
import uuid
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from twin.core.georeference import Georeference
from twin.core.records import Array
from twin.core.user_files import MOST_IMAGE_BYTES, read_bytes
from twin.exchange.attitude import yaw_pitch_roll_deg
from twin.exchange.image_copy import copy_images
from twin.exchange.run_contents import CameraIntrinsics, RecordedFrame, RunContents

VERSION = "v2.1.0"
_START = datetime(1970, 1, 1, tzinfo=UTC)  # a run has no date
_UNKNOWN = "unknown"


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes ifdo.json and the folder of the images, and returns both.

    The file has the calibration of the left camera, and position, attitude and hash of each image. Positions and
    attitudes are those of the final trajectory or, without one, the true ones. Latitude and longitude (EPSG:4326),
    which iFDO requires, are written if the export has a CRS; otherwise, the file has only poses in scene coordinates.
    Times count from 1970-01-01, because a run has no date.

    For a replay, the file states that the images are recorded; their platform, licence and copyright are "unknown".

    Raises:
        TwinError: an image is truncated or not a PNG image.
        OSError: a file cannot be read or written.
    """
    path = contents.trajectories["final"] if "final" in contents.trajectories else contents.poses
    items: dict[str, Any] = {}
    for image in copy_images(contents, folder / "images", contents.rig.left_from_right):
        pose = path.world_from_camera[image.frame.index] @ image.left_from_camera
        items[image.name] = _item(contents, image.frame, folder / "images" / image.name, pose)
    target = folder / "ifdo.json"
    text = json.dumps({"image-set-header": _header(contents), "image-set-items": items}, indent=1)
    target.write_text(text, encoding="utf-8")
    return [target, folder / "images"]


def _header(contents: RunContents) -> dict[str, Any]:
    """Returns the fields that hold for the whole image set."""
    identifier = _uuid(f"{contents.name} {json.dumps(contents.scenario, sort_keys=True, default=str)}".encode())
    origin = contents.georeference
    named = {"image-project": contents.name, "image-event": contents.name}
    header: dict[str, Any] = {
        "image-set-name": contents.name,
        "image-set-uuid": identifier,
        "image-set-handle": f"urn:uuid:{identifier}",
        "image-set-ifdo-version": VERSION,
        "image-creators": [{"name": "twin"}],
        "image-pi": {"name": "twin"},
        "image-acquisition": "photo",
        "image-deployment": "survey",
        "image-navigation": "reconstructed",
        "image-pixel-magnitude": "mm",
        "image-marine-zone": "seafloor",
        "image-spectral-resolution": "rgb",
        "image-camera-calibration-model": _calibration(contents.believed.left),
    }
    header |= {key: {"name": name} for key, name in named.items()}
    header |= _recorded() if "replay" in contents.scenario else _simulated(_illumination(contents.scenario))
    crs = "EPSG:4326" if origin is not None and origin.crs_wkt is not None else "local metres, x east, y north, z up"
    return header | {"image-coordinate-reference-system": crs}


def _illumination(scenario: Mapping[str, Any]) -> str:
    """Returns iFDO's term for the light of a scenario: "mixed light", "artificial light" or "sunlight"."""
    lamps, sun = bool(scenario.get("lamps")), scenario.get("sun", {}).get("illuminance_lx", 0.0) > 0
    return "mixed light" if lamps and sun else "artificial light" if lamps else "sunlight"


def _simulated(illumination: str) -> dict[str, Any]:
    """Returns the iFDO fields that describe the origin of simulated images and their light (`illumination`)."""
    return {
        "image-context": {"name": "simulated survey"},
        "image-abstract": "Images of a simulated stereo survey. Times count from 1970-01-01.",
        "image-license": {"name": "CC-BY-4.0", "uri": "https://creativecommons.org/licenses/by/4.0/"},
        "image-copyright": "simulated images, no copyright holder",
        "image-platform": {"name": "BlueROV2 Heavy, simulated"},
        "image-sensor": {"name": "stereo camera, simulated"},
        "image-quality": "raw",
        "image-illumination": illumination,
    }


def _recorded() -> dict[str, Any]:
    """Returns the iFDO fields that describe the origin of the images of a replay.

    The images are rectified copies of recorded images; the run folder has no further information on their origin. The
    optional field that describes the light is left out.
    """
    return {
        "image-context": {"name": "replay of a recorded survey"},
        "image-abstract": "Rectified images of a recorded stereo survey. Times count from 1970-01-01.",
        "image-license": {"name": _UNKNOWN},
        "image-copyright": _UNKNOWN,
        "image-platform": {"name": _UNKNOWN},
        "image-sensor": {"name": "stereo camera"},
        "image-quality": "processed",
    }


def _calibration(camera: CameraIntrinsics) -> dict[str, Any]:
    """Returns the fields of a camera model as iFDO defines them [px, degrees].

    The centre of the first pixel is at (0, 0).
    """
    matrix = camera.matrix
    field = np.rad2deg(2 * np.arctan([camera.size_px[k] / 2 / matrix[k, k] for k in (0, 1)]))
    return {
        "calibration-model-type": "rectilinear water",
        "calibration-focal-length-xy-pixel": [float(matrix[0, 0]), float(matrix[1, 1])],
        "calibration-principal-point-xy-pixel": [float(matrix[0, 2]), float(matrix[1, 2])],
        "calibration-distortion-coefficients": [float(value) for value in camera.distortion] + [0.0, 0.0, 0.0],
        "calibration-approximate-field-of-view-water-xy-degree": [float(value) for value in field],
    }


def _item(contents: RunContents, frame: RecordedFrame, image: Path, pose: Array) -> dict[str, Any]:
    """Returns the fields of one image, given its frame, its file and the pose (4, 4) of its camera in the world."""
    digest = hashlib.sha256(read_bytes(image, most_bytes=MOST_IMAGE_BYTES)).hexdigest()
    time = _START + timedelta(seconds=frame.time_s)
    yaw, pitch, roll = yaw_pitch_roll_deg(pose)
    return {
        "image-uuid": _uuid(digest.encode() + image.name.encode()),
        "image-hash-sha256": digest,
        "image-datetime": time.strftime("%Y-%m-%d %H:%M:%S.%f"),
        "image-camera-yaw-degrees": yaw,
        "image-camera-pitch-degrees": pitch,
        "image-camera-roll-degrees": roll,
        **_position(contents.georeference, pose),
    }


def _position(origin: Georeference | None, pose: Array) -> dict[str, Any]:
    """Returns the fields of the position for the pose (4, 4) of a camera in the world.

    The position is in the CRS of `origin` and in EPSG:4326; without a CRS, it is in scene coordinates [m].
    """
    x, y, z = (float(value) for value in pose[:3, 3])
    rotation = [float(value) for value in pose[:3, :3].ravel()]
    if origin is None or origin.crs_wkt is None:
        where = {"pose-utm-east-north-up-meters": [x, y, z], "pose-absolute-orientation-utm-matrix": rotation}
        return {"image-camera-pose": where}
    from rasterio.crs import CRS
    from rasterio.warp import transform

    crs = CRS.from_wkt(origin.crs_wkt)
    easting, northing = (float(value) for value in origin.from_scene(x, y))
    (longitude,), (latitude,) = transform(crs, CRS.from_epsg(4326), [easting], [northing])[:2]
    altitude_m = z + origin.elevation_m
    return {
        "image-latitude": round(latitude, 9),
        "image-longitude": round(longitude, 9),
        "image-altitude-meters": altitude_m,
        "image-camera-pose": {
            "pose-utm-epsg": str(crs.to_epsg() or ""),
            "pose-utm-east-north-up-meters": [easting, northing, altitude_m],
            "pose-absolute-orientation-utm-matrix": rotation,
        },
    }


def _uuid(data: bytes) -> str:
    """Returns a UUID of version 4 that depends on `data` only, so that equal exports have equal identifiers."""
    return str(uuid.UUID(bytes=hashlib.sha256(data).digest()[:16], version=4))
