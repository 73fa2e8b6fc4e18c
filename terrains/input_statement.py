"""Statement of how the files of a floor were read."""

from typing import NamedTuple


class InputStatement(NamedTuple):
    """Interpretation of the files of a floor; evidence is a key of the scenario, a part of the file, or assumed."""

    file: str  #: name of the file of the floor
    crs: str  #: as `HeightFile.crs`
    ground_scale: float | None  #: as `HeightFile.ground_scale`
    spacing_m: float  #: distance between the nodes of the height grid
    spacing_evidence: str
    metres_per_unit: float  #: length of the unit of the values
    unit_evidence: str
    direction: str  #: "up" or "down", the direction in which the values of the file increase
    direction_evidence: str
    least: float  #: least and greatest value of the file, in its unit
    greatest: float
    nodata: str  #: as `HeightFile.nodata`
    share_without_height: float  #: share of the nodes of the height grid that have no height in the file
    texture: str  #: origin of the colours
    doubts: tuple[str, ...] = ()  #: as `HeightFile.doubts`
