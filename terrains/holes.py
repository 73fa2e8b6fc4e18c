"""Cells of a height file without a height."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from twin.terrains.file_header import height_error

_NODATA = (-9999.0, 9999.0, -99999.0, 99999.0, -32768.0, -32767.0, 32767.0, 65535.0)
#: Holes are small if they are enclosed, and no node in them is farther than this many grid spacings from a height. So
#: are gaps between scattered heights: what a morphological closing fills, by a square that reaches so many spacings.
_SMALL = 2
#: A value marks holes if it is farther from all heights than this [m], and than their range times `_MOST_RANGES`.
_LEAST_GAP, _MOST_RANGES = 100.0, 10.0


def check_no_undeclared_holes(
    values: NDArray[np.float64], file: Path, remedy: str, metres_per_unit: float = 1.0
) -> list[str]:
    """Raises TwinError if the least or greatest value can only mark holes; `remedy` says how to declare "{}".

    Returns a sentence for each of them that may mark holes: in several cells, and far from the others for their range.
    """
    doubts, finite = list[str](), values[np.isfinite(values)]
    for value in (finite.min(initial=np.inf), finite.max(initial=-np.inf)):
        heights = finite[(finite != value) & ~np.isin(finite, _NODATA)]
        if heights.size == 0:
            continue
        low, high, n_cells = heights.min(), heights.max(), np.count_nonzero(finite == value)
        gap, problem = max(low - value, value - high), f"has the value {value:g} in {n_cells} cells, far from"
        problem += f" all others ({low:g} to {high:g}), and does not declare it as nodata"
        if gap > max(_LEAST_GAP / metres_per_unit, _MOST_RANGES * (high - low)):
            raise height_error(file, problem, remedy.format(f"{value:g}"))
        if n_cells > 1 and gap > high - low:
            doubts.append(f"{file.name!r} {problem}.")
    return doubts


def fill_holes(height_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns heights with the nearest one in place of values that are not finite."""
    holes = ~np.isfinite(height_m)
    if not holes.any():
        return height_m
    nearest = ndimage.distance_transform_edt(holes, return_distances=False, return_indices=True)
    assert nearest is not None
    return height_m[tuple(nearest)]


def known_nodes(given: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    """Returns the nodes (ny, nx) with a height (`given`, at least one) or in a small hole; None if all nodes are."""
    if given.all():
        return None
    labelled, n = ndimage.label(~given, np.ones((3, 3)))  # pyright: ignore
    holes, distance = np.asarray(labelled, np.int64), np.asarray(ndimage.distance_transform_edt(~given))
    small = np.append(False, np.asarray(ndimage.maximum(distance, holes, np.arange(1, n + 1))) <= _SMALL)
    small[np.concatenate([holes[0], holes[-1], holes[:, 0], holes[:, -1]])] = False  # open at the border
    closed = np.asarray(ndimage.binary_closing(given, np.ones((2 * _SMALL + 1,) * 2)), np.bool_)
    known = given | small[holes] | closed
    return None if known.all() else known
