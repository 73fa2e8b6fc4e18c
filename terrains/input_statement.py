"""What a file of heights states, and the statement of how the files of a floor were read."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.georeference import Georeference
from twin.terrains.vertical_axis import VerticalAxis


class HeightFile(NamedTuple):
    """Values of a file of heights, before holes are filled, with what the file states of them."""

    values: NDArray[np.float64]  #: (rows, cols), row 0 = north; NaN where the file has no height
    spacing_m: float  #: distance between neighbouring values
    axis: VerticalAxis
    georeference: Georeference | None = None  #: position of the centre in the CRS of the file; None without coordinates
    crs: str = ""  #: name of the horizontal CRS; "" without one
    ground_scale: float | None = None  #: distance on the ground / distance in a projected CRS, at the centre
    nodata: str = ""  #: value or band by which the file declares cells without a height; "" if it declares none
    doubts: tuple[str, ...] = ()  #: sentences on values that may mark cells without a height


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
    doubts: tuple[str, ...] = ()  #: sentences on what may be wrong, for warnings

    def as_json(self) -> dict[str, Any]:
        return self._asdict() | {"doubts": list(self.doubts)}
