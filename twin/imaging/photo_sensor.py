"""The physical sensor of a scenario with a [sensor]: photons, electrons, digital numbers, and a slow shutter."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.core.records import Image, StereoRig
from twin.imaging.photons import electrons_per_cd, vignetting
from twin.imaging.pixels import Pixels, Raw, read_out
from twin.imaging.row_parallel import in_row_bands
from twin.imaging.sensor import Array, Depth, Exposure, PlainSensor, Radiance, Setting
from twin.imaging.shutter import roll, smear
from twin.scenario.model import Scenario, SensorConfig

BLACK_SHARE = 1 / 64  # of the scale lies below the black level, so that the noise of darkness has both its sides


class Sensor(Protocol):
    """What a stereo camera needs of the sensor that its eyes share."""

    def meter(self, light: Radiance) -> Setting: ...

    def gather(self, light: Radiance, depth: Depth, twist: Array, setting: Setting) -> Radiance: ...

    def image(self, light: Radiance, setting: Setting, rng: np.random.Generator | None) -> Image: ...


def sensor_of(scenario: Scenario, raw: StereoRig | None = None) -> Sensor:
    """A sensor that has seen nothing yet; `raw` has the size and lens of its images where they are not the frames."""
    return PlainSensor(scenario) if scenario.sensor is None else PhotoSensor(scenario, scenario.sensor, raw)


class PhotoSensor:
    """Sensor of both cameras: exposes longer, then amplifies; what is out of reach stays dark, or saturates.

    Auto-exposure meters the light itself, so that it does not hunt where an image saturates.
    """

    def __init__(self, scenario: Scenario, sensor: SensorConfig, raw: StereoRig | None = None):
        rig = scenario.believed_rig()
        self._sensor, self._focal_px = sensor, rig.focal_px
        self._vignetting = vignetting(rig if raw is None else raw, sensor.vignetting_power)
        self._electrons_per_cd_s = electrons_per_cd(sensor, scenario.port.water_index)
        top, self._black_dn = float((1 << sensor.bits) - 1), float(round(BLACK_SHARE * (1 << sensor.bits)))
        self._top_dn, self._dn_per_e = top, (top - self._black_dn) / sensor.full_well_e
        self._white = self._electrons_per_cd_s.max() / self._electrons_per_cd_s
        self._tones = self._developed()
        # Of 1 cd/m2 by a second of exposure at gain 1, in the band that fills first: white balance lifts the others.
        self._signal_per_s = float(self._electrons_per_cd_s.max()) / sensor.full_well_e
        self._shortest_s, self._longest_s = sensor.exposure_min_ms / 1000, sensor.exposure_max_ms / 1000
        self._most_gain = 10 ** (sensor.gain_max_db / 20)
        reach = self._signal_per_s * self._shortest_s, self._signal_per_s * self._longest_s * self._most_gain
        self._exposure = Exposure(scenario.imaging.gray_level, rig.frame_rate_hz, sensor.exposure_lag_s, reach)

    def meter(self, light: Radiance) -> Setting:
        """Setting of a frame, by the light of those before."""
        gain = self._exposure.gain_for(float(_weighted_mean(light, self._vignetting).max()))
        product_s = gain / self._signal_per_s
        exposure_s = min(max(product_s, self._shortest_s), self._longest_s)
        return Setting(gain, exposure_s, min(max(product_s / exposure_s, 1.0), self._most_gain))

    def gather(self, light: Radiance, depth: Depth, twist: Array, setting: Setting) -> Radiance:
        """The light while the shutter is open.

        Args:
            light: (H, W, 3) at the middle of the exposure, in the pinhole image that `depth` belongs to.
            twist: (6,) [angular, linear] velocity of the eye in its own axes [rad/s, m/s].
        """
        if not twist.any():
            return light
        if self._sensor.readout_ms:
            more_rows = (light.shape[0] - 1) / (self._vignetting.shape[0] - 1)  # than the sensor reads
            light = roll(light, depth, self._focal_px, twist, more_rows * self._sensor.readout_ms / 1000)
        return smear(light, depth, self._focal_px, twist, setting.exposure_s) if self._sensor.motion_blur else light

    def image(self, light: Radiance, setting: Setting, rng: np.random.Generator | None) -> Image:
        """An 8-bit image (H, W, 3), without noise where `rng` is None."""
        return self.develop(self.raw(light, setting, rng))

    def raw(self, light: Radiance, setting: Setting, rng: np.random.Generator | None) -> Raw:
        """Digital numbers as they leave the pixels: (H, W) behind a Bayer filter, else (H, W, 3)."""
        return read_out(light, self._vignetting, self._pixels(setting), self._sensor.bayer, rng)

    def develop(self, raw: Raw) -> Image:
        """An 8-bit RGB image (H, W, 3): black level off, white balanced for clear water, linear, bands interpolated."""
        toned = np.empty(raw.shape, np.uint8)
        bands = raw.reshape(*raw.shape[:2], -1), self._tones, toned.reshape(*raw.shape[:2], -1)
        in_row_bands(lambda first, end: _tone(*bands, first, end), len(raw))
        if raw.ndim == 3:
            return toned
        image = np.empty((*raw.shape, 3), np.uint8)
        cv2.cvtColor(toned, cv2.COLOR_BayerRGGB2RGB, image)
        return image

    def _pixels(self, setting: Setting) -> Pixels:
        return Pixels(
            self._electrons_per_cd_s * setting.exposure_s, self._sensor.full_well_e, self._sensor.read_noise_e,
            self._dn_per_e * setting.analogue_gain, self._black_dn, self._top_dn,
        )  # fmt: skip

    def _developed(self) -> NDArray[np.uint8]:
        """(3, 2^bits) tone of every digital number of each band."""
        signal = (np.arange(self._top_dn + 1) - self._black_dn) / (self._top_dn - self._black_dn)
        return np.clip(255 * self._white[:, None] * signal + 0.5, 0, 255).astype(np.uint8)


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _weighted_mean(light, weights):
    """(3,) mean of each band of `light` (H, W, 3) times `weights` (H, W)."""
    total = np.zeros(3)
    for v in range(weights.shape[0]):
        row, shares = light[v].reshape(-1), weights[v]
        red = green = blue = np.float32(0.0)
        for u in range(shares.size):
            red += shares[u] * row[3 * u]
            green += shares[u] * row[3 * u + 1]
            blue += shares[u] * row[3 * u + 2]
        total[0], total[1], total[2] = total[0] + red, total[1] + green, total[2] + blue
    return total / weights.size


@njit(cache=True, nogil=True)
def _tone(raw, tones, out, first, end):
    """Looks up each number of `raw` (H, W, 1 or 3), in rows `first` to `end`, in the tones of its band."""
    _, width, bands = raw.shape
    for v in range(first, end):
        for u in range(width):
            for k in range(bands):
                out[v, u, k] = tones[(v & 1) + (u & 1) if bands == 1 else k, raw[v, u, k]]
