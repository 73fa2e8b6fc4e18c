"""Light of one pixel by the light model and by the Monte Carlo reference: records and functions of all comparisons."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.imaging.light.phase_function import phase_of
from twin.imaging.light.water import Medium
from twin.imaging.reference.pixel_light import BandWater, BatchMean

GREEN, ALBEDO = 1, 128  # band that is compared, and albedo of the floor; 255 = white


class ModelLight(NamedTuple):
    """Light of a pixel by the light model.

    Args:
        direct: light of the floor that was not scattered between floor and camera [cd/m2].
        blurred: forward-scattered light of the floor [cd/m2]; 0 if the scenario disables it.
        veil: backscatter [cd/m2].
        blur_near, blur_far: shares of the forward-scattered light that come from points of the floor within 2 px of the
            pixel and beyond 40 px; NaN without forward scatter.
    """

    direct: float
    blurred: float
    veil: float
    blur_near: float
    blur_far: float

    @property
    def total(self) -> float:
        """Returns the total radiance [cd/m2]."""
        return self.direct + self.blurred + self.veil

    @property
    def sharp_share(self) -> float:
        """Returns the share of the total that comes from the floor and was not scattered between floor and camera."""
        return self.direct / self.total


class LightCell(NamedTuple):
    """One cell of the comparison: conditions, light by the model, and light by the reference with standard errors.

    Args:
        water: Jerlov type.
        height_m: height of the camera above the floor [m].
        lamps: name of the lamp arrangement.
        pixel: (column, row) [px].
        model: light by the model.
        total, direct: light by the reference [cd/m2], see `PixelLight`.
        sharp_share: share of the total that comes from the floor and was not scattered between floor and camera.
        veil, veil_once: light by the reference [cd/m2], see `PixelLight`.
        blur_near, blur_far: shares of the blurred light whose point of the floor would, without scattering, be imaged
            within 2 px of the pixel and beyond 40 px.
    """

    water: str
    height_m: float
    lamps: str
    pixel: tuple[int, int]
    model: ModelLight
    total: BatchMean
    direct: BatchMean
    sharp_share: BatchMean
    veil: BatchMean
    veil_once: BatchMean
    blur_near: BatchMean
    blur_far: BatchMean


def green_of(water: Medium) -> BandWater:
    """Returns the optical properties of the water in the green band, for the Monte Carlo reference."""
    phase = phase_of(water.scatterers[GREEN])
    return BandWater(float(water.absorption_per_m[GREEN]), float(water.scattering_per_m[GREEN]), phase)


def looking_down(height_m: float) -> NDArray[np.float64]:
    """Returns the pose world_from_camera (4, 4) of a camera that points straight down, `height_m` above the origin."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = height_m
    return pose
