"""Plain sensor model in fractions of full scale for scenarios without [sensor]: unlimited gain, zero exposure time."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array, Exposure, Image, Radiance
from twin.core.threads import in_row_bands
from twin.imaging.camera.random_numbers import NORMAL_MASK, normal_numbers, random_bits, seed_of
from twin.imaging.camera.shutter import ExposureMotion
from twin.kernels import kernel
from twin.scenario.model import ImagingConfig, Scenario

EXPOSURE_LAG_S = 0.5  # time constant of the auto-exposure

DARK_CD_M2 = 1e-6  # lower limit of the metered radiance
_HIGHLIGHTS = 0.002  # fraction of the pixel values that may saturate in a metered image
METERED = np.s_[::4, ::4]  # pixels on which highlights are metered


class AutoExposure:
    """Auto-exposure: adjusts the gain, with a lag, so that the mean of the brightest band reaches `gray_level`.

    The mean of all bands would let the least absorbed one saturate. The gain is lower if more than 0.2 % of the pixel
    values would saturate. `lag_s` is a time constant, 0 = no lag; `limits` are those of the gain [1 / (cd/m2)];
    `share` is the fraction by which log gain approaches its target per frame.
    """

    def __init__(
        self, gray_level: float, frame_rate_hz: float, lag_s: float = EXPOSURE_LAG_S,
        limits: tuple[float, float] = (0.0, math.inf),
    ):  # fmt: skip
        self._gray_level, self._limits = gray_level, limits
        self.share = 1 - np.exp(-1 / (frame_rate_hz * lag_s)) if lag_s else 1.0
        self._log_gain: float | None = None

    @property
    def next_gain(self) -> float | None:
        return None if self._log_gain is None else float(np.exp(self._log_gain))

    def gain(self, radiance: Radiance) -> float:
        """Returns the gain of this frame [1 / (cd/m2)], and meters `radiance` (H, W, 3) as in `gain_for`."""
        mean = _mean(np.ascontiguousarray(radiance).reshape(len(radiance), -1))
        return self.gain_for(float(mean.max()), highlight(radiance[METERED]))

    def gain_for(self, brightest: float, highlight: float) -> float:
        """Returns the gain of this frame and meters its mean radiance, of the brightest band, and its `highlight`."""
        least, most = self._limits
        wanted = min(self._gray_level / max(brightest, DARK_CD_M2), 1 / max(highlight, DARK_CD_M2))
        metered = float(np.log(min(max(wanted, least), most)))
        log_gain = metered if self._log_gain is None else self._log_gain
        self._log_gain = log_gain + self.share * (metered - log_gain)
        return float(np.exp(log_gain))


def highlight(values: Array | Radiance) -> float:
    """Returns the level that 0.2 % of the values of metered pixels exceed."""
    return float(np.quantile(values, 1 - _HIGHLIGHTS))


class ExposureSetting(NamedTuple):
    # linear signal per unit of radiance on the optical axis in white light [1 / (cd/m2)]; a signal of 1 saturates
    gain: float
    exposure_s: float = 0.0  # exposure time; 0 for the plain sensor
    analogue_gain: float = 1.0  # amplification before digitization
    # (3,) factors that the white balance applies to R, G, B; None = those for white light
    white: tuple[float, float, float] | None = None


class PlainSensor:
    """Sensor of both cameras with the noise of `[imaging]`."""

    def __init__(self, scenario: Scenario):
        self._imaging = scenario.imaging
        self._exposure = AutoExposure(scenario.imaging.gray_level, scenario.rig.frame_rate_hz)

    @property
    def setting(self) -> ExposureSetting | None:
        """Exposure of the next frame; None before the first frame is metered."""
        gain = self._exposure.next_gain
        return None if gain is None else ExposureSetting(gain)

    def meter(self, light: Radiance) -> ExposureSetting:
        """Returns this frame's exposure, and meters `light` (H, W, 3); the first frame is metered on itself."""
        return ExposureSetting(self._exposure.gain(light))

    def motion(self, twist: Array, setting: ExposureSetting, n_rows: int) -> ExposureMotion | None:
        return None

    def image(self, light: Radiance, setting: ExposureSetting, rng: np.random.Generator | None) -> Image:
        return expose(light, setting.gain, self._imaging, rng)

    def levels(self, light: Radiance, setting: ExposureSetting) -> NDArray[np.float32]:
        """Returns the noise-free image (H, W, 3) of a radiance image [grey levels, not rounded]."""
        return np.minimum(np.float32(255 * setting.gain) * light, np.float32(255))

    def signal_per_cd(self, setting: ExposureSetting) -> Exposure:
        return setting.gain, setting.gain, setting.gain


def expose(radiance: Radiance, gain: float, imaging: ImagingConfig, rng: np.random.Generator | None) -> Image:
    """Returns the 8-bit image (H, W, 3) of a radiance image [cd/m2], with noise unless `rng` is None.

    As fractions of full scale, the signal is `gain` per cd/m2, the noise variance noise_sd^2 + shot_noise^2 * signal.
    """
    image = np.empty(radiance.shape, np.uint8)
    rows = len(radiance)
    light, filled = np.ascontiguousarray(radiance).reshape(rows, -1), image.reshape(rows, -1)
    noise = (0.0, 0.0) if rng is None else (imaging.noise_sd**2, imaging.shot_noise**2)
    numbers = np.float32(gain), np.float32(noise[0]), np.float32(noise[1])
    seed, normal = np.uint64(0) if rng is None else seed_of(rng), normal_numbers()
    in_row_bands(lambda first, end: _digitise(light, *numbers, seed, normal, filled, first, end), rows)
    return image


@kernel
def _mean(light):
    """Returns the mean (3,) of each band of an image (H, 3 W); each column is averaged first, then all columns."""
    columns, total = np.zeros(light.shape[1]), np.zeros(3)
    for v in range(light.shape[0]):
        row = light[v]
        for k in range(row.size):
            columns[k] += row[k]
    for k in range(columns.size):
        total[k % 3] += columns[k] / light.shape[0]
    return total / (light.shape[1] // 3)


@kernel
def _digitise(light, gain, read_variance, shot_variance, seed, normal, image, first, end):
    n = light.shape[1]
    n_words = (n + 3) // 4
    full, half, zero = np.float32(255.0), np.float32(0.5), np.float32(0.0)
    noise = np.empty(4 * n_words, np.float32)
    for v in range(first, end):
        for w in range(n_words):
            bits = random_bits(seed, np.uint64(v * n_words + w))
            for k in range(4):
                noise[4 * w + k] = normal[(bits >> np.uint64(16 * k)) & np.uint64(NORMAL_MASK)]
        row, out = light[v], image[v]
        for k in range(n):
            signal = gain * row[k]
            level = signal + noise[k] * np.sqrt(read_variance + shot_variance * signal)
            out[k] = np.uint8(min(max(level * full + half, zero), full))
