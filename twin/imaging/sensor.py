"""From radiance to numbers: exposure, shot noise, read noise, saturation, 8 bits."""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import ndtri

from twin.config import Imaging
from twin.records import Image

Radiance = NDArray[np.float32]

EXPOSURE_LAG_S = 0.5  # time in which auto-exposure makes up for all but 1/e of a change of light

DARK_CD_M2 = 1e-6  # the gain is that of this light where there is less


class Exposure:
    """Auto-exposure: the gain that brings the mean of the brightest channel to `imaging.gray_level`, with a lag.

    Water takes colours away: by the mean of all channels the one that is left would saturate. The gain of a frame
    follows from the frames before it, as in a real camera; the first frame is metered.
    """

    def __init__(self, gray_level: float, frame_rate_hz: float):
        self._gray_level = gray_level
        self._share = 1 - np.exp(-1 / (frame_rate_hz * EXPOSURE_LAG_S))
        self._log_gain: float | None = None

    def gain(self, radiance: Radiance) -> float:
        """Gain of this frame [1 / (cd/m2)]; the light of this frame counts for the next ones."""
        brightest = float(radiance.mean(axis=0, dtype=np.float64).mean(axis=0).max())
        metered = float(np.log(self._gray_level / max(brightest, DARK_CD_M2)))
        log_gain = metered if self._log_gain is None else self._log_gain
        self._log_gain = log_gain + self._share * (metered - log_gain)
        return float(np.exp(log_gain))


def expose(radiance: Radiance, gain: float, imaging: Imaging, rng: np.random.Generator) -> Image:
    """An 8-bit image of the light: variance of the noise is read^2 + shot^2 * signal, all as shares of full scale.

    Args:
        radiance: (H, W, 3) [cd/m2].
        gain: signal per radiance; a signal of 1 saturates.
        imaging: noise.
        rng: stream of this camera.
    """
    chances = np.frombuffer(rng.bytes(2 * radiance.size), np.uint16)
    image = np.empty(radiance.shape, np.uint8)
    variances = np.float32(imaging.noise_sd**2), np.float32(imaging.shot_noise**2)
    _digitise(radiance.reshape(-1), chances, _normal_quantiles(), np.float32(gain), *variances, image.reshape(-1))
    return image


@cache
def _normal_quantiles() -> NDArray[np.float32]:
    """Standard normal numbers that 16 random bits choose from, evenly: several times faster than drawing them."""
    quantiles = ndtri((np.arange(1 << 16) + 0.5) / (1 << 16))
    return (quantiles / quantiles.std()).astype(np.float32)


@njit(cache=True, nogil=True)
def _digitise(radiance, chances, normal, gain, read_variance, shot_variance, image):
    """Fills `image` (n,) uint8."""
    full = np.float32(255.0)
    for k in range(radiance.size):
        signal = gain * radiance[k]
        level = signal + normal[chances[k]] * np.sqrt(read_variance + shot_variance * signal)
        image[k] = np.uint8(min(max(level * full + np.float32(0.5), np.float32(0.0)), full))
