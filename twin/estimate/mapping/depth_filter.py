"""Kalman depth filter along the path; depths that are not propagated to the next keyframe enter the map, each once."""

from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Map, Mask, StereoRig
from twin.core.threads import in_row_bands
from twin.estimate.vision import epipolar
from twin.estimate.vision.disparity import Disparity
from twin.kernels import kernel

#: A measured depth z of variance R is accepted at a pixel where the filter has depth h of variance P if its innovation
#: z - h satisfies (z - h)^2 < GATE (P + R). The value is the 99.9 % quantile of chi-square, one degree of freedom.
GATE = 10.83
JUMP_PX = 1.2  #: neighbours whose disparities differ by more are on different surfaces [px]
#: Standard deviation of depth from motion due to errors other than image noise and pose [px of stereo disparity].
MOTION_MIN_SIGMA_PX = 0.03


class DepthMap(NamedTuple):
    depth_m: Map  #: (H, W) float32 depth [m], NaN where unknown
    variance_m2: Map  #: (H, W) float32 variance of the depth [m^2], NaN where unknown


def stereo_depth(disparity: Disparity, rig: StereoRig) -> DepthMap:
    """Returns the depth Z = f b / d of disparities d, at least 0.5 px, with standard deviation Z^2 / (f b) sigma_d."""
    focal_baseline = np.float32(rig.focal_px * rig.baseline_m)
    depth = focal_baseline / np.maximum(disparity.disparity_px, np.float32(0.5))
    variance = (depth * depth / focal_baseline * disparity.sigma_px) ** 2
    return DepthMap(depth.astype(np.float32), variance.astype(np.float32))


def fuse(prior: DepthMap, measured: DepthMap) -> DepthMap:
    """Returns two depth maps of an image, fused by scalar Kalman updates; a pixel that fails `GATE` keeps its prior."""
    fused = DepthMap(prior.depth_m.copy(), prior.variance_m2.copy())
    _fuse(*fused, *measured, GATE)
    return fused


def propagate(
    old: DepthMap, new: DepthMap, new_from_old: Array, step_cov: Array, rig: StereoRig
) -> tuple[DepthMap, Mask]:
    """Returns the old depth map propagated to the new keyframe and fused with its stereo depth (as `fuse` does).

    Each new pixel is linearised at its stereo depth (or, without one, at the smallest depth of the old points that
    project there) and projected into the old image, whose map is interpolated except across discontinuities. The
    difference of depth is converted, with the surface normal, to one along the ray of the new pixel. `step_cov` (6, 6)
    is that of the relative pose [rotation, translation] (rad, m), in the new camera axes. Also returns a mask (H, W) of
    the pixels with information from the old map.
    """
    camera = (rig.focal_px, rig.cx_px, rig.cy_px)
    guess = new.depth_m.copy()
    _forward_project(old.depth_m, np.ascontiguousarray(new_from_old), guess, camera)
    old_from_new, focal_baseline = geometry.inverse(new_from_old), rig.focal_px * rig.baseline_m
    prior = DepthMap(np.full_like(guess, np.nan), np.full_like(guess, np.nan))
    lens = camera, focal_baseline, JUMP_PX
    in_row_bands(
        lambda first, end: _backward_warp(*old, guess, old_from_new, step_cov, *lens, *prior, first, end), len(guess)
    )
    fused = DepthMap(new.depth_m.copy(), new.variance_m2.copy())
    return fused, _fuse(*fused, *prior, GATE)


def motion_depth(
    gray: Map, old_gray: Map, current: DepthMap, old_from_new: Array, step_cov: Array, rig: StereoRig
) -> DepthMap:
    """Returns the depth of the new keyframe from the optical flow between it and the old keyframe.

    Exact two-view form of eq. 1 of Negahdaripour & Madjidi (2003): the difference between actual and predicted flow
    along the epipolar line, measured with the window of stereo, is linear in the error of the inverse depth. Dense
    two-dimensional flow is not used: its bias of about 0.1 px is common to the whole image and would remain in the map.
    Grey levels (H, W) are those of the left images; `step_cov` as in `propagate`.
    """
    focal_baseline = rig.focal_px * rig.baseline_m
    view = epipolar.two_view(old_from_new, rig.matrix, rig.baseline_m)
    flow = epipolar.refine(gray, old_gray, np.float32(focal_baseline) / current.depth_m, view, iterations=1)
    camera = (rig.focal_px, rig.cx_px, rig.cy_px)
    pose = np.ascontiguousarray(old_from_new)
    pose_variance = _pose_variance(flow.disparity_px, pose, step_cov, camera, focal_baseline)
    sigma = np.sqrt(flow.measurement_sigma_px**2 + pose_variance + np.float32(MOTION_MIN_SIGMA_PX**2))
    return stereo_depth(Disparity(flow.disparity_px, sigma), rig)


@kernel
def _fuse(depth, variance, measured, measured_variance, gate):
    """Updates `depth` and `variance` in place; returns a mask (H, W) of updated pixels."""
    updated = np.zeros(depth.shape, np.bool_)
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z, r = measured[v, u], measured_variance[v, u]
            if not z > 0:
                continue
            h, p = depth[v, u], variance[v, u]
            if not h > 0:
                depth[v, u], variance[v, u], updated[v, u] = z, r, True
            elif (z - h) ** 2 < gate * (p + r):
                gain = p / (p + r)
                depth[v, u], variance[v, u], updated[v, u] = h + gain * (z - h), p * r / (p + r), True
    return updated


@kernel
def _forward_project(old, new_from_old, guess, camera):
    """Fills unknown pixels of `guess` (H, W), in place, with the smallest depth of old points that project there."""
    height, width = old.shape
    focal, cx, cy = camera
    filled = np.zeros(old.shape, np.bool_)
    for v in range(height):
        for u in range(width):
            if not old[v, u] > 0:
                continue
            x, y, z = _transform_pixel(u, v, old[v, u], new_from_old, camera)
            if z <= 0:
                continue
            j, i = int(np.floor(focal * x / z + cx + 0.5)), int(np.floor(focal * y / z + cy + 0.5))
            inside = 0 <= i < height and 0 <= j < width
            if inside and (np.isnan(guess[i, j]) or (filled[i, j] and z < guess[i, j])):
                guess[i, j], filled[i, j] = z, True


@kernel(inline="always")
def _transform_pixel(u, v, depth, pose, camera):
    """Returns x, y, z [m] in another camera, in which this one has a pose (4, 4), of a pixel (u, v) at a depth [m]."""
    focal, cx, cy = camera
    x, y = (u - cx) / focal * depth, (v - cy) / focal * depth
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * depth + pose[0, 3],
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * depth + pose[1, 3],
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * depth + pose[2, 3],
    )


@kernel(inline="always")
def _bilinear(depth, variance, x, y, focal_baseline, jump):
    """Returns depth and variance at (x, y); NaN next to an unknown pixel, another surface or the border."""
    height, width = depth.shape
    if not (0 <= x <= width - 1 and 0 <= y <= height - 1):
        return np.nan, np.nan
    j, i = min(int(x), width - 2), min(int(y), height - 2)
    a, b, c, e = depth[i, j], depth[i, j + 1], depth[i + 1, j], depth[i + 1, j + 1]
    near, far = min(min(a, b), min(c, e)), max(max(a, b), max(c, e))
    if not (near > 0 and focal_baseline * (1 / near - 1 / far) < jump) or np.isnan(a + b + c + e):
        return np.nan, np.nan
    s, t = x - j, y - i
    wa, wb, wc, we = (1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t
    inverse = wa / a + wb / b + wc / c + we / e
    upper, lower = variance[i], variance[i + 1]
    return 1 / inverse, wa * upper[j] + wb * upper[j + 1] + wc * lower[j] + we * lower[j + 1]


@kernel(inline="always")
def _normal(depth, u, v, camera, focal_baseline, jump):
    """Returns the surface normal (x, y, z) at a pixel, scaled so that normal . ray = 1 / depth for a ray with z = 1."""
    # the gradient of inverse depth is zero across discontinuities, next to unknown pixels and at the image border
    (focal, cx, cy), (height, width) = camera, depth.shape
    slope_u, slope_v = 0.0, 0.0
    if 0 < u < width - 1:
        slope_u = 0.5 / depth[v, u + 1] - 0.5 / depth[v, u - 1]
    if 0 < v < height - 1:
        slope_v = 0.5 / depth[v + 1, u] - 0.5 / depth[v - 1, u]
    if not focal_baseline * abs(slope_u) < 0.5 * jump:
        slope_u = 0.0
    if not focal_baseline * abs(slope_v) < 0.5 * jump:
        slope_v = 0.0
    nx, ny = focal * slope_u, focal * slope_v
    return nx, ny, 1 / depth[v, u] - nx * (u - cx) / focal - ny * (v - cy) / focal


@kernel
def _backward_warp(old, old_variance, guess, pose, step_cov, camera, focal_baseline, jump, depth, variance, first, end):
    """Fills rows of depth and variance (H, W) of the old map in the new image, linearised at `guess` (H, W)."""
    focal, cx, cy = camera
    is_uncertain = np.trace(step_cov) > 0
    for v in range(first, end):
        for u in range(old.shape[1]):
            z = guess[v, u]
            if not z > 0:
                continue
            x, y, w = _transform_pixel(u, v, z, pose, camera)
            if w <= 0:
                continue
            ox, oy = x / w, y / w
            h, p = _bilinear(old, old_variance, focal * ox + cx, focal * oy + cy, focal_baseline, jump)
            if np.isnan(h):
                continue
            nx, ny, nz = _normal(guess, u, v, camera, focal_baseline, jump)
            # ray of the old camera in axes of the new camera
            rx = pose[0, 0] * ox + pose[1, 0] * oy + pose[2, 0]
            ry = pose[0, 1] * ox + pose[1, 1] * oy + pose[2, 1]
            rz = pose[0, 2] * ox + pose[1, 2] * oy + pose[2, 2]
            ratio = min(max(z * (nx * rx + ny * ry + nz * rz), 0.5), 2.0)
            depth[v, u] = z + (h - w) * ratio
            variance[v, u] = p * ratio**2
            if is_uncertain:
                px, py = (u - cx) / focal * z, (v - cy) / focal * z
                variance[v, u] += z * z * variance_along(px, py, z, nx, ny, nz, step_cov)


@kernel(inline="always")
def variance_along(px, py, pz, nx, ny, nz, cov):
    """Returns the variance of the displacement of a point p [m] along n, due to an error of the pose of its axes."""
    row = (py * nz - pz * ny, pz * nx - px * nz, px * ny - py * nx, nx, ny, nz)
    total = 0.0
    for i in range(6):
        for j in range(6):
            total += row[i] * cov[i, j] * row[j]
    return total


@kernel
def _pose_variance(disparity, pose, step_cov, camera, focal_baseline):
    """Returns the variance (H, W) [px^2] of disparity from motion due to that of the pose; NaN at the epipole."""
    height, width = disparity.shape
    focal, cx, cy = camera
    result = np.zeros(disparity.shape, np.float32)
    if np.trace(step_cov) <= 0:
        return result
    for v in range(height):
        for u in range(width):
            d = disparity[v, u]
            if not d > 0:
                continue
            z = focal_baseline / d
            x, y, w = _transform_pixel(u, v, z, pose, camera)
            ex = (pose[0, 3] * w - pose[2, 3] * x) / (w * w) * focal * z / focal_baseline
            ey = (pose[1, 3] * w - pose[2, 3] * y) / (w * w) * focal * z / focal_baseline
            # flow due to a displacement of the point in the new camera, projected on the epipolar line
            length = ex * ex + ey * ey
            if length == 0:
                result[v, u] = np.nan
                continue
            gx, gy = ex / length * focal / w, ey / length * focal / w
            gz = -(gx * x + gy * y) / w
            nx = gx * pose[0, 0] + gy * pose[1, 0] + gz * pose[2, 0]
            ny = gx * pose[0, 1] + gy * pose[1, 1] + gz * pose[2, 1]
            nz = gx * pose[0, 2] + gy * pose[1, 2] + gz * pose[2, 2]
            result[v, u] = variance_along((u - cx) / focal * z, (v - cy) / focal * z, z, nx, ny, nz, step_cov)
    return result
