"""Measured motions as they are drawn, compiled: frame to frame, between keyframes, against a mosaic."""

from __future__ import annotations

import numpy as np
from numba import njit

from twin.core import geometry
from twin.core.geometry import Array
from twin.estimate.vision import observation_equations

LEAST_POINTS = 6  # for a motion


@njit(cache=True, nogil=True)
def moved(errors, last, now, numbers, last_numbers):
    """The motion (4, 4) from one true pose to the next as F2F tells it, with an error by standard normal numbers (6,).

    Args:
        last_numbers: those of the motion before.
    """
    error = np.zeros(6)
    for i in range(6):
        for k in range(6):
            error[i] += errors.root[i, k] * (numbers[k] - errors.undone * last_numbers[k])
    return geometry.compose(geometry.compose(geometry.inverse(last), now), geometry.exp(error))


@njit(cache=True, nogil=True)
def link(
    points, here, there, relief, numbers, there_pose, here_pose, camera, cov, root, steady, relief_size, common, apart,
    common_claim, correlation,
):  # fmt: skip
    """How many points two keyframes both see, and the motion (4, 4) between them with its claimed covariance (6, 6).

    Args:
        points: (n, 3) of the later keyframe.
        here: (n, 3) standard normal: what the later pair errs by at these points.
        there: (rows, cols, 3) the same of the earlier pair, over its image.
        relief: (f, f, 2) standard normal: what the floor makes matches err by, the same whoever matches there.
        numbers: (n + 1, 3) standard normal: what it errs by in this match alone, and a bias that all points share.
        there_pose, here_pose: (4, 4) true poses.
        cov, root: (3, 3) claimed covariance of a point in either pair, root of the true one.
        steady: share of the earlier pair in what a match errs by; the rest is its own.
        relief_size: deviation of what relief makes it err by for every depth that the two are apart.
        common, common_claim: deviation of the bias, and the one claimed.
        apart: by how much a match is claimed to err more for every depth that the two are apart.
    """
    focal, cx, cy, width, height, margin, baseline = camera
    there_from_here, bias = geometry.inverse(there_pose) @ here_pose, numbers[-1] * common
    seen, _, _ = observation_equations.transfer(points, there_from_here, baseline)
    inverse_depth = np.mean(points[:, 2]) / baseline
    way, cell_m = inverse_depth * there_from_here[:3, 3], width / focal / there.shape[1] / inverse_depth
    n, passing, farther = 0, np.sqrt(1 - steady * steady), apart**2 * np.sum(way**2)
    a, b = np.empty_like(points), np.empty_like(points)
    for k in range(len(points)):
        u, v = seen[k, 0] * focal + cx, seen[k, 1] * focal + cy
        if margin <= u < width - margin and margin <= v < height - margin and u - focal * seen[k, 2] >= margin:
            cell = there[int(v / height * there.shape[0]), int(u / width * there.shape[1])]
            row, col = _floor_cell(here_pose, points[k], baseline, cell_m, len(relief))
            askew, along = relief_size * relief[row, col, 0], relief_size * relief[row, col, 1]
            for r in range(3):
                a[n, r], b[n, r] = seen[k, r] + bias[r], points[k, r]
                for c in range(r + 1):
                    a[n, r] += root[r, c] * (steady * cell[c] + passing * numbers[k, c])
                    b[n, r] += root[r, c] * here[k, c]
            a[n, 0] += way[1] * askew
            a[n, 1] += way[0] * askew + 2 * way[1] * along
            n += 1
    a, b, farther_cov = a[:n], b[:n], cov * (1 + farther)
    covs, farther_covs = np.empty((n, 3, 3)), np.empty((n, 3, 3))
    for k in range(n):
        geometry.put(covs[k], cov)
        geometry.put(farther_covs[k], farther_cov)
    error, _, by_motion, information, _ = observation_equations.linearised(
        a, b, b, farther_covs, covs, there_from_here, baseline
    )
    normal, right, by_common = observation_equations.reduced(error, by_motion, information, np.ones(n))
    if n < LEAST_POINTS:
        return n, there_from_here, normal
    inverse = np.linalg.inv(normal)
    shared = inverse @ by_common * common_claim
    return n, there_from_here @ geometry.exp(inverse @ right), inverse * correlation + shared @ shared.T


@njit(cache=True, nogil=True, inline="always")
def _floor_cell(pose, point, baseline, cell_m, n):
    """Row and column of the floor's cell that a camera measures at (x, y, disparity), of n that repeat."""
    depth = baseline / point[2]
    x = pose[0, 3] + depth * (pose[0, 0] * point[0] + pose[0, 1] * point[1] + pose[0, 2])
    y = pose[1, 3] + depth * (pose[1, 0] * point[0] + pose[1, 1] * point[1] + pose[1, 2])
    return int(np.floor(y / cell_m)) % n, int(np.floor(x / cell_m)) % n


@njit(cache=True, nogil=True)
def unit_motion(points: Array, baseline: float, n_weight: float) -> tuple[Array, Array]:
    """Covariance (6, 6), and its root, of a motion by eq. (2) where so many points like these (n, 3) err by one."""
    n = len(points)
    rows = observation_equations.image_motion(points[:, 0], points[:, 1], baseline / points[:, 2])
    normal, _ = observation_equations.normal_equations(rows, np.full(n, n_weight / n), np.zeros((n, 2)))
    cov = np.ascontiguousarray(np.linalg.inv(normal))
    return cov, np.linalg.cholesky(cov)  # pyright: ignore[reportReturnType]


@njit(cache=True, nogil=True)
def mosaic_offset(believed, true, shares, now, world_from_camera):
    """What a mosaic of keyframes at poses (n, 4, 4), laid where they were believed to be, says of a predicted pose."""
    predicted_from_world, offset = geometry.inverse(world_from_camera), np.zeros(6)
    for k in range(len(shares)):
        told = believed[k] @ geometry.inverse(true[k]) @ now
        offset += shares[k] * geometry.log(predicted_from_world @ told)
    return offset
