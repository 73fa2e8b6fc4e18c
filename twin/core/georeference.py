"""Georeference of a scene: where its origin lies in the coordinate reference system (CRS) of a measured DEM."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Georeference:
    """Position of the scene in a horizontal CRS and a vertical datum, to whose axes the scene axes are parallel.

    With the origin (E0, N0, H0) and k metres per unit of the CRS, a scene point (x, y, z) [m] lies at E = E0 + x / k,
    N = N0 + y / k and at the elevation H0 + z.
    """

    #: easting, northing: coordinates E0, N0 of the scene origin in the CRS, in its unit.
    easting: float
    northing: float
    elevation_m: float = 0.0  #: elevation H0 of the plane z = 0 above the zero of the vertical datum, positive upwards
    crs_wkt: str | None = None  #: CRS as WKT; None: the source has coordinates but does not name their CRS
    metres_per_unit: float = 1.0  #: length k of the horizontal unit of the CRS
    vertical_datum: str = ""  #: name of the vertical CRS; "" if the source does not name it

    def to_scene(self, easting: ArrayLike, northing: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        x = (np.asarray(easting, np.float64) - self.easting) * self.metres_per_unit
        return x, (np.asarray(northing, np.float64) - self.northing) * self.metres_per_unit

    def from_scene(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        easting = self.easting + np.asarray(x_m, np.float64) / self.metres_per_unit
        return easting, self.northing + np.asarray(y_m, np.float64) / self.metres_per_unit
