"""The window of a camera's housing: a ray of the lens is bent at the inner and at the outer face of the glass (Snell).

Everything is in the axes of the camera with the entrance pupil of the lens as origin; the housing is full of air, of
refractive index 1. Near the axis of a straight port the camera in water is a pinhole again, by Gauss: of a ray at a
small angle that leaves the outer face at height h under the angle w, both proportional, the pinhole lies h / w before
that face, and its focal length is the lens's times the angle in air by that in water. For a pane at distance d, of
thickness t and index g, in water of index n, this is n times the focal length, d (n - 1) + t (n / g - 1) behind the
pupil (Treibitz et al. 2012, doi 10.1109/TPAMI.2011.105, tell how far a wide view is from that pinhole).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.imaging.lens import solve
from twin.scenario.model import PortConfig

Array = NDArray[np.float64]

STEPS, STEP, TOLERANCE = 40, 1e-6, 1e-11  # of Newton's method in `air_tangents`; all in tangents
SMALL_RAD = 1e-4  # an angle whose cube is lost


class Pinhole(NamedTuple):
    """The camera in water that agrees with the port near its axis.

    Args:
        centre_m: where it lies on the axis, forward of the entrance pupil.
        focal_ratio: its focal length by the lens's in air.
    """

    centre_m: float
    focal_ratio: float


def pinhole(port: PortConfig) -> Pinhole:
    """The pinhole of a port that stands straight: tilt and sideways offset are faults that it does not know of."""
    if port.kind == "none":
        return Pinhole(0.0, 1.0)
    straight = port.model_copy(update={"tilt_deg": 0.0, "offset_m": (0.0, 0.0, port.offset_m[2])})
    origin, direction = water_rays(straight, np.array([[SMALL_RAD, 0.0]]))
    (x, _, z), (along_x, _, along_z) = origin[0], direction[0]
    return Pinhole(float(z - x * along_z / along_x), float(SMALL_RAD * along_z / along_x))


def water_rays(port: PortConfig, tangents: Array) -> tuple[Array, Array]:
    """Origin on the outer face and unit direction, both (..., 3), of the ray that is (..., 2) in air.

    NaN where the ray does not get through. Without a port rays start at the pupil.
    """
    ray = np.concatenate([tangents, np.ones_like(tangents[..., :1])], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    start = np.zeros_like(ray)
    if port.kind == "none":
        return start, ray
    hit = _hit_pane if port.kind == "flat" else _hit_dome
    inner, normal = hit(port, start, ray, 0.0)
    ray = refract(ray, normal, 1 / port.glass_index)
    outer, normal = hit(port, inner, ray, port.thickness_m)
    return outer, refract(ray, normal, port.glass_index / port.water_index)


def air_tangents(port: PortConfig, points_m: Array) -> Array:
    """The rays (..., 2) in air that reach points (..., 3): the inverse of `water_rays`; NaN where none does.

    By Newton from the ray of the pinhole; the angle in air grows faster than that in water, so that for a pane each
    step comes nearer from the same side.
    """
    tangents = points_m[..., :2] / points_m[..., 2:]
    if port.kind == "none":
        return tangents
    like = pinhole(port)
    tangents = points_m[..., :2] / (points_m[..., 2:] - like.centre_m) * like.focal_ratio

    def off(at: Array) -> Array:
        origin, direction = water_rays(port, at)
        way = (points_m[..., 2:] - origin[..., 2:]) / direction[..., 2:]
        return (origin + way * direction - points_m)[..., :2] / points_m[..., 2:]

    for _ in range(STEPS):
        wrong = off(tangents)
        if np.nanmax(np.abs(wrong), initial=0.0) < TOLERANCE:
            break
        slopes = [(off(tangents + step) - wrong) / STEP for step in STEP * np.eye(2)]
        tangents = tangents - solve(np.stack(slopes, axis=-1), wrong)
    found = np.abs(off(tangents)).max(axis=-1) < 100 * TOLERANCE
    return np.where(found[..., None], tangents, np.nan)


def refract(ray: Array, normal: Array, ratio: float) -> Array:
    """Snell's law for unit vectors (..., 3), the normal pointing onwards; NaN where light is totally reflected.

    Args:
        ratio: refractive index before the face by that behind it.
    """
    cosine = (ray * normal).sum(axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        behind = np.sqrt(1 - ratio**2 * (1 - cosine**2))
    return ratio * ray + (behind - ratio * cosine) * normal


def _hit_pane(port: PortConfig, start: Array, ray: Array, depth_m: float) -> tuple[Array, Array]:
    """Where rays meet the face of a pane at a depth in its glass, and its normal."""
    tilt = np.deg2rad(port.tilt_deg)
    normal = np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    along = ray @ normal
    way = (port.distance_m + depth_m - start @ normal) / np.where(along > 0, along, np.nan)
    return start + way[..., None] * ray, np.broadcast_to(normal, ray.shape)


def _hit_dome(port: PortConfig, start: Array, ray: Array, depth_m: float) -> tuple[Array, Array]:
    """Where rays from within meet the sphere at a depth in the glass of a dome, and its normal."""
    radius_m, centre = port.radius_m + depth_m, np.array(port.offset_m)
    from_centre = start - centre
    along = (from_centre * ray).sum(axis=-1)
    way = -along + np.sqrt(along**2 - (from_centre**2).sum(axis=-1) + radius_m**2)
    at = start + way[..., None] * ray
    return at, (at - centre) / radius_m
