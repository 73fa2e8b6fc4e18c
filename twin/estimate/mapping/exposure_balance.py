"""Relative exposures of the images of an orthomosaic, so that an exposure step leaves no seam.

Exposures that the cameras do not report are estimated where images overlap. The logarithm of the mean colour of a patch
c of the floor, at the normalised coordinates (u, v) of image k, is modelled as

    y_kc = a_c + g_k + b1 u + b2 v + b3 u^2 + b4 u v + b5 v^2

with the colour a_c, the exposure g_k and the pattern b of the lamps, common to all images: least squares with weak
zero-mean priors on g and b, for each colour band.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import spsolve

from twin.core import geometry
from twin.core.records import Array, ElevationMap, Exposure, Image, StereoRig

_PRIOR = 1e-3  # weight of an exposure or a coefficient of the pattern, relative to a patch in one image
_PATCH_PX = 16  # spacing of the patches; the standard deviation of the Gaussian average of their colours is a quarter
_BATCH = 2**14  # number of patches that `cv2.remap` reads at a time; it refuses arrays of more than 32766 rows
_MIN_LEVEL = 4.0  # darkest mean colour that is used [grey levels]


class PatchColours(NamedTuple):
    patch: NDArray[np.int64]  #: (n,) number of each patch
    log_colour: Array  #: (n, 3) natural logarithm of the mean colour of each patch [grey levels]
    position: Array  #: (n, 2) normalised image coordinates of the centre of each patch


def reported_factors(exposures: Sequence[Exposure | None]) -> Array | None:
    """Returns the factors (n, 3) that make the exposures of n images equal; None if one is unknown, or n is 0."""
    known = [exposure for exposure in exposures if exposure is not None]
    if not known or len(known) < len(exposures):
        return None
    logarithm = np.log(np.array(known))
    return np.exp(logarithm.mean(axis=0) - logarithm)


def patch_points(elevation: ElevationMap, rig: StereoRig, depth_m: float) -> Array:
    """Returns the centres (n, 3) of the patches in map axes [m]: known cells about `_PATCH_PX` pixels apart."""
    step = max(1, round(_PATCH_PX * depth_m / rig.focal_px / elevation.grid.cell_m))
    x, y = elevation.grid.centres()
    height = elevation.height_m[::step, ::step]
    points = np.stack([*np.meshgrid(x[::step], y[::step]), height], axis=-1).reshape(-1, 3).astype(np.float64)
    return points[np.isfinite(points[:, 2])]


def patch_colours(image: Image, world_from_camera: Array, rig: StereoRig, points: Array) -> PatchColours:
    """Returns the Gaussian mean colours of patches (n, 3) [m] that are completely in an image and not too dark."""
    pixel = np.nan_to_num(rig.project(geometry.transform(geometry.inverse(world_from_camera), points)), nan=-1.0)
    last = np.array([rig.width_px - 1, rig.height_px - 1]) - _PATCH_PX / 2
    patch = np.flatnonzero(((pixel >= _PATCH_PX / 2) & (pixel <= last)).all(axis=1))
    blurred = cv2.GaussianBlur(image.astype(np.float32), (0, 0), _PATCH_PX / 4)
    at = pixel[patch].astype(np.float32)
    colour = np.zeros((len(patch), 3))
    for first in range(0, len(patch), _BATCH):
        part = at[first : first + _BATCH]
        colour[first : first + _BATCH] = cv2.remap(blurred, part[:, :1], part[:, 1:], cv2.INTER_LINEAR).reshape(-1, 3)
    bright = colour.min(axis=1, initial=np.inf) > _MIN_LEVEL
    return PatchColours(patch[bright], np.log(colour[bright]), rig.normalised(at[bright]))


def estimated_factors(colours: Iterable[PatchColours]) -> Array:
    """Returns the factors (n, 3) that make the exposures of n images equal, from their patches; 1 without patches."""
    views = list(colours)
    image = np.repeat(np.arange(len(views)), [len(view.patch) for view in views])
    if not len(image):
        return np.ones((len(views), 3))
    y = np.concatenate([view.log_colour for view in views])
    u, v = np.concatenate([view.position for view in views]).T
    _, patch = np.unique(np.concatenate([view.patch for view in views]), return_inverse=True)
    ones, row = np.ones(len(image)), np.arange(len(image))
    pattern = np.column_stack([u, v, u**2, u * v, v**2])
    terms = sparse.hstack(
        [sparse.csr_matrix((ones, (row, image)), (len(image), len(views))), sparse.csr_matrix(pattern)]
    ).tocsr()
    shows = sparse.csr_matrix((ones, (row, patch)))
    # the elimination of the patches leaves the normal equations of exposures and pattern
    per_view = sparse.diags(1 / np.asarray(shows.sum(axis=0)).ravel())
    shared = (shows.T @ terms).tocsr()
    normal = terms.T @ terms - shared.T @ per_view @ shared + _PRIOR * sparse.identity(len(views) + pattern.shape[1])
    right = terms.T @ (y - shows @ (per_view @ (shows.T @ y)))
    solution = np.asarray(spsolve(sparse.csc_matrix(normal), right)).reshape(-1, 3)[: len(views)]
    return np.exp(solution.mean(axis=0) - solution)
