"""Marine snow: small particles that drift with the current through the light of lamps and sun.

The particles fill a periodic box around the left camera, so both cameras and consecutive frames show the same ones. A
particle of diameter D at depth z is a Lambertian disc with an image area of pi/4 (f D / z)^2, which hides the light
from behind it that is not scattered in front of it. It is blurred by one pixel and by the circle of confusion A f |1/z
- 1/s|, and spread evenly along its path during the exposure. A rolling shutter images it where it is when its row is
read; if the whole image is displaced later, it is drawn displaced by the difference from the floor behind it. Diameters
follow a power law n(D) ~ D^-j between a and b (Junge 1963), with the cumulative distribution (a^(1-j) - D^(1-j)) /
(a^(1-j) - b^(1-j)).
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from twin.core import geometry
from twin.core.records import Array, Depth, Radiance, StereoRig
from twin.core.threads import in_row_bands
from twin.errors import TwinError
from twin.imaging.camera.lens_psf import Defocus
from twin.imaging.camera.shutter import ExposureMotion
from twin.imaging.light.lamp_light import LampLight
from twin.imaging.light.shading import FAR_M
from twin.kernels import kernel
from twin.scenario.model import SnowConfig

#: Least side of the periodic box. Along each world axis, snow is visible up to half a side from the left camera; half a
#: side is at least MARGIN times the extent of the image of a level floor.
BOX_M, MARGIN = 5.0, 1.1
_MOST_PARTICLES = 2e7  # 1.3 GB of memory
NEAREST_M = 0.1  # smallest depth of a particle: the port is in front of the camera
APERTURE_M = 0.004  # diameter of the lens aperture where the scenario has no depth of field
PIXEL_BLUR_PX = 1.0  # blur of the image of a particle by the lens
FOOTPRINT_PX = 4096  # most pixels of a footprint whose weights are stored; those of a larger one are computed twice


#: Light (n, 3) that is scattered into the camera before ranges (n,) [m] at pixels (n, 2) [cd/m2].
Veil: TypeAlias = Callable[[Array, Array], Array]


class VisibleParticles(NamedTuple):
    pixel: Array  # (n, 2) column and row [px]
    points_m: Array  # (n, 3) positions in the axes of the camera
    radiance: Array  # (n, 3) radiance per colour band [cd/m2]
    diameter_m: Array  # (n,) diameters

    @property
    def depth_m(self) -> Array:
        return np.ascontiguousarray(self.points_m[:, 2])


class MarineSnow:
    """Marine snow, which moves with the current (3,), for cameras at `height_m` above the reference plane.

    Without `defocus`, the lens is focused at infinity.
    """

    def __init__(
        self, snow: SnowConfig, current_mps: Array, rig: StereoRig, lamp_light: list[LampLight],
        rng: np.random.Generator, defocus: Defocus | None = None, height_m: float = 0.0,
    ):  # fmt: skip
        aside_m = height_m * np.hypot(rig.width_px, rig.height_px) / 2 / rig.focal_px
        self._box_m = np.maximum(BOX_M, 2 * MARGIN * np.array([aside_m, aside_m, height_m]))
        n = round(snow.density_per_m3 * float(np.prod(self._box_m)))
        if n > _MOST_PARTICLES:
            allowed = f"up to {_MOST_PARTICLES / float(np.prod(self._box_m)):.3g} at this altitude and field of view"
            raise TwinError("snow.density_per_m3", f"{n:.2g} particles around the cameras", allowed)
        self._start_m = rng.uniform(0, self._box_m, (n, 3))
        self._diameter_m = diameters(snow, len(self._start_m), rng)
        self._snow, self._current_mps, self._rig, self._water = snow, current_mps, rig, lamp_light[0].water
        self.lamp_light = lamp_light
        self._defocus = Defocus(APERTURE_M, 0.0) if defocus is None else defocus
        largest = float(self._diameter_m.max(initial=0.0))
        self._margin_px = float(_width_px(rig.focal_px, largest, NEAREST_M, self._defocus))

    def visible_particles(
        self, world_from_left: Array, camera: int, time_s: float, reach_m: float = 0.0, farthest_m: float = np.inf
    ) -> VisibleParticles:
        """Returns the particles in view of a camera (0 left, 1 right)."""
        rig = self._rig
        world_from_camera = world_from_left @ (rig.left_from_right if camera else np.eye(4))
        low, middle = world_from_left[:3, 3] - self._box_m / 2, (rig.cx_px, rig.cy_px)
        view = rig.focal_px, *middle, rig.width_px, rig.height_px, self._margin_px, rig.focal_px * reach_m, farthest_m
        points, seen = np.empty((3, len(self._start_m))), np.empty(len(self._start_m), np.bool_)
        pose = geometry.inverse(world_from_camera)
        _into_camera(self._start_m, self._current_mps * time_s - low, low, self._box_m, pose, points)
        _test_view(points, view, seen)
        found = np.flatnonzero(seen)
        points = np.ascontiguousarray(points[:, found].T)
        pixel = points[:, :2] / points[:, 2:] * rig.focal_px + np.array(middle)
        diameter_m = self._diameter_m[found] if len(self._diameter_m) > 1 else np.repeat(self._diameter_m, len(found))
        return VisibleParticles(
            pixel, points, self._radiance(points, self.lamp_light[camera], float(world_from_camera[2, 3])), diameter_m
        )

    def draw(
        self, light: Radiance, depth: Depth, world_from_left: Array, camera: int, time_s: float,
        motion: ExposureMotion | None = None, veil: Veil | None = None,
    ) -> None:  # fmt: skip
        """Draws the particles in front of the floor, of depth (H, W) [m], into the radiance (H, W, 3) `light`.

        `veil` is the backscatter that `light` contains, see `optics.Optics.veil`; None: none.
        """
        rig, defocus = self._rig, self._defocus
        reach_m = 0.0 if motion is None else self._reach_m(motion)
        seen = self.visible_particles(world_from_left, camera, time_s, reach_m, float(depth.max()))
        z = seen.depth_m
        width_px = _width_px(rig.focal_px, seen.diameter_m, z, defocus)
        cover_px2 = np.pi / 4 * (rig.focal_px * seen.diameter_m / z) ** 2
        if motion is None:
            centre_px, path_px = seen.pixel, np.zeros_like(seen.pixel)
        else:
            centre_px, path_px = self._paths(seen, depth, world_from_left, camera, motion)
        range_m, water = np.linalg.norm(seen.points_m, axis=1), self._water
        # share of the light from behind a particle that is not scattered in front of it
        through = np.exp((water.camera_loss_per_m - water.attenuation_per_m) * range_m[:, None])
        radiance = seen.radiance if veil is None else seen.radiance + through * veil(seen.pixel, range_m)
        scene = light, depth, centre_px, path_px, z, radiance, through, width_px, cover_px2
        in_row_bands(lambda first, end: _draw(*scene, first, end), len(light))

    def _reach_m(self, motion: ExposureMotion) -> float:
        """Returns an upper limit of the distance that a particle moves relative to the camera [m]."""
        speed_mps = np.linalg.norm(motion.twist[3:]) + np.linalg.norm(self._current_mps)
        speed_mps += np.linalg.norm(motion.twist[:3]) * self._box_m.max()
        return float(speed_mps * (motion.exposure_s + motion.readout_s) / 2)

    def _paths(
        self, seen: VisibleParticles, depth: Depth, world_from_left: Array, camera: int, motion: ExposureMotion
    ) -> tuple[Array, Array]:
        """Returns middle (n, 2) of the paths in the image, and vectors (n, 2) from their starts to their ends [px]."""
        left_from_camera = self._rig.left_from_right if camera else np.eye(4)
        drift = (world_from_left @ left_from_camera)[:3, :3].T @ self._current_mps
        rig, centre, path = self._rig, np.empty_like(seen.pixel), np.empty_like(seen.pixel)
        lens, moves = (rig.focal_px, rig.cx_px, rig.cy_px), (motion.exposure_s, motion.readout_s, motion.rolls_later)
        _trace_paths(seen.points_m, seen.pixel, depth, lens, drift, np.asarray(motion.twist), moves, centre, path)
        return centre, path

    def _radiance(self, points: Array, lamps: LampLight, height_m: float) -> Array:
        """Returns the radiance (n, 3) [cd/m2] of particles in camera axes; light scattered on the way is lost."""
        day, loss_per_m = lamps.sources.daylight, self._water.attenuation_per_m
        below_plan_m = day.reference_depth_m - height_m - day.camera_depth_m
        x, y, z = points.T
        lux = np.exp(-day.attenuation_per_m * (z + below_plan_m)[:, None])
        lux *= day.illuminance_lx
        for lamp in range(len(lamps.sources.intensity_cd)):
            lux += lamps.lux(lamp, points)[0]
        lux *= self._snow.albedo / np.pi
        lux *= np.exp(-loss_per_m * np.sqrt(x * x + y * y + z * z)[:, None])
        return lux


def diameters(snow: SnowConfig, n: int, rng: np.random.Generator) -> Array:
    """Returns the diameters of n particles [m]: (n,) of the Junge distribution, or (1,) if all are equal."""
    if snow.junge_exponent is None:
        return np.array([snow.diameter_m])
    power = 1 - snow.junge_exponent
    low, high = snow.diameter_min_m**power, snow.diameter_max_m**power
    return (low + rng.uniform(size=n) * (high - low)) ** (1 / power)


def _width_px(focal_px: float, diameter_m: Array | float, depth_m: Array | float, defocus: Defocus) -> Array:
    z = np.asarray(depth_m)
    return np.sqrt((focal_px * diameter_m / z) ** 2 + defocus.confusion_px(focal_px, z) ** 2 + PIXEL_BLUR_PX**2)


@kernel(error_model="numpy")
def _trace_paths(points, pixel, depth, lens, drift, twist, moves, centre, path):
    """Fills `centre` (n, 2) with the middle of each particle's path, and `path` (n, 2) with the vector along it [px].

    A rolling shutter reads the row v = v_0 + v' t at t = readout (v / (n_rows - 1) - 1/2), with the divisor 1 - v'
    readout / (n_rows - 1) limited to 0.1 or more.
    """
    (focal, cx, cy), (exposure_s, readout_s, rolls_later) = lens, moves
    row_s, bottom, right, still = readout_s / (depth.shape[0] - 1), depth.shape[0] - 1, depth.shape[1] - 1, np.zeros(3)
    for k in range(points.shape[0]):
        along, down = _image_velocity(points[k, 0], points[k, 1], points[k, 2], focal, drift, twist)
        path[k, 0], path[k, 1] = along * exposure_s, down * exposure_s
        delay_s = (pixel[k, 1] * row_s - readout_s / 2) / max(1 - down * row_s, 0.1)
        if rolls_later:
            u, v = pixel[k, 0] + along * delay_s, pixel[k, 1] + down * delay_s
            z = min(np.float64(depth[int(min(max(np.rint(v), 0), bottom)), int(min(max(np.rint(u), 0), right))]), FAR_M)
            of_floor = _image_velocity((u - cx) / focal * z, (v - cy) / focal * z, z, focal, still, twist)
            along, down = along - of_floor[0], down - of_floor[1]
        centre[k, 0], centre[k, 1] = pixel[k, 0] + along * delay_s, pixel[k, 1] + down * delay_s


@kernel(error_model="numpy", inline="always")
def _image_velocity(x, y, z, focal, drift, twist):
    """Returns the image velocity (columns, rows) [px/s] of a point (x, y, z), in the axes of the camera."""
    forward = drift[2] - twist[5] + x * twist[1] - y * twist[0]
    across = drift[0] - twist[3] + y * twist[2] - z * twist[1] - x / z * forward
    down = drift[1] - twist[4] + z * twist[0] - x * twist[2] - y / z * forward
    return focal * across / z, focal * down / z


@kernel
def _into_camera(start, shift, low, box, pose, points):
    """Computes the positions (3, n) of particles in camera axes; in the world: low + mod(start + shift, box)."""
    flat, xs, ys, zs = start.reshape(-1), points[0], points[1], points[2]
    (bx, by, bz), (per_x, per_y, per_z) = (box[0], box[1], box[2]), (1 / box[0], 1 / box[1], 1 / box[2])
    (px, py, pz), (lx, ly, lz) = (shift[0], shift[1], shift[2]), (low[0], low[1], low[2])
    a, b, c, d = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    e, f, g, h = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    i, j, m, o = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    for k in range(xs.size):
        x, y, z = flat[3 * k] + px, flat[3 * k + 1] + py, flat[3 * k + 2] + pz
        x = lx + x - bx * np.floor(x * per_x)
        y = ly + y - by * np.floor(y * per_y)
        z = lz + z - bz * np.floor(z * per_z)
        xs[k] = a * x + b * y + c * z + d
        ys[k] = e * x + f * y + g * z + h
        zs[k] = i * x + j * y + m * z + o


@kernel
def _test_view(points, view, seen):
    """Fills `seen` (n,) with whether `points` (3, n) are in view, up to `margin_px` + `reach_px_m` / depth outside."""
    focal, cx, cy, width, height, margin_px, reach_px_m, farthest_m = view
    xs, ys, zs = points[0], points[1], points[2]
    for k in range(seen.size):
        z = zs[k]
        margin = margin_px * z + reach_px_m
        u, v = focal * xs[k] + cx * z, focal * ys[k] + cy * z
        across = (u > -margin) & (u < width * z + margin)
        seen[k] = across & (v > -margin) & (v < height * z + margin) & (z > NEAREST_M) & (z <= farthest_m)


@kernel
def _draw(light, depth, centre, path, z, radiance, through, width, cover, first, end):
    cols, weights = depth.shape[1], np.empty(FOOTPRINT_PX)
    for k in range(z.size):
        radius = 0.5 * width[k] + 0.5
        reach_u, reach_v = radius + 0.5 * abs(path[k, 0]), radius + 0.5 * abs(path[k, 1])
        u0, u1 = int(np.ceil(centre[k, 0] - reach_u)), int(np.floor(centre[k, 0] + reach_u))
        v0, v1 = int(np.ceil(centre[k, 1] - reach_v)), int(np.floor(centre[k, 1] + reach_v))
        if v1 < first or v0 >= end or u1 < 0 or u0 >= cols:
            continue
        steps = int(np.ceil(np.sqrt(path[k, 0] ** 2 + path[k, 1] ** 2))) + 1
        spacing = 1 / np.sqrt(max(steps * steps - 1, 1))  # positions have the variance of a uniform path
        step_u, step_v = path[k, 0] * spacing, path[k, 1] * spacing
        total, at, across = 0.0, 0, u1 + 1 - u0
        for v in range(v0, v1 + 1):
            for u in range(u0, u1 + 1):
                weight = _swept(radius, u - centre[k, 0], v - centre[k, 1], step_u, step_v, steps)
                weights[min(at, FOOTPRINT_PX - 1)] = weight
                total, at = total + weight, at + 1
        if total <= 0:
            continue
        for v in range(max(v0, first), min(v1 + 1, end)):
            for u in range(max(u0, 0), min(u1 + 1, cols)):
                if depth[v, u] < z[k]:
                    continue
                if at <= FOOTPRINT_PX:
                    weight = weights[(v - v0) * across + u - u0]
                else:
                    weight = _swept(radius, u - centre[k, 0], v - centre[k, 1], step_u, step_v, steps)
                share = min(cover[k] * weight / total, 1.0)
                for c in range(3):
                    light[v, u, c] += np.float32(share * (radiance[k, c] - through[k, c] * light[v, u, c]))


@kernel(inline="always")
def _swept(radius, du, dv, step_u, step_v, steps):
    """Returns the mean coverage (0 to 1) of a pixel by a disc at `steps` evenly spaced positions, see `_rim`."""
    total, first = 0.0, 0.5 * (1 - steps)
    for i in range(steps):
        total += _rim(radius, du - (first + i) * step_u, dv - (first + i) * step_v)
    return total / steps


@kernel(inline="always")
def _rim(radius, du, dv):
    """Returns the coverage (0 to 1) of a pixel by a disc whose centre is (du, dv) away [px]."""
    return min(max(radius - np.sqrt(du * du + dv * dv), 0.0), 1.0)
