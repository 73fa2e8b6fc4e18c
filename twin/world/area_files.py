"""Survey areas in files of other programs: polygons of KML, surveys of a plan of QGroundControl."""

from pathlib import Path
from xml.etree import ElementTree

import shapely

from twin.core.user_files import read_bytes, read_json, reading

KEY = "plan.polygon"
MOST_BYTES = 10_000_000  #: of a file of an area
_KML = "KML with one Polygon or more"
_QGC = "a .plan of QGroundControl with one survey or more"


def kml_polygons(file: Path) -> list[shapely.Polygon]:
    """Returns the polygons of a KML file in longitude and latitude; points and lines are left out.

    Raises TwinError if it is not valid, has a document type (which may name other files) or no polygon.
    """
    data = read_bytes(file, KEY, _KML, MOST_BYTES)
    with reading(file, KEY, _KML):
        if b"<!" in data.replace(b"<!--", b"").replace(b"<![CDATA[", b"") or b"\0" in data:
            raise ValueError("a document type or an encoding other than UTF-8")
        polygons = [_kml_polygon(found) for found in ElementTree.fromstring(data).iterfind(".//{*}Polygon")]
        if not polygons:
            raise ValueError("no polygon")
        return polygons


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
    """Returns the areas of the surveys in a plan of QGroundControl, in longitude and latitude.

    Raises TwinError if it is not valid or has no survey; its geofence, a limit of the vehicle, is left out.
    """
    tree = read_json(file, KEY, _QGC, MOST_BYTES)
    with reading(file, KEY, _QGC):
        surveys = [item for item in tree["mission"]["items"] if item.get("complexItemType") == "survey"]
        if not surveys:
            raise ValueError("no survey")
        return [shapely.Polygon([corner[::-1] for corner in item["polygon"]]) for item in surveys]
