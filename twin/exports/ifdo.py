"""Writer of iFDO files (image FAIR Digital Object, version 2.1): metadata of an image set of marine imaging."""

import hashlib
import json
import uuid
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from twin.core.records import Array
from twin.core.user_files import MOST_IMAGE_BYTES, read_bytes, read_json
from twin.datasets.calibration import RecordedCamera
from twin.datasets.image_copy import copy_all
from twin.datasets.run_contents import RecordedFrame, RunContents
from twin.exports.geographic_place import WGS84, Place, place_of, transformed, yaw_pitch_roll_deg

_START = datetime(1970, 1, 1, tzinfo=UTC)  # a run has no date
#: Fields of the whole image set: of all sets, of simulated images, and of the rectified images of a replay, of whose
#: origin and light a run folder knows no more.
_FIELDS = Path(__file__).with_name("ifdo_fields.json")
_LOCAL = (
    " The file cannot state where on the Earth the images are: positions and orientations are local (metres, z up), in"
    " image-acquisition-settings, and yaw counts from the y axis."
)


def export(contents: RunContents, folder: Path) -> list[Path]:
    """Writes ifdo.json and the folder of the images, and returns both.

    Positions and attitudes are those of the final trajectory or, without one, the true ones. Latitude and longitude
    (EPSG:4326), which iFDO requires, and poses in UTM are written if the export has a projected CRS; otherwise, the
    abstract says that the file has only poses in scene coordinates. Times count from 1970-01-01, because a run has no
    date. For a replay, the images are recorded ones of "unknown" platform, licence and copyright.
    """
    path = contents.trajectories["final"] if "final" in contents.trajectories else contents.poses
    items, place = dict[str, Any](), place_of(contents.georeference)
    for image in copy_all(contents, folder / "images"):
        pose = path.world_from_camera[image.frame.index] @ contents.believed.left_from(image.camera)
        items[image.file.name] = _item(place, image.frame, image.file, pose)
    target = folder / "ifdo.json"
    text = json.dumps({"image-set-header": _header(contents, place), "image-set-items": items}, indent=1)
    target.write_text(text, encoding="utf-8")
    return [target, folder / "images"]


def _header(contents: RunContents, place: Place | None) -> dict[str, Any]:
    identifier = _uuid(f"{contents.name} {json.dumps(contents.scenario, sort_keys=True, default=str)}".encode())
    known, name = read_json(_FIELDS), {"name": contents.name}
    fields = known["all"] | known["recorded" if "replay" in contents.scenario else "simulated"]
    fields |= {
        "image-set-name": contents.name,
        "image-set-uuid": identifier,
        "image-set-handle": f"urn:uuid:{identifier}",
        "image-camera-calibration-model": _calibration(contents.believed.left),
        "image-project": name,
        "image-event": name,
    }
    if "replay" not in contents.scenario:
        vehicle = contents.scenario.get("vehicle", {}).get("title", "vehicle")
        fields["image-platform"] = {"name": f"{vehicle}, simulated"}
        lamps, sun = contents.scenario.get("lamps"), contents.scenario.get("sun", {}).get("illuminance_lx", 0.0) > 0
        fields["image-illumination"] = "sunlight" if not lamps else "mixed light" if sun else "artificial light"
    if place is None:
        return fields | {"image-abstract": fields["image-abstract"] + _LOCAL}
    return fields | {"image-coordinate-reference-system": WGS84}


def _calibration(camera: RecordedCamera) -> dict[str, Any]:
    """Returns the fields of a camera model as iFDO defines them [px, degrees]; the first pixel has its centre at 0."""
    assert camera.size_px is not None
    matrix = camera.matrix
    field = np.rad2deg(2 * np.arctan(np.array(camera.size_px) / 2 / matrix.diagonal()[:2]))
    return {
        "calibration-model-type": "rectilinear water",
        "calibration-focal-length-xy-pixel": [float(matrix[0, 0]), float(matrix[1, 1])],
        "calibration-principal-point-xy-pixel": [float(matrix[0, 2]), float(matrix[1, 2])],
        "calibration-distortion-coefficients": [float(value) for value in camera.distortion] + [0.0, 0.0, 0.0],
        "calibration-approximate-field-of-view-water-xy-degree": [float(value) for value in field],
    }


def _item(place: Place | None, frame: RecordedFrame, image: Path, pose: Array) -> dict[str, Any]:
    digest = hashlib.sha256(read_bytes(image, most_bytes=MOST_IMAGE_BYTES)).hexdigest()
    time = _START + timedelta(seconds=frame.time_s)
    turn = np.eye(3) if place is None else place.north_from_scene
    yaw, pitch, roll = yaw_pitch_roll_deg(turn @ pose[:3, :3])
    return {
        "image-uuid": _uuid(digest.encode() + image.name.encode()),
        "image-hash-sha256": digest,
        "image-datetime": time.strftime("%Y-%m-%d %H:%M:%S.%f"),
        "image-camera-yaw-degrees": yaw,
        "image-camera-pitch-degrees": pitch,
        "image-camera-roll-degrees": roll,
        **_position(place, pose),
    }


def _position(place: Place | None, pose: Array) -> dict[str, Any]:
    """Returns the fields of position (EPSG:4326) and pose (4, 4) (UTM, WGS 84) of a camera."""
    # Without a place, iFDO has no field: both are settings of the acquisition, in scene coordinates [m].
    x, y, z = (float(value) for value in pose[:3, 3])
    if place is None:
        settings = {"local-position-meters": [x, y, z], "local-orientation-matrix": pose[:3, :3].tolist()}
        return {"image-acquisition-settings": settings}
    scene, crs = place.origin.from_scene(x, y), place.origin.crs_wkt or ""
    altitude_m = z + place.origin.elevation_m
    longitude, latitude = transformed(crs, WGS84, *scene)[0]
    easting_m, northing_m = transformed(crs, f"EPSG:{place.epsg}", *scene)[0]
    return {
        "image-latitude": round(float(latitude), 9),
        "image-longitude": round(float(longitude), 9),
        "image-altitude-meters": altitude_m,
        "image-camera-pose": {
            "pose-utm-zone": place.zone,
            "pose-utm-epsg": str(place.epsg),
            "pose-utm-east-north-up-meters": [float(easting_m), float(northing_m), altitude_m],
            "pose-absolute-orientation-utm-matrix": (place.utm_from_scene @ pose[:3, :3]).tolist(),
        },
    }


def _uuid(data: bytes) -> str:
    """Returns a UUID of version 4 that depends on `data` only, so that equal exports have equal identifiers."""
    return str(uuid.UUID(bytes=hashlib.sha256(data).digest()[:16], version=4))
