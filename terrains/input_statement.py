"""Statement of the input of a floor: how its files were read, on what evidence, and what was assumed."""

from __future__ import annotations

from typing import Any, NamedTuple

ASSUMED = "assumed: it names none"  #: evidence of a unit or a direction that a file does not state


class InputStatement(NamedTuple):
    """Interpretation of the files of a floor. Evidence is a key of the scenario, a part of the file, or an assumption."""

    file: str  #: name of the file of the floor
    crs: str  #: name of the CRS of its coordinates; "" without one
    ground_scale: float | None  #: distance on the ground / distance in the CRS, at the centre; None if not known
    spacing_m: float  #: distance between the nodes of the height grid
    spacing_evidence: str
    metres_per_unit: float  #: length of the unit of the values
    unit_evidence: str
    direction: str  #: "up" or "down", the direction in which the values of the file increase
    direction_evidence: str
    least: float  #: least and greatest value of the file, in its unit
    greatest: float
    nodata: str  #: value or band by which the file declares cells without a height; "" if it declares none
    share_without_height: float  #: share of the nodes of the height grid that have no height in the file
    texture: str  #: origin of the colours
    doubts: tuple[str, ...] = ()  #: sentences on what may be wrong, for warnings

    def as_json(self) -> dict[str, Any]:
        return self._asdict() | {"doubts": list(self.doubts)}
