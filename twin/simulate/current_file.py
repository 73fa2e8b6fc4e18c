"""Table of a measured or modelled current: velocities over time and height, read from CSV or NetCDF."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from twin.core.geometry import Array
from twin.core.optional_packages import optional
from twin.core.user_files import MOST_TEXT_BYTES, reading
from twin.errors import TwinError
from twin.scenario.model import CurrentConfig

KEY = "current.file"
_COLUMNS = "time_s", "height_m", "east_mps", "north_mps"
_WANTED = f"CSV with the columns {', '.join(_COLUMNS)} and, if known, up_mps"
_PLACE_KEY = "current.file_place_deg"
_EAST, _NORTH, _UP = "eastward_sea_water_velocity", "northward_sea_water_velocity", "upward_sea_water_velocity"
_NETCDF = f"NetCDF of the CF convention with {_EAST}, {_NORTH} and, if known, {_UP}"
_DIRECTIONS = {"depth": "down", "height_above_sea_floor": "up"}  # unless the attribute `positive` states another
_UNITS = {
    **dict.fromkeys((_EAST, _NORTH, _UP), ("m s-1", "m/s", "m.s-1", "m s^-1", "meter second-1", "metre second-1")),
    **dict.fromkeys(_DIRECTIONS, ("m", "metre", "metres", "meter", "meters")),
    "longitude": ("degrees_east", "degree_east", "degrees_E", "degree_E"),
    "latitude": ("degrees_north", "degree_north", "degrees_N", "degree_N"),
}
_LARGEST = (np.inf, np.inf, 20.0, 20.0, 20.0)  # in a row; faster: the fill value of a file that declares none
_MOST_VALUES = 10**7  # of a component of the velocity at the place


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
        wanted = {name: table.column(k) for k, name in enumerate(names) if name in (*_COLUMNS, "up_mps")}
        columns = {name: np.asarray(column, np.float64) for name, column in wanted.items()}
    used = np.column_stack([columns[name] for name in _COLUMNS] + [columns.get("up_mps", np.zeros(table.num_rows))])
    for row in np.flatnonzero(~np.isfinite(used).all(axis=1)):
        raise TwinError(KEY, f"{file.name!r}: no number in row {row + 2}", "numbers in all rows")
    return used


def netcdf_rows(file: Path, current: CurrentConfig, depth_m: float) -> Array:
    """Returns rows (n, 5) of time [s], height above z = 0 [m], and velocity to east, north and up [m/s].

    Levels and times without a velocity, as those of a model below its floor, are left out. `depth_m` is the depth of
    z = 0 below the mean water surface; 0: not stated. Raises TwinError if xarray is not installed, the file cannot be
    read or is not of this form, or the place is not in it.
    """
    xarray = optional("xarray", "ocean", KEY)
    optional("netCDF4", "ocean", KEY)
    with reading(file, KEY, _NETCDF):  # an absolute path: xarray takes other names for addresses
        with xarray.open_dataset(file.absolute(), engine="netcdf4", decode_timedelta=False) as data:
            columns = xarray.broadcast(*_columns(data, current, depth_m))
            rows = np.zeros((columns[0].size, 5))
            rows[:, : len(columns)] = np.column_stack([column.values.ravel() for column in columns])
    kept = rows[(np.abs(rows) < _LARGEST).all(axis=1)]
    for k, what in enumerate(("time", "level")):
        if len(np.unique(rows[:, k])) > 1 and len(np.unique(kept[:, k])) < 2:
            raise TwinError(KEY, f"{file.name!r} has velocities at less than two of its {what}s", "a complete table")
    return kept


def _columns(data: Any, current: CurrentConfig, depth_m: float) -> list[Any]:
    """Returns times [s], heights [m] and velocities [m/s] at the place, which vary along time and level alone."""
    parts = [*_named(data, _EAST), *_named(data, _NORTH)]
    if len(parts) < 2:
        raise ValueError(f"it has not both {_EAST} and {_NORTH}")
    dims = parts[0].dims
    time = next((dim for dim in dims if dim in data.variables and data[dim].dtype.kind == "M"), None)
    parts = [_heights_m(data, dims, depth_m), *parts, *_named(data, _UP)]
    place = _place(data, dims, time, current)
    heights_m, *parts = (part.isel(place, missing_dims="ignore").squeeze() for part in parts)
    levels = set(heights_m.dims)
    for part in parts:
        if len(levels) > 1 or time in levels or set(part.dims) - {time} != levels or part.size > _MOST_VALUES:
            problem = f"{part.name} has {dict(part.sizes)}, the levels {dict(heights_m.sizes)}"
            raise TwinError(KEY, problem, f"velocities along time and level, with {_PLACE_KEY} if at several places")
    if time not in parts[0].dims:
        return [0 * heights_m, heights_m, *parts]
    start = np.datetime64(current.file_start or data[time].values.min())
    return [(data[time] - start) / np.timedelta64(1, "s"), heights_m, *parts]


def _named(data: Any, name: str, dims: Iterable[str] | None = None) -> list[Any]:
    """Returns a list of the variable with a standard name along no other dimensions than `dims`, empty without one."""
    named = [data[key] for key, variable in data.variables.items() if variable.attrs.get("standard_name") == name]
    found = [variable for variable in named if dims is None or set(variable.dims) <= set(dims)]
    units = [variable.attrs.get("units") for variable in found]
    if len(found) > 1 or not set(units) <= set(_UNITS[name]):
        raise ValueError(f"{name} of {len(found)} variables, in {units}, not of one in {_UNITS[name][0]!r}")
    return found


def _heights_m(data: Any, dims: Iterable[str], depth_m: float) -> Any:
    """Returns the heights of the levels above z = 0 [m]; heights above the sea floor count as such."""
    found = {name: levels for name in _DIRECTIONS for levels in _named(data, name, dims)}
    if len(found) != 1:
        raise ValueError(f"it has {len(found)} vertical coordinates of the standard names {', '.join(_DIRECTIONS)}")
    ((name, levels),) = found.items()
    positive = str(levels.attrs.get("positive", _DIRECTIONS[name])).lower()
    upwards = levels.astype(np.float64) * {"up": 1.0, "down": -1.0}.get(positive, np.nan)
    if not (upwards <= 0 if name == "depth" else upwards >= 0).all():
        raise ValueError(f"{levels.name}, positive {positive}, is outside the water")
    if name == "depth" and depth_m == 0:
        raise TwinError("waves.depth_m", f"missing: {KEY} has levels below the surface", "above 0, or sun.depth_m")
    return upwards + depth_m if name == "depth" else upwards


def _place(data: Any, dims: Iterable[str], time: str | None, current: CurrentConfig) -> dict[str, int]:
    """Returns the index along each horizontal dimension of the place nearest to the stated one, if one is stated."""
    found, place = [*_named(data, "longitude", dims), *_named(data, "latitude", dims)], current.file_place_deg
    if any(time in part.dims for part in found):
        raise ValueError("its place changes with time")
    if place is None:
        return {}
    if len(found) < 2:
        raise TwinError(_PLACE_KEY, f"{list(place)}: {KEY} has no longitude and latitude", "no value")
    east = (found[0] - place[0] + 180) % 360 - 180
    north = found[1] - place[1]
    if not (east.min() <= 0 <= east.max() and north.min() <= 0 <= north.max()):
        raise TwinError(_PLACE_KEY, f"{list(place)}: outside the places of {KEY}", "a place between them")
    distance = np.hypot(east * np.cos(np.radians(place[1])), north)
    return {dim: int(index) for dim, index in distance.argmin(distance.dims).items()}
