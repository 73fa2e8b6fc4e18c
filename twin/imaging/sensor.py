"""From radiance to numbers: exposure, shot noise, read noise, saturation, 8 bits.

The sensor of a scenario without a [sensor]: a gain without limits, noise by shares of full scale, no time of exposure.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core.records import Image
from twin.imaging.noise import NORMAL_MASK, normal_numbers, random_bits, seed_of
from twin.imaging.row_parallel import in_row_bands
from twin.scenario.model import ImagingConfig, Scenario

Array = NDArray[np.float64]
Radiance = NDArray[np.float32]
Depth = NDArray[np.float32]

EXPOSURE_LAG_S = 0.5  # time in which auto-exposure makes up for all but 1/e of a change of light

DARK_CD_M2 = 1e-6  # the gain is that of this light where there is less


class Exposure:
    """Auto-exposure: the gain that brings the mean of the brightest channel to `imaging.gray_level`, with a lag.

    Water takes colours away: by the mean of all channels the one that is left would saturate. The gain of a frame
    follows from the frames before it, as in a real camera; the first frame is metered.
    """

    def __init__(
        self,
        gray_level: float,
        frame_rate_hz: float,
        lag_s: float = EXPOSURE_LAG_S,
        reach: tuple[float, float] = (0.0, math.inf),
    ):
        self._gray_level = gray_level
        self._share = 1 - np.exp(-1 / (frame_rate_hz * lag_s)) if lag_s else 1.0
        self._reach = reach
        self._log_gain: float | None = None

    def gain(self, radiance: Radiance) -> float:
        """Gain of this frame [1 / (cd/m2)]; the light of this frame counts for the next ones."""
        return self.gain_for(float(_mean(np.ascontiguousarray(radiance).reshape(len(radiance), -1)).max()))

    def gain_for(self, brightest: float) -> float:
        """The same for a mean of the brightest channel [cd/m2]; what is out of reach is not waited for."""
        least, most = self._reach
        wanted = min(max(self._gray_level / max(brightest, DARK_CD_M2), least), most)
        metered = float(np.log(wanted))
        log_gain = metered if self._log_gain is None else self._log_gain
        self._log_gain = log_gain + self._share * (metered - log_gain)
        return float(np.exp(log_gain))


class Setting(NamedTuple):
    """How a frame is exposed.

    Args:
        gain: signal of 1 cd/m2 on the axis; a signal of 1 saturates.
        exposure_s: time that the shutter is open; 0 takes none.
        analogue_gain: factor before digitising.
    """

    gain: float
    exposure_s: float = 0.0
    analogue_gain: float = 1.0


class PlainSensor:
    """Sensor of both cameras: exposes at once, to any gain, with the noise of `[imaging]`."""

    def __init__(self, scenario: Scenario):
        self._imaging = scenario.imaging
        self._exposure = Exposure(scenario.imaging.gray_level, scenario.rig.frame_rate_hz)

    def meter(self, light: Radiance) -> Setting:
        """Setting of a frame, by the light of those before."""
        return Setting(self._exposure.gain(light))

    def gather(self, light: Radiance, depth: Depth, twist: Array, setting: Setting) -> Radiance:
        """The light while the shutter is open, for no time."""
        return light

    def image(self, light: Radiance, setting: Setting, rng: np.random.Generator | None) -> Image:
        """An image, without noise where `rng` is None."""
        if rng is not None:
            return expose(light, setting.gain, self._imaging, rng)
        noiseless = self._imaging.model_copy(update={"noise_sd": 0.0, "shot_noise": 0.0})
        return expose(light, setting.gain, noiseless, np.random.default_rng(0))


def expose(radiance: Radiance, gain: float, imaging: ImagingConfig, rng: np.random.Generator) -> Image:
    """An 8-bit image of the light: variance of the noise is read^2 + shot^2 * signal, all as shares of full scale.

    Args:
        radiance: (H, W, 3) [cd/m2].
        gain: signal per radiance; a signal of 1 saturates.
        imaging: noise.
        rng: stream of this camera; gives one number an image.
    """
    image = np.empty(radiance.shape, np.uint8)
    rows = len(radiance)
    light, filled = np.ascontiguousarray(radiance).reshape(rows, -1), image.reshape(rows, -1)
    numbers = np.float32(gain), np.float32(imaging.noise_sd**2), np.float32(imaging.shot_noise**2)
    seed, normal = seed_of(rng), normal_numbers()
    in_row_bands(lambda first, end: _digitise(light, *numbers, seed, normal, filled, first, end), rows)
    return image


@njit(cache=True, nogil=True)
def _mean(light):
    """(3,) mean of each band of an image (H, 3 W): of its columns, then of these."""
    columns, total = np.zeros(light.shape[1]), np.zeros(3)
    for v in range(light.shape[0]):
        row = light[v]
        for k in range(row.size):
            columns[k] += row[k]
    for k in range(columns.size):
        total[k % 3] += columns[k] / light.shape[0]
    return total / (light.shape[1] // 3)


@njit(cache=True, nogil=True)
def _digitise(light, gain, read_variance, shot_variance, seed, normal, image, first, end):
    """Fills rows `first` to `end` of `image` (H, 3 W); four draws come from each 64 random bits."""
    n = light.shape[1]
    n_words = (n + 3) // 4
    full, half, zero = np.float32(255.0), np.float32(0.5), np.float32(0.0)
    drawn = np.empty(4 * n_words, np.float32)
    for v in range(first, end):
        for w in range(n_words):
            bits = random_bits(seed, np.uint64(v * n_words + w))
            for k in range(4):
                drawn[4 * w + k] = normal[(bits >> np.uint64(16 * k)) & np.uint64(NORMAL_MASK)]
        row, out = light[v], image[v]
        for k in range(n):
            signal = gain * row[k]
            level = signal + drawn[k] * np.sqrt(read_variance + shot_variance * signal)
            out[k] = np.uint8(min(max(level * full + half, zero), full))
