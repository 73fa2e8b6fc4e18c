"""Contents of a file of heights, before holes are filled and values are converted to heights in metres."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.georeference import Georeference
from twin.terrains.vertical_axis import VerticalAxis


class HeightFile(NamedTuple):
    """Values of a file of heights, with what the file states of them."""

    values: NDArray[np.float64]  #: (rows, cols), row 0 = north; NaN where the file has no height
    spacing_m: float  #: distance between neighbouring values
    axis: VerticalAxis
    georeference: Georeference | None = None  #: position of the centre in the CRS of the file; None without coordinates
    crs: str = ""  #: name of the horizontal CRS; "" without one
    ground_scale: float | None = None  #: distance on the ground / distance in a projected CRS, at the centre
    nodata: str = ""  #: value or band by which the file declares cells without a height; "" if it declares none
    doubts: tuple[str, ...] = ()  #: sentences on values that may mark cells without a height
