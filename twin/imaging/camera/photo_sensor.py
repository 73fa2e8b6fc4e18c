"""Physical sensor (section [sensor] of a scenario): radiance to digital numbers; exposure and read-out time."""

from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array, Exposure, Image, Radiance, StereoRig
from twin.core.threads import QUICK, in_row_bands
from twin.imaging.camera.photons import electrons_per_cd, vignetting
from twin.imaging.camera.pixels import Raw, read_out
from twin.imaging.camera.sensor import METERED, AutoExposure, ExposureSetting, PlainSensor, highlight
from twin.imaging.camera.shutter import ExposureMotion
from twin.imaging.camera.tone import linear_of, tone
from twin.imaging.camera.white_balance import WhiteBalance
from twin.kernels import kernel
from twin.scenario.model import Scenario, SensorConfig

BLACK_SHARE = 1 / 64  # black level as a fraction of the number of levels, so that dark noise is not clipped at zero


class PhotoSensor:
    """Physical sensor of both cameras, with auto-exposure that increases first the exposure time, then the gain.

    It meters the radiance, so it does not oscillate if an image saturates. `raw_rig`: None = the rectified rig.
    """

    def __init__(self, scenario: Scenario, sensor: SensorConfig, raw_rig: StereoRig | None = None):
        rig = scenario.believed_rig()
        self._sensor = sensor
        self._vignetting = vignetting(rig if raw_rig is None else raw_rig, sensor.vignetting_power)
        self._flat = 1 / self._vignetting if sensor.shading_correction else np.ones_like(self._vignetting)
        self._delivered = self._vignetting * self._flat
        self._electrons_per_cd_s = electrons_per_cd(sensor, scenario.port.water_index)
        top, self._black_dn = float((1 << sensor.bits) - 1), float(round(BLACK_SHARE * (1 << sensor.bits)))
        self._top_dn, self._dn_per_e = top, (top - self._black_dn) / sensor.full_well_e
        self._white = WhiteBalance(scenario, self._electrons_per_cd_s)
        # signal per second at 1 cd/m2 and gain 1 in the most sensitive band; white balance amplifies the others
        self._signal_per_s = float(self._electrons_per_cd_s.max()) / sensor.full_well_e
        self._shortest_s, self._longest_s = sensor.exposure_min_ms / 1000, sensor.exposure_max_ms / 1000
        self._most_gain = 10 ** (sensor.gain_max_db / 20)
        limits = self._signal_per_s * self._shortest_s, self._signal_per_s * self._longest_s * self._most_gain
        gray_level = linear_of(scenario.imaging.gray_level, sensor.tone_curve)
        self._exposure = AutoExposure(gray_level, rig.frame_rate_hz, sensor.exposure_lag_s, limits)

    @property
    def setting(self) -> ExposureSetting | None:
        gain = self._exposure.next_gain
        return None if gain is None else self._setting(gain, self._white.next_factors)

    def meter(self, light: Radiance) -> ExposureSetting:
        """Returns this frame's exposure, and meters `light` (H, W, 3); the first frame is metered on itself."""
        mean = _weighted_mean(light, self._delivered)
        white = self._white.factors(mean, self._exposure.share)
        relative = white / self._white.of_white_light
        highlights = highlight(light[METERED] * self._delivered[METERED][..., None] * relative)
        return self._setting(self._exposure.gain_for(float((mean * relative).max()), highlights), white)

    def _setting(self, gain: float, white: Array) -> ExposureSetting:
        product_s = gain / self._signal_per_s
        exposure_s = min(max(product_s, self._shortest_s), self._longest_s)
        amplification = min(max(product_s / exposure_s, 1.0), self._most_gain)
        return ExposureSetting(gain, exposure_s, amplification, (white[0], white[1], white[2]))

    def motion(self, twist: Array, setting: ExposureSetting, n_rows: int) -> ExposureMotion | None:
        """Returns the motion of a camera with a twist (6,) in its own axes, for `n_rows` rendered; None: no effect."""
        row_ratio = (n_rows - 1) / (self._vignetting.shape[0] - 1)  # rendered rows per row of the sensor
        readout_s = row_ratio * self._sensor.readout_ms / 1000
        exposure_s = setting.exposure_s if self._sensor.motion_blur else 0.0
        return ExposureMotion(twist, exposure_s, readout_s) if twist.any() and (readout_s or exposure_s) else None

    def image(self, light: Radiance, setting: ExposureSetting, rng: np.random.Generator | None) -> Image:
        return self.develop(self.raw(light, setting, rng), setting.white)

    def levels(self, light: Radiance, setting: ExposureSetting) -> NDArray[np.float32]:
        """Returns the noise-free image (H, W, 3) of a radiance image [grey levels, not rounded]."""
        signal = light * (self._vignetting[..., None] * np.array(self.signal_per_cd(setting), np.float32))
        signal = np.minimum(np.minimum(signal, 1.0) * self._flat[..., None], 1.0)
        levels = 255 * tone(signal, self._sensor.tone_curve)
        return np.asarray(levels, np.float32)

    def signal_per_cd(self, setting: ExposureSetting) -> Exposure:
        """Returns the linear signal of R, G and B per unit of radiance on the optical axis [1 / (cd/m2)]."""
        white = self._white.of_white_light if setting.white is None else np.array(setting.white)
        red, green, blue = (setting.gain * (white / self._white.of_white_light)).tolist()
        return red, green, blue

    def raw(self, light: Radiance, setting: ExposureSetting, rng: np.random.Generator | None) -> Raw:
        """Returns raw digital numbers: (H, W) with a Bayer filter, else (H, W, 3); without noise if `rng` is None."""
        electrons, gain = self._electrons_per_cd_s * setting.exposure_s, self._dn_per_e * setting.analogue_gain
        noise = self._sensor.full_well_e, self._sensor.read_noise_e
        response = np.array([*electrons, *noise, gain, self._black_dn, self._top_dn], np.float32)
        return read_out(light, self._vignetting, response, self._sensor.bayer, rng)

    def develop(self, raw: Raw, white: tuple[float, float, float] | None = None) -> Image:
        """Returns the 8-bit RGB image (H, W, 3) of raw digital numbers; `white` None = the balance of white light."""
        toned = np.empty(raw.shape, np.uint8)
        tones = self._tone_table(self._white.of_white_light if white is None else np.array(white))
        shading = self._flat, np.float32(self._black_dn), np.float32(self._top_dn)
        bands = raw.reshape(*raw.shape[:2], -1), tones, *shading, toned.reshape(*raw.shape[:2], -1)
        in_row_bands(lambda first, end: _tone(*bands, first, end), len(raw), QUICK)
        if raw.ndim == 3:
            return toned
        image = np.empty((*raw.shape, 3), np.uint8)
        cv2.cvtColor(toned, cv2.COLOR_BayerRGGB2RGB, image)
        return image

    def _tone_table(self, white: Array) -> NDArray[np.uint8]:
        """Returns the tone table (3, 2^bits): the 8-bit value of each digital number in each band."""
        signal = (np.arange(self._top_dn + 1) - self._black_dn) / (self._top_dn - self._black_dn)
        return np.clip(255 * tone(white[:, None] * signal, self._sensor.tone_curve) + 0.5, 0, 255).astype(np.uint8)


Sensor: TypeAlias = PlainSensor | PhotoSensor


def sensor_of(scenario: Scenario, raw_rig: StereoRig | None = None) -> Sensor:
    """Returns a scenario's sensor in its initial state; `raw_rig` see `PhotoSensor`."""
    return PlainSensor(scenario) if scenario.sensor is None else PhotoSensor(scenario, scenario.sensor, raw_rig)


@kernel(fastmath={"contract", "reassoc"})
def _weighted_mean(light, weights):
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


@kernel
def _tone(raw, tones, flat, black, top, out, first, end):
    _, width, bands = raw.shape
    zero, half = np.float32(0.0), np.float32(0.5)
    for v in range(first, end):
        for u in range(width):
            for k in range(bands):
                number = black + (np.float32(raw[v, u, k]) - black) * flat[v, u] + half
                out[v, u, k] = tones[(v & 1) + (u & 1) if bands == 1 else k, int(min(max(number, zero), top))]
