"""Table of a measured or modelled current: velocities over time and height, read from CSV or NetCDF."""

from pathlib import Path

import numpy as np

from twin.core.geometry import Array
from twin.core.user_files import MOST_TEXT_BYTES, reading
from twin.errors import TwinError
from twin.scenario.model import CurrentConfig
from twin.simulate.current_netcdf import netcdf_rows

KEY = "current.file"
_COLUMNS = "time_s", "height_m", "east_mps", "north_mps"
_WANTED = f"CSV with the columns {', '.join(_COLUMNS)} and, if known, up_mps"


def read_current(current: CurrentConfig, file: Path, depth_m: float) -> tuple[Array, Array, Array]:
    """Returns times (t,) [s], heights (h,) above z = 0 [m] and velocities (t, h, 3) [m/s] of a file.

    `depth_m` is the depth of z = 0 below the mean water surface; 0: not stated. Raises TwinError if the file cannot be
    read, is not of the form that its suffix states, or lacks a velocity at any time and height.
    """
    rows = netcdf_rows(file, current, depth_m) if current.is_netcdf else _csv_rows(file)
    times_s, t = np.unique(rows[:, 0], return_inverse=True)
    heights_m, h = np.unique(rows[:, 1], return_inverse=True)
    n_cells = len(times_s) * len(heights_m)
    if len(rows) != n_cells or len(np.unique(t * len(heights_m) + h)) != n_cells or n_cells == 0:
        found = f"{len(rows)} velocities for {len(times_s)} times and {len(heights_m)} heights"
        raise TwinError(KEY, f"{file.name!r} has {found}", "one for each time and height")
    velocity_mps = np.empty((len(times_s), len(heights_m), 3))
    velocity_mps[t, h] = rows[:, 2:]
    return times_s, heights_m, velocity_mps


def _csv_rows(file: Path) -> Array:
    """Returns rows (n, 5) of time [s], height above z = 0 [m], and velocity to east, north and up [m/s]."""
    from pyarrow import csv  # imported here: most scenarios have no such file

    with reading(file, KEY, _WANTED, MOST_TEXT_BYTES):
        table = csv.read_csv(file)
    names = [name.strip() for name in table.column_names]
    if missing := [name for name in _COLUMNS if name not in names]:
        raise TwinError(KEY, f"{file.name!r} has no column {missing[0]}", _WANTED)
    with reading(file, KEY, _WANTED):
        columns = {name: np.asarray(table.column(k), np.float64) for k, name in enumerate(names)}
    used = np.column_stack([columns[name] for name in _COLUMNS] + [columns.get("up_mps", np.zeros(table.num_rows))])
    for row in np.flatnonzero(~np.isfinite(used).all(axis=1)):
        raise TwinError(KEY, f"{file.name!r}: no number in row {row + 2}", "numbers in all rows")
    return used
