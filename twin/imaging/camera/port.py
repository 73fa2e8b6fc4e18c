"""Ports of a camera housing: refraction of rays at the inner and outer face of the glass (Snell's law).

All quantities are in the axes of the camera with the entrance pupil as origin; the housing holds air. Near the axis the
camera in water is again a pinhole (Gaussian optics): for a flat pane at distance d, of thickness t and index g, in
water of index n, it lies d (n - 1) + t (n / g - 1) behind the pupil and has n times the focal length. Treibitz et al.
2012 (doi 10.1109/TPAMI.2011.105) give the errors off the axis.
"""

from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.imaging.camera.lens import newton
from twin.scenario.model import PortConfig

STEP, TOLERANCE = 1e-6, 1e-11  # Newton's method: finite difference and tolerance of X / Z
SMALL_RAD = 1e-4  # paraxial angle; its cube is negligible


class Pinhole(NamedTuple):
    """Pinhole camera in water that is equivalent, near the optical axis, to a camera behind a port."""

    centre_m: float  # position of the pinhole on the optical axis, positive in front of the entrance pupil
    focal_ratio: float  # focal length of the pinhole camera divided by that of the lens in air


def pinhole(port: PortConfig) -> Pinhole:
    """Returns the equivalent pinhole of a port, ignoring its tilt and lateral offset (mounting errors)."""
    if port.kind == "none":
        return Pinhole(0.0, 1.0)
    straight = port.model_copy(update={"tilt_deg": 0.0, "offset_m": (0.0, 0.0, port.offset_m[2])})
    origin, direction = water_rays(straight, np.array([[SMALL_RAD, 0.0]]))
    (x, _, z), (along_x, _, along_z) = origin[0], direction[0]
    return Pinhole(float(z - x * along_z / along_x), float(SMALL_RAD * along_z / along_x))


def water_rays(port: PortConfig, normalised: Array) -> tuple[Array, Array]:
    """Returns the origin on the outer face [m] and the unit direction in water, both (..., 3), of rays (..., 2) in air.

    Both are NaN where a ray misses the port, the direction also at total reflection. Without port: from the pupil.
    """
    ray = np.concatenate([normalised, np.ones_like(normalised[..., :1])], axis=-1)
    ray /= np.sqrt(_dot(ray, ray))[..., None]
    start = np.zeros_like(ray)
    if port.kind == "none":
        return start, ray
    hit = _hit_pane if port.kind == "flat" else _hit_dome
    inner, normal = hit(port, start, ray, 0.0)
    ray = refract(ray, normal, 1 / port.glass_index)
    outer, normal = hit(port, inner, ray, port.thickness_m)
    return outer, refract(ray, normal, port.glass_index / port.water_index)


def air_coordinates(port: PortConfig, points_m: Array) -> Array:
    """Returns the normalised coordinates (..., 2) in air of the rays to points (..., 3) [m]; NaN if none is found."""
    normalised = points_m[..., :2] / points_m[..., 2:]
    if port.kind == "none":
        return normalised
    equivalent = pinhole(port)
    normalised = points_m[..., :2] / (points_m[..., 2:] - equivalent.centre_m) * equivalent.focal_ratio

    def miss(at: Array) -> Array:
        """Returns the vector (..., 2) across the axis by which rays miss their points, divided by the points' depth."""
        origin, direction = water_rays(port, at)
        along = (points_m[..., 2:] - origin[..., 2:]) / direction[..., 2:]
        return (origin + along * direction - points_m)[..., :2] / points_m[..., 2:]

    def jacobian(at: Array, residual: Array) -> Array:
        return np.stack([(miss(at + step) - residual) / STEP for step in STEP * np.eye(2)], axis=-1)

    return newton(miss, jacobian, normalised, TOLERANCE, 100)


def refract(ray: Array, normal: Array, ratio: float) -> Array:
    """Returns unit vectors (..., 3) by Snell's law; NaN at total reflection; `ratio`: index before / behind."""
    # `ray` and `normal` (..., 3) are unit vectors in the direction of propagation
    cosine = _dot(ray, normal)[..., None]
    with np.errstate(invalid="ignore"):
        behind = np.sqrt(1 - ratio**2 * (1 - cosine**2))
    return ratio * ray + (behind - ratio * cosine) * normal


def _hit_pane(port: PortConfig, start: Array, ray: Array, depth_m: float) -> tuple[Array, Array]:
    """Returns intersections and normals (..., 3) with the plane `depth_m` outside the inner face of a pane."""
    tilt = np.deg2rad(port.tilt_deg)
    normal = np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    along = ray @ normal
    distance = (port.distance_m + depth_m - start @ normal) / np.where(along > 0, along, np.nan)
    return start + distance[..., None] * ray, np.broadcast_to(normal, ray.shape)


def _hit_dome(port: PortConfig, start: Array, ray: Array, depth_m: float) -> tuple[Array, Array]:
    """Returns intersections and normals (..., 3) with the sphere `depth_m` outside the inner face of a dome."""
    radius_m, centre = port.radius_m + depth_m, np.array(port.offset_m)
    from_centre = start - centre
    along = _dot(from_centre, ray)
    distance = -along + np.sqrt(along**2 - _dot(from_centre, from_centre) + radius_m**2)
    at = start + distance[..., None] * ray
    return at, (at - centre) / radius_m


def _dot(a: Array, b: Array) -> Array:
    """Returns the scalar products (...) of vectors (..., 3), several times faster than a sum over their last axis."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]
