"""Renderer of the floor for a pinhole camera: depth by rasterization, then albedo by depth."""

import numpy as np

from twin.core.records import Array, Depth, Image
from twin.core.threads import in_row_bands
from twin.imaging.scene.floor_albedo import LEAST_COSINE, floor_surface, paint_floor
from twin.imaging.scene.floor_raster import draw_floor, floor_grid
from twin.imaging.scene.mesh_raster import NEAR_M, Projection
from twin.terrains import Terrain

_ALL = np.full(2, -np.inf), np.full(2, np.inf)


class Renderer:
    """Renderer of a floor for a camera with its optical axis at the centre of the image.

    The texture is painted `between` two corners (x, y) [m] and, when an image first shows more, everywhere.
    """

    def __init__(
        self, terrain: Terrain, width_px: int, height_px: int, focal_px: float, between: tuple[Array, Array] = _ALL
    ):
        self._shape = height_px, width_px
        self._view = Projection(focal_px, (width_px - 1) / 2, (height_px - 1) / 2, NEAR_M, True)
        self._grid, self._surface = floor_grid(terrain.height_m), floor_surface(terrain, *between)
        self._terrain, self._lowest_m, self._between = terrain, terrain.lowest_m, between
        x, y = width_px / 2 / focal_px, height_px / 2 / focal_px
        self._corners = np.array([[-x, x, -x, x], [-y, -y, y, y], [1.0, 1.0, 1.0, 1.0]])
        spacing, corner = terrain.spacing_m, (terrain.west_m, terrain.south_m)
        self._world_from_grid = np.array([[spacing, 0, 0, corner[0]], [0, spacing, 0, corner[1]], [0, 0, 1, 0]])

    def render(self, world_from_camera: Array) -> tuple[Image, Depth]:
        """Returns albedo (H, W, 3) uint8 RGB and depth (H, W) float32 along the optical axis [m]; inf = no floor."""
        low_m, high_m = self.footprint(world_from_camera)
        if (low_m < self._between[0]).any() or (high_m > self._between[1]).any():
            self._between, self._surface = _ALL, floor_surface(self._terrain, *_ALL)
        depth, albedo = np.zeros(self._shape, np.float32), np.empty((*self._shape, 3), np.uint8)
        camera_from_grid = world_from_camera[:3, :3].T @ self._world_from_grid
        camera_from_grid[:, 3] -= world_from_camera[:3, :3].T @ world_from_camera[:3, 3]

        def render_rows(first: int, end: int) -> None:
            rows = slice(first, end)
            draw_floor(self._grid, camera_from_grid, self._view, depth, rows)
            paint_floor(self._surface, depth, albedo, world_from_camera, self._view.focal_px, rows)

        in_row_bands(render_rows, len(depth))
        return albedo, depth

    def footprint(self, world_from_camera: Array) -> tuple[Array, Array]:
        """Returns two corners (x, y) [m] between which the texels of an image lie; infinite with the horizon in it."""
        rays, position = world_from_camera[:3, :3] @ self._corners, world_from_camera[:3, 3]
        height_m = position[2] - self._lowest_m
        if height_m <= 0 or rays[2].max() >= 0:
            return _ALL
        far_m = height_m / -rays[2]
        points = position[:2, None] + np.column_stack([np.zeros(2), far_m * rays[:2]])
        # a pixel takes at most 1 + 1 / LEAST_COSINE of its width along the floor, a sample of a level twice as much
        around_m = 3 * far_m.max() / self._view.focal_px / LEAST_COSINE
        return points.min(axis=1) - around_m, points.max(axis=1) + around_m

    def close(self) -> None:
        """Frees the floor; nothing can be rendered any more."""
        self.__dict__.clear()
