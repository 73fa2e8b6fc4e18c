"""Light of one pixel by the light model and by the Monte Carlo reference."""

from __future__ import annotations

from typing import NamedTuple

from twin.imaging.reference.pixel_light import BatchMean


class ModelLight(NamedTuple):
    """Light of a pixel by the light model.

    Args:
        direct: light of the floor without scattering [cd/m2].
        blurred: forward-scattered light of the floor [cd/m2]; 0 if the scenario disables it.
        veil: backscatter [cd/m2].
        blur_near, blur_far: shares of the kernel of the forward scatter near its centre and far from it.
    """

    direct: float
    blurred: float
    veil: float
    blur_near: float
    blur_far: float

    @property
    def total(self) -> float:
        """All light [cd/m2]."""
        return self.direct + self.blurred + self.veil

    @property
    def sharp_share(self) -> float:
        """Share of the light that was not scattered between floor and camera."""
        return self.direct / self.total


class LightCell(NamedTuple):
    """One cell of the comparison: key, light of the model, and light of the reference with standard errors.

    Args:
        water: Jerlov type.
        height_m: height of the camera above the floor.
        lamps: name of the fit of the lamps.
        pixel: (column, row) [px].
        model: light by the model.
        total, direct, veil, veil_once: light by the reference [cd/m2], see `PixelLight`.
        sharp_share: share of light of the floor that was not scattered between floor and camera.
        blur_near, blur_far: shares of the blurred light that arrive near the straight image and far from it.
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
