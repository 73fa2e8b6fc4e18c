"""Ray casting against the floor without OpenGL, for surrogate surveys."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.core.floor_rays import cast_pixels, height_field
from twin.core.geometry import Array
from twin.core.records import StereoRig
from twin.terrains import Terrain

Depth = NDArray[np.float32]


class FloorRayCaster:
    """Intersects camera rays with the triangulated height grid of a terrain (see `core.floor_rays`)."""

    def __init__(self, terrain: Terrain):
        self.field = height_field(terrain.height_m, terrain.spacing_m, terrain.west_m, terrain.south_m)

    def depth_at(self, pixels: Array, world_from_camera: Array, rig: StereoRig) -> Array:
        """Returns the depth (n,) along the optical axis [m] at pixels (n, 2); inf where a ray misses the floor."""
        return cast_pixels(self.field, world_from_camera[None], rig, pixels)[0]

    def depth(self, world_from_camera: Array, rig: StereoRig) -> Depth:
        """Returns the depth image (height_px, width_px) along the optical axis [m]; inf where rays miss the floor."""
        grid = np.indices((rig.height_px, rig.width_px), dtype=np.float64)
        pixels = np.stack([grid[1].ravel(), grid[0].ravel()], axis=1)
        depth = self.depth_at(pixels, world_from_camera, rig)
        return depth.reshape(rig.height_px, rig.width_px).astype(np.float32)
