"""Survey areas in files of other programs: polygons of KML, survey areas of a plan of QGroundControl."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import shapely

from twin.core.user_files import read_bytes, read_json, reading

KEY = "plan.polygon"
MOST_BYTES = 10_000_000  #: of a file of an area
_KML = "KML with one Polygon or more"
_QGC = "a .plan of QGroundControl with a survey or an inclusion polygon of its geofence, and no circles"


def kml_polygons(file: Path) -> list[shapely.Polygon]:
    """Returns the polygons of a KML file in longitude and latitude; points and lines are left out.

    Raises TwinError if it is not valid, has a document type (which may name other files) or no polygon.
    """
    data = read_bytes(file, KEY, _KML, MOST_BYTES)
    with reading(file, KEY, _KML):
        if b"<!" in data.replace(b"<!--", b"").replace(b"<![CDATA[", b"") or b"\0" in data:
            raise ValueError("a document type or an encoding other than UTF-8")
        polygons = [_kml_polygon(found) for found in ElementTree.fromstring(data).iter() if _is(found, "Polygon")]
        if not polygons:
            raise ValueError("no polygon")
        return polygons


def _is(element: ElementTree.Element, name: str) -> bool:
    return element.tag.rpartition("}")[2] == name


def _kml_polygon(element: ElementTree.Element) -> shapely.Polygon:
    outer, inner = (
        [_kml_ring(text) for text in element.findall(f"{{*}}{side}/{{*}}LinearRing/{{*}}coordinates")]
        for side in ("outerBoundaryIs", "innerBoundaryIs")
    )
    (outline,) = outer
    return shapely.Polygon(outline, inner)


def _kml_ring(coordinates: ElementTree.Element) -> list[tuple[float, float]]:
    triples = [triple.split(",") for triple in (coordinates.text or "").split()]
    return [(float(longitude), float(latitude)) for longitude, latitude, *_ in triples]


def qgc_polygons(file: Path) -> list[shapely.Polygon]:
    """Returns the areas of a plan of QGroundControl in longitude and latitude.

    They are those of its surveys or, without a survey, the inclusion polygons of its geofence, less the exclusion
    polygons. Raises TwinError if it is not valid, has none of these, or has circles in its geofence.
    """
    tree = read_json(file, KEY, _QGC, MOST_BYTES)
    with reading(file, KEY, _QGC):
        fence = tree.get("geoFence", {})
        if fence.get("circles"):
            raise ValueError("its geofence has circles")
        surveys = [item for item in tree["mission"]["items"] if item.get("complexItemType") == "survey"]
        fences = {
            side: [one for one in fence.get("polygons", []) if one["inclusion"] is side] for side in (True, False)
        }
        polygons = [_qgc_polygon(item) for item in surveys or fences[True]]
        if not polygons:
            raise ValueError("neither a survey nor an inclusion polygon")
        if not fences[False]:
            return polygons
        left = shapely.union_all(polygons) - shapely.union_all([_qgc_polygon(one) for one in fences[False]])
        return [part for part in shapely.get_parts(left) if isinstance(part, shapely.Polygon) and not part.is_empty]


def _qgc_polygon(item: dict[str, Any]) -> shapely.Polygon:
    return shapely.Polygon([(longitude, latitude) for latitude, longitude in item["polygon"]])
