"""Errors of the calibration that the motions between keyframes show: an offset of all disparities, and wrong lengths.

An offset of all disparities (principal point, yaw of a camera) is observable over relief, where the image motions of
near and far points must be proportional to their disparities. Over a level floor it is not, and the scatter between
links does not reveal that.

Lengths are compared with those of DVL, USBL and pressure. An error of the baseline scales all lengths, one of the focal
length only those along the optical axis, whose scale is observable only where the camera moves along it.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.links import Link, Links
from twin.core.quality import CalibrationEstimate, DisparityOffset, EpipolarError, LengthScale
from twin.core.records import SensorNoise, StereoRig
from twin.estimate.link_selection import RECURRENCE
from twin.estimate.navigation.aiding import unary_factors
from twin.estimate.navigation.dvl import body_displacement
from twin.estimate.vision.stereo import Keyframe
from twin.kernels import kernel

MAX_LINK_SIGMA_PX = 0.3  #: largest median sigma by a single link with which an offset is observable [px]
_MOST_SIGMA = 0.1  # a scale with a larger standard deviation is not observed
SIGNIFICANT = 4.0  #: standard deviations
_SHARE = 3.0  # a sensor is named if its standard deviation is at most this many times that of all sensors together


def disparity_offset(offsets: ArrayLike, n_nodes: int, n_views: float, focal_px: float) -> DisparityOffset | None:
    """Returns the `weighted_mean` of the offsets of the links; None without offsets or nodes, or if not observable."""
    offsets = np.reshape(offsets, (-1, 2))
    if not len(offsets) or n_nodes < 1 or np.median(offsets[:, 1]) * focal_px > MAX_LINK_SIGMA_PX:
        return None
    return DisparityOffset(*weighted_mean(offsets, n_nodes, n_views))


def weighted_mean(offsets: Array, n_nodes: int, n_views: float) -> tuple[float, float]:
    """Returns the weighted mean of estimates (n, 2) by links, with sigmas of independent links, and its sigma.

    The variance is multiplied by the links per node, which share stereo points (if above 1), by 1 + c (m - 1) for nodes
    that share the errors of relief, with c = `RECURRENCE` and m = `n_views` (`mean_views`), and by the mean chi-square
    if above 1.
    """
    value, sigma = offsets.T.copy()
    weight = sigma**-2
    mean = float(np.sum(weight * value) / np.sum(weight))
    chi2 = float(np.mean(weight * (value - mean) ** 2))
    shared_by = max(len(offsets) / n_nodes, 1.0) * (1 + RECURRENCE * (n_views - 1))
    variance = max(chi2, 1.0) * shared_by / float(np.sum(weight))
    return mean, variance**0.5


def row_pattern(
    epipolar: EpipolarError, calibration: CalibrationEstimate, offset: DisparityOffset | None, rig: StereoRig
) -> float:
    """Returns the RMS of the systematic row difference that no rotation of a camera explains [focal lengths]."""
    # a yaw by the rows that the motions exclude is a distortion
    yaw_rad = float(epipolar.estimate[1]) - calibration.yaw_rad
    if not contradicts(offset, yaw_rad):
        return epipolar.pattern
    corner = np.array([rig.width_px, rig.height_px]) / 2 / rig.focal_px
    return float(np.hypot(epipolar.pattern, yaw_rad * np.prod(corner) / 3))  # RMS of yaw x y over the image


def contradicts(offset: DisparityOffset | None, yaw_rad: float) -> bool:
    """Returns whether the motions of near and far points exclude the offset of disparities that a yaw causes."""
    return offset is not None and abs(offset.estimate) + SIGNIFICANT * offset.sigma < abs(yaw_rad)


def mean_views(world_from_camera: Array, depth_m: Array, rig: StereoRig) -> float:
    """Returns the mean number of nodes that see a floor point in the image of a node, this node included.

    It is the mean sum of a node's overlaps with all nodes, of poses (n, 4, 4) and median depths (n,). The overlap of
    two images is that of their rectangles on a plane parallel to the first one at its depth; rotations are neglected.
    """
    per_unit = rig.fx_px / rig.width_px, rig.fy_px / rig.height_px
    return float(_sum_of_overlaps(world_from_camera, depth_m, *per_unit)) / len(depth_m) if len(depth_m) else 1.0


@kernel
def _sum_of_overlaps(poses, depth_m, images_per_x, images_per_y):
    total = 0.0
    for i, r in enumerate(poses):
        for k in range(len(poses)):
            x, y, z = poses[k, 0, 3] - r[0, 3], poses[k, 1, 3] - r[1, 3], poses[k, 2, 3] - r[2, 3]
            across = abs(r[0, 0] * x + r[1, 0] * y + r[2, 0] * z) / depth_m[i] * images_per_x
            along = abs(r[0, 1] * x + r[1, 1] * y + r[2, 1] * z) / depth_m[i] * images_per_y
            total += max(1 - across, 0.0) * max(1 - along, 0.0)
    return total


def lasting_residuals(nodes: Sequence[Keyframe], rig: StereoRig, noise: SensorNoise) -> dict[str, float]:
    """Returns by sensor the RMS of the residuals that successive readings share / their noise, where significant.

    The mean product of n pairs of white residuals is 0 with the standard deviation v / sqrt(n), for their variance v,
    half the mean squared difference (von Neumann 1941). The excess is the variance of errors of path or sensor.
    """
    poses, found = np.array([node.world_from_camera for node in nodes]).reshape(-1, 4, 4), dict[str, float]()
    for name, factors in zip(("pressure", "AHRS", "USBL"), unary_factors(nodes, rig, noise)[:3], strict=True):
        if len(factors.pose_index) > 1:
            whitened = factors.residuals(poses[factors.pose_index]) @ np.linalg.cholesky(factors.information[0])
            shared, variance = whitened[1:] * whitened[:-1], float((np.diff(whitened, axis=0) ** 2).mean()) / 2
            if shared.mean() > SIGNIFICANT * max(variance, 1.0) / np.sqrt(shared.size):
                found[name] = float(np.sqrt(shared.mean()))
    return found


class _Fit(NamedTuple):
    """Factors (2,) by which lengths across and along the optical axis agree with a sensor, and covariance (2, 2)."""

    factors: Array
    cov: Array


def length_scales(
    nodes: Sequence[Keyframe], links: Links, rig: StereoRig, noise: SensorNoise
) -> tuple[LengthScale | None, LengthScale | None]:
    """Returns the scales of the lengths from the images across and along the optical axis; None where not observed."""
    number = np.array([node.number for node in nodes])
    at_i, at_j = np.searchsorted(number, links.i), np.searchsorted(number, links.j)
    consecutive = links.select((links.n_points > 0) & (at_j == at_i + 1))
    measured = {link.j: link for link in consecutive}
    steps = [measured.get(node.number) for node in nodes[1:]]
    fits = {name: fit for name, fit in _fits(nodes, steps, rig, noise) if fit is not None}
    if not fits:
        return None, None
    cov = np.linalg.inv(np.sum([np.linalg.inv(fit.cov) for fit in fits.values()], axis=0))
    factors = cov @ np.sum([np.linalg.solve(fit.cov, fit.factors) for fit in fits.values()], axis=0)
    return _scale(0, factors, cov, fits), _scale(1, factors, cov, fits)


def _scale(k: int, factors: Array, cov: Array, fits: dict[str, _Fit]) -> LengthScale | None:
    """Returns the scale k (0 across, 1 along the axis); None if its standard deviation exceeds `_MOST_SIGMA`."""
    estimate, sigma = 1 / factors[k], cov[k, k] ** 0.5 / factors[k] ** 2
    sensors = [name for name, fit in fits.items() if fit.cov[k, k] < _SHARE**2 * cov[k, k]]
    return LengthScale(float(estimate), float(sigma), " and ".join(sensors)) if sigma < _MOST_SIGMA else None


def _fits(
    nodes: Sequence[Keyframe], steps: Sequence[Link | None], rig: StereoRig, noise: SensorNoise
) -> Iterator[tuple[str, _Fit | None]]:
    dvl = _dvl(nodes, steps, rig)
    yield "DVL", None if dvl is None else dvl._replace(cov=dvl.cov + noise.dvl_scale**2)
    across, along = _paths(nodes, steps)
    position = np.array([np.full(3, np.nan) if n.readings.usbl_m is None else n.readings.usbl_m for n in nodes])
    yield "USBL", _absolute(position.reshape(-1, 3), across, along, noise.usbl_m)
    height = np.full((len(nodes), 3), np.nan)
    height[:, 2] = [np.nan if n.readings.pressure_z_m is None else n.readings.pressure_z_m for n in nodes]
    yield "pressure", _absolute(height, across, along, noise.height_sigma_m)


def _dvl(nodes: Sequence[Keyframe], steps: Sequence[Link | None], rig: StereoRig) -> _Fit | None:
    """Returns the fit to the DVL's displacements, in earlier camera axes, turned by a small unknown rotation."""
    to_camera, rows = rig.body_from_camera[:3, :3].T, []
    for node, step in zip(nodes[1:], steps, strict=True):
        if step is None or node.dvl_displacement is None:
            continue
        turned, moved = step.i_from_j.copy(), step.i_from_j[:3, 3]
        turned[:3, 3] = 0.0
        lever_m = body_displacement(turned, rig.body_from_camera)[0]
        cov = step.i_from_j[:3, :3] @ step.cov[3:, 3:] @ step.i_from_j[:3, :3].T
        cov = cov + to_camera @ node.dvl_displacement.cov @ to_camera.T
        measured = to_camera @ (node.dvl_displacement.displacement_m - lever_m)
        rows += [(measured[k], _split(moved)[k], geometry.skew(moved)[k], cov[k, k]) for k in range(3)]
    return _fit(*(np.array(part) for part in zip(*rows, strict=True))) if rows else None


def _split(moved: Array) -> Array:
    """Returns the parts (3, 2) of a motion (3,) in camera axes across and along the optical axis."""
    return np.array([[moved[0], 0.0], [moved[1], 0.0], [0.0, moved[2]]])


def _paths(nodes: Sequence[Keyframe], steps: Sequence[Link | None]) -> tuple[Array, Array]:
    """Returns the sums (n, 3) of the motions across and along the optical axis; without a link, that of the poses."""
    parts, rotation = [np.zeros((3, 2))], nodes[0].world_from_camera[:3, :3] if nodes else np.eye(3)
    for a, b, step in zip(nodes[:-1], nodes[1:], steps, strict=True):
        motion = geometry.inverse(a.world_from_camera) @ b.world_from_camera if step is None else step.i_from_j
        parts.append(rotation @ _split(motion[:3, 3]))
        rotation = rotation @ motion[:3, :3]
    across, along = np.cumsum(parts, axis=0).transpose(2, 0, 1)
    return across, along


def _absolute(measured: Array, across: Array, along: Array, sigma_m: float) -> _Fit | None:
    """Returns the fit to positions (n, 3), NaN where unknown; their origin and a small rotation are estimated."""
    known = np.isfinite(measured)
    turn = np.array([geometry.skew(p) for p in across + along]).reshape(-1, 3, 3)
    nuisance = np.concatenate([turn, np.tile(np.eye(3), (len(turn), 1, 1))], axis=2)
    lengths = np.stack([across, along], axis=2)
    return _fit(measured[known], lengths[known], nuisance[known], np.full(known.sum(), max(sigma_m, 1e-6) ** 2))


def _fit(measured: Array, lengths: Array, nuisance: Array, variance: Array) -> _Fit | None:
    """Returns the least-squares factors (2,) in measured = lengths @ factors + nuisance @ unknowns; None for few rows.

    The covariance is that of the noise, multiplied by the chi-square per degree of freedom if that exceeds 1. Errors of
    `lengths` reduce the factors by at most the ratio of the variance of the residuals to that of the lengths, which is
    added as a standard deviation. A weak prior (1 +- 1) makes factors finite that the readings do not determine.
    """
    freedom = len(measured) - nuisance.shape[-1] - 2
    if freedom < 1:
        return None
    weight = 1 / np.sqrt(variance)
    given = np.column_stack([(measured - lengths.sum(axis=1)), lengths]) * weight[:, None]
    unknown = nuisance * weight[:, None]
    given = given - unknown @ np.linalg.lstsq(unknown, given, rcond=None)[0]
    difference, weighted = given[:, 0], given[:, 1:]
    cov = np.linalg.inv(weighted.T @ weighted + np.eye(2))
    correction = cov @ weighted.T @ difference
    residual2 = float(((difference - weighted @ correction) ** 2).sum())
    attenuation = residual2 / np.maximum((weighted**2).sum(axis=0), 1e-12)
    return _Fit(1 + correction, max(residual2 / freedom, 1.0) * cov + np.diag(attenuation**2))
