"""Positions of objects on a floor: one at a given position, or many scattered as a Poisson disc sample."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.errors import TwinError
from twin.scenario.model import ObjectConfig
from twin.terrains.objects.placed_object import ObjectModel, PlacedObject
from twin.terrains.terrain import Terrain

STEEP_DEG = 15.0  #: a floor less steep than this counts as sand; about half the angle of repose of sand
MAX_SCATTERED = 5000  #: largest number of objects of one entry
SIZE_CUT_SIGMA = 2.0  #: random sizes are limited to this many standard deviations of their logarithm
TRIES = (8, 64, 512)  #: sizes of the batches of random positions that are tried in turn for one object


class Disc(NamedTuple):
    x_m: float
    y_m: float
    radius_m: float


def place(
    number: int, group: ObjectConfig, models: Sequence[ObjectModel], terrain: Terrain,
    taken: Sequence[PlacedObject], seed: int,
) -> list[PlacedObject]:  # fmt: skip
    """Returns the objects of an entry of `[[objects]]` by its number, from 0; each has one of the models as its shape.

    Scattered objects do not overlap those of other entries, `taken`. Raises TwinError if an object with a given
    position reaches beyond the terrain; there would be no scattered object or too many, or they do not fit.
    """
    entry = _Entry(number, group, terrain, np.random.default_rng(np.random.SeedSequence([seed, number])))
    if group.position_m is None:
        return entry.scattered(models, taken)
    model = models[number % len(models)]
    item = entry.at(model, float(entry.scales([model])[0]), group.position_m)
    check_inside(item, terrain, f"objects.{number}.position_m")
    return [item]


def disc_of(item: PlacedObject) -> Disc:
    corners = item.corners_m()[:, :2]
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
    return Disc(float(centre[0]), float(centre[1]), float(np.linalg.norm(np.ptp(corners, axis=0)) / 2))


def slope_deg(terrain: Terrain, x_m: Array, y_m: Array, reach_m: float) -> Array:
    """Returns the slope of the floor (n,) [deg] at points, over `reach_m` on each side; NaN at the terrain's edge."""
    east = terrain.height_at(x_m + reach_m, y_m) - terrain.height_at(x_m - reach_m, y_m)
    north = terrain.height_at(x_m, y_m + reach_m) - terrain.height_at(x_m, y_m - reach_m)
    return np.rad2deg(np.arctan(np.hypot(east, north) / (2 * reach_m)))


class _Entry(NamedTuple):
    number: int
    group: ObjectConfig
    terrain: Terrain
    rng: np.random.Generator

    def scattered(self, models: Sequence[ObjectModel], taken: Sequence[PlacedObject]) -> list[PlacedObject]:
        field = f"objects.{self.number}.per_m2"
        low, high = self._region()
        n = self._count(low, high, field)
        chosen = [models[k] for k in self.rng.integers(0, len(models), n)]
        scales = self.scales(chosen)
        discs, own = np.array([disc_of(item) for item in taken]).reshape(-1, 3), np.zeros((n, 3))
        items: list[PlacedObject] = []
        sizes = [-scale * model.radius_m for scale, model in zip(scales, chosen, strict=True)]
        for k in np.argsort(sizes, kind="stable"):
            radius_m = float(scales[k]) * float(np.hypot(*(chosen[k].high_m - chosen[k].low_m)[:2]) / 2)
            around = np.concatenate([discs, own[: len(items)]])
            position = self._free_position(low + radius_m, high - radius_m, radius_m, around)
            if position is None:
                problem = f"only {len(items)} of {n} objects fit without overlap"
                raise TwinError(field, problem, "fewer or smaller objects, or a larger area")
            own[len(items)] = [*position, radius_m]
            items.append(self.at(chosen[k], float(scales[k]), position))
        return items

    def scales(self, models: Sequence[ObjectModel]) -> Array:
        """Returns the random scale (n,) of each object, its size divided by that of its model in `models` (n)."""
        z, size_m = self.rng.standard_normal(len(models)), self.group.size_m
        factor = np.exp(self.group.size_spread * np.clip(z, -SIZE_CUT_SIGMA, SIZE_CUT_SIGMA))
        return np.array([1.0 if size_m is None else size_m / model.size_m for model in models]) * factor

    def at(self, model: ObjectModel, scale: float, position_m: tuple[float, float]) -> PlacedObject:
        """Returns an object at a position (x, y) [m], sunk by a share of its height, upright or tilted to the floor."""
        # without a given height it stands on the floor; without a heading, that is random
        (x, y), group, terrain = position_m, self.group, self.terrain
        heading, phase = self.rng.uniform(0, 2 * np.pi, 2)
        if group.heading_deg is not None:
            heading = np.deg2rad(group.heading_deg)
        reach_m = scale * float((model.high_m - model.low_m)[:2].max()) / 4
        c, s = np.cos(heading), np.sin(heading)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        if not group.upright:
            rotation = _tilt(terrain, x, y, max(reach_m, terrain.spacing_m / 2)) @ rotation
        if group.height_m is not None:
            base = np.array([x, y, group.height_m])
        else:
            floor_m = _floor_under(terrain, x, y, 0.0 if not group.upright else reach_m)
            base = np.array([x, y, floor_m]) - rotation[:, 2] * group.sunk * scale * model.high_m[2]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = scale * rotation, base
        return PlacedObject(model, pose, float(scale), self.number, float(phase))

    def _region(self) -> tuple[Array, Array]:
        terrain, group = self.terrain, self.group
        low, high = np.array([terrain.west_m, terrain.south_m]), np.array([terrain.east_m, terrain.north_m])
        if group.area_m is None:
            return low, high
        half, centre = np.array(group.area_m) / 2, np.array(group.centre_m)
        return np.maximum(low, centre - half), np.minimum(high, centre + half)

    def _count(self, low: Array, high: Array, field: str) -> int:
        """Returns density times area of ground; raises TwinError if there are no or too many objects."""
        group = self.group
        assert group.per_m2 is not None
        area_m2 = float(np.maximum(high - low, 0).prod())
        steps = [np.linspace(a, b, 201)[:-1] + (b - a) / 400 for a, b in zip(low, high, strict=True)]
        x, y = np.meshgrid(*steps)
        share = float(self._on_ground(x, y, self.terrain.spacing_m).mean())
        n = round(group.per_m2 * area_m2 * share)
        if n > MAX_SCATTERED:
            raise TwinError(field, f"{group.per_m2:g}: {n} objects", f"at most {MAX_SCATTERED} objects")
        if n == 0:
            ground = {"anywhere": "of the area", "sand": "of sand", "slopes": "of slopes"}[group.on]
            raise TwinError(field, f"no object on {area_m2 * share:.2f} m2 {ground}", "more, or another area or ground")
        return n

    def _on_ground(self, x_m: Array, y_m: Array, reach_m: float) -> NDArray[np.bool_]:
        if self.group.on == "anywhere":
            return np.isfinite(self.terrain.height_at(x_m, y_m))
        slope = slope_deg(self.terrain, x_m, y_m, reach_m)
        return slope < STEEP_DEG if self.group.on == "sand" else slope >= STEEP_DEG

    def _free_position(self, low: Array, high: Array, radius_m: float, around: Array) -> tuple[float, float] | None:
        """Returns a random position (x, y) [m] between two corners, free for a circle of `radius_m`; or None."""
        # at least `group.spacing_m` from the centres `around` (n, 3): x, y, radius [m], none of which it overlaps
        if (low >= high).any():
            return None
        apart = np.maximum(around[:, 2] + radius_m, self.group.spacing_m)
        for n in TRIES:
            points = self.rng.uniform(low, high, (n, 2))
            free = (np.hypot(*(points[:, None] - around[:, :2]).T).T >= apart).all(axis=1)
            free &= self._on_ground(points[:, 0], points[:, 1], max(radius_m / 2, self.terrain.spacing_m))
            if free.any():
                x, y = points[free.argmax()]
                return float(x), float(y)
        return None


def _floor_under(terrain: Terrain, x: float, y: float, reach_m: float) -> float:
    """Returns the least floor height [m] at a point and eight points `reach_m` from it; NaN if none is on it."""
    angle = np.arange(8) * np.pi / 4
    heights = terrain.height_at(np.append(x, x + reach_m * np.cos(angle)), np.append(y, y + reach_m * np.sin(angle)))
    return float(np.nanmin(heights)) if np.isfinite(heights).any() else np.nan


def _tilt(terrain: Terrain, x: float, y: float, reach_m: float) -> Array:
    """Returns the rotation (3, 3), about a horizontal axis, that turns the vertical to the normal of the floor."""
    near = np.array([[reach_m, 0], [-reach_m, 0], [0, reach_m], [0, -reach_m]])
    east, west, north, south = terrain.height_at(x + near[:, 0], y + near[:, 1])
    normal = np.nan_to_num(np.array([west - east, south - north, 2 * reach_m]), nan=0.0)
    normal /= np.linalg.norm(normal)
    axis = np.array([-normal[1], normal[0], 0.0])
    skew = np.array([[0, 0, axis[1]], [0, 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + normal[2])


def check_inside(item: PlacedObject, terrain: Terrain, field: str) -> None:
    corners = item.corners_m()
    low, high = corners.min(axis=0), corners.max(axis=0)
    inside = low[0] >= terrain.west_m and low[1] >= terrain.south_m
    if inside and high[0] <= terrain.east_m and high[1] <= terrain.north_m:
        return
    extent = f"x {low[0]:.2f} to {high[0]:.2f}, y {low[1]:.2f} to {high[1]:.2f} m"
    raise TwinError(field, f"the object reaches beyond the terrain: {extent}", terrain.extent)
