"""Ray caster for height fields: ground truth for tests of `twin.estimate`, without OpenGL and independent of `twin`."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from twin.core import geometry
from twin.core.records import StereoRig
from twin.kernels import kernel


class Seafloor(NamedTuple):
    """Height grid [m] (row 0 = south, column 0 = west) with bilinear interpolation and a tiled grey texture."""

    height_m: np.ndarray
    spacing_m: float
    west_m: float
    south_m: float
    texture: np.ndarray
    texture_px_m: float

    def height_at(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Returns the true height [m] at points (x, y) of any shape, the same for both."""
        shape = np.broadcast(x_m, y_m).shape
        x, y = np.broadcast_to(x_m, shape).ravel(), np.broadcast_to(y_m, shape).ravel()
        return _heights(self.height_m, self.spacing_m, self.west_m, self.south_m, x, y).reshape(shape)


def smooth_texture(seed: int, size_px: int = 512, blur_px: float = 1.6) -> np.ndarray:
    """Generates a tileable random texture with mean grey level 127 and standard deviation 40."""
    noise = np.random.default_rng(seed).normal(size=(size_px, size_px))
    soft = cv2.GaussianBlur(np.tile(noise, (3, 3)), (0, 0), blur_px)[size_px : 2 * size_px, size_px : 2 * size_px]
    return np.clip(127 + 40 * soft / soft.std(), 0, 255).astype(np.float32)


def plane(slope_x: float = 0.0, slope_y: float = 0.0, texture_px_m: float = 0.006, seed: int = 0) -> Seafloor:
    """Returns the floor z = slope_x x + slope_y y, 16 m x 16 m."""
    nodes = np.linspace(-8, 8, 33)
    height = slope_x * nodes[None, :] + slope_y * nodes[:, None]
    return Seafloor(height, 0.5, -8.0, -8.0, smooth_texture(seed), texture_px_m)


def down_camera(
    x_m: float, y_m: float, z_m: float, rpy_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> np.ndarray:
    """Returns the pose world_from_camera (4, 4) of a down-looking camera on a body with this roll, pitch and yaw."""
    return geometry.pose(
        geometry.rotation_from_rpy(*map(float, rpy_rad)) @ geometry.BODY_FROM_DOWN_CAMERA,
        np.array([x_m, y_m, z_m], float),
    )


def small_rig(width_px: int = 320, height_px: int = 240, hfov_deg: float = 60.0, baseline_m: float = 0.15) -> StereoRig:
    """Returns a stereo rig at the origin of the body, by default that of the reef survey."""
    focal_px = width_px / 2 / np.tan(np.deg2rad(hfov_deg / 2))
    return StereoRig(
        width_px, height_px, focal_px, baseline_m, 30.0, geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.zeros(3))
    )


def render_view(
    floor: Seafloor, rig: StereoRig, world_from_camera: np.ndarray, samples: int = 2
) -> tuple[np.ndarray, np.ndarray]:
    """Renders a grey image (H, W) float32 with samples x samples rays per pixel, and the depth (H, W) [m]."""
    pose = np.ascontiguousarray(world_from_camera)
    args = (
        np.ascontiguousarray(floor.height_m, dtype=np.float64),
        floor.spacing_m,
        floor.west_m,
        floor.south_m,
        floor.texture,
        floor.texture_px_m,
        pose[:3, :3].copy(),
        pose[:3, 3].copy(),
        rig.focal_px,
        rig.width_px,
        rig.height_px,
    )
    image, depth = _cast(*args, samples)
    return image, depth if samples == 1 else _cast(*args, 1)[1]


def stereo_pair(
    floor: Seafloor, rig: StereoRig, world_from_camera: np.ndarray, rng: np.random.Generator, noise: float = 2.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Renders the left and right image (H, W) uint8 with image noise [grey levels], and the left depth (H, W) [m]."""
    left, depth = render_view(floor, rig, world_from_camera)
    right, _ = render_view(floor, rig, world_from_camera @ rig.left_from_right)
    return digitise(left, rng, noise), digitise(right, rng, noise), depth


def digitise(image: np.ndarray, rng: np.random.Generator, noise: float) -> np.ndarray:
    """Adds image noise [grey levels] and quantises to uint8."""
    return np.clip(np.round(image + rng.normal(size=image.shape) * noise), 0, 255).astype(np.uint8)


@kernel
def _height(z, spacing, west, south, x, y):
    """Returns the bilinear height at one point [m]."""
    c = min(max((x - west) / spacing, 0.0), z.shape[1] - 1.000001)
    r = min(max((y - south) / spacing, 0.0), z.shape[0] - 1.000001)
    i, j = int(r), int(c)
    a, b = r - i, c - j
    return (1 - a) * ((1 - b) * z[i, j] + b * z[i, j + 1]) + a * ((1 - b) * z[i + 1, j] + b * z[i + 1, j + 1])


@kernel
def _heights(z, spacing, west, south, x, y):
    """Returns the bilinear heights at points (n,) [m]."""
    out = np.empty(x.size)
    for n in range(x.size):
        out[n] = _height(z, spacing, west, south, x[n], y[n])
    return out


@kernel
def _colour(texture, px, x, y):
    """Returns the bilinear grey level of the tiled texture at one point."""
    n, m = texture.shape
    c, r = x / px, y / px
    j, i = int(np.floor(c)), int(np.floor(r))
    a, b = r - i, c - j
    i0, i1, j0, j1 = i % n, (i + 1) % n, j % m, (j + 1) % m
    return (1 - a) * ((1 - b) * texture[i0, j0] + b * texture[i0, j1]) + a * (
        (1 - b) * texture[i1, j0] + b * texture[i1, j1]
    )


@kernel
def _crossing(z, spacing, west, south, position, dx, dy, dz, low, high):
    """Returns the ray parameter between `low` (above the floor) and `high` (below) at the floor: regula falsi."""
    x, y = position[0] + low * dx, position[1] + low * dy
    above = position[2] + low * dz - _height(z, spacing, west, south, x, y)
    x, y = position[0] + high * dx, position[1] + high * dy
    below = position[2] + high * dz - _height(z, spacing, west, south, x, y)
    t, side = high, 0
    for _ in range(60):
        t = (low * below - high * above) / (below - above)
        x, y = position[0] + t * dx, position[1] + t * dy
        error = position[2] + t * dz - _height(z, spacing, west, south, x, y)
        if abs(error) < 1e-9:
            break
        if error < 0:  # an end that stays twice counts half (Illinois)
            high, below, above, side = t, error, above / 2 if side < 0 else above, -1
        else:
            low, above, below, side = t, error, below / 2 if side > 0 else below, 1
    return t


@kernel
def _cast(z, spacing, west, south, texture, px, rotation, position, focal, width, height, samples):
    """Renders image and depth (H, W): ray marching, then regula falsi; depth is NaN unless samples is 1."""
    image = np.zeros((height, width), np.float32)
    depth = np.full((height, width), np.nan)
    top = z.max() + 1e-6
    bottom = z.min() - 1.0
    for v in range(height):
        for u in range(width):
            for s in range(samples * samples):
                du = (s % samples + 0.5) / samples - 0.5
                dv = (s // samples + 0.5) / samples - 0.5
                rx, ry = (u + du - (width - 1) / 2) / focal, (v + dv - (height - 1) / 2) / focal
                dx = rotation[0, 0] * rx + rotation[0, 1] * ry + rotation[0, 2]
                dy = rotation[1, 0] * rx + rotation[1, 1] * ry + rotation[1, 2]
                dz = rotation[2, 0] * rx + rotation[2, 1] * ry + rotation[2, 2]
                near = max((position[2] - top) / -dz, 0.0)
                step = 0.4 * spacing / max(abs(dx), abs(dy), 0.4 * abs(dz))
                t = near
                while True:
                    x, y, h = position[0] + t * dx, position[1] + t * dy, position[2] + t * dz
                    if h <= _height(z, spacing, west, south, x, y) or h < bottom:
                        break
                    t += step
                t = _crossing(z, spacing, west, south, position, dx, dy, dz, max(t - step, 0.0), t)
                x, y = position[0] + t * dx, position[1] + t * dy
                image[v, u] += _colour(texture, px, x, y) / (samples * samples)
                if samples == 1:
                    depth[v, u] = t
    return image, depth
