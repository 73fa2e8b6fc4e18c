import numpy as np

from twin.core.geometry import Array
from twin.core.records import LEFT_REPEATS, RIGHT_REPEATS, Frame, Image, Readings, SensorNoise

_EVERY = 4  # every fourth row is compared
_MOST_CHANGED = 1e-3  # largest fraction of changed values in a repeated image; noise of 0.01 grey levels changes more
#: Largest deceleration with which a vehicle can come to rest between two frames [rad/s2, m/s2].
_LARGEST_DECELERATION = 1.0
_SIGNIFICANT = 5.0  # standard deviations
_TINY = 1e-6  # smallest standard deviation of a sensor: rounding errors of a noise-free one are not motion


class RepeatedImages:
    """Names the camera that repeats its image (a frozen camera), frame by frame.

    Noise changes every image of a live camera. Images without noise also repeat while the vehicle is at rest. They
    count as repeated only if the vehicle moves: it was faster at the last new image than it can stop within a frame, or
    its sensors, with this noise, measure motion. A camera that is frozen stays so until a new image arrives.
    """

    def __init__(self, noisy: bool, noise: SensorNoise):
        self._noisy, self._noise = noisy, noise
        self._last: dict[str, Image] = {}
        self._frozen: dict[str, bool] = {LEFT_REPEATS: False, RIGHT_REPEATS: False}
        self._readings: dict[str, list[Readings]] = {LEFT_REPEATS: [], RIGHT_REPEATS: []}
        self._time_s = np.nan

    def status(self, frame: Frame, twist: Array, interval_s: float) -> str:
        """Returns "ok", or which camera is frozen; the same answer if the frame is the last one again."""
        # `twist` (6,): velocity of the camera [rad/s, m/s] at the last frame; the right image may be missing
        if frame.time_s != self._time_s:
            self._time_s = frame.time_s
            moving = bool(np.abs(twist).max() > _LARGEST_DECELERATION * interval_s)
            for side, image in ((LEFT_REPEATS, frame.left), (RIGHT_REPEATS, frame.right)):
                self._readings[side].append(frame.readings)
                if image is not None:
                    self._judge(side, image, moving)
        return next((side for side, frozen in self._frozen.items() if frozen), "ok")

    def _judge(self, side: str, image: Image, moving: bool) -> None:
        """Compares an image of a camera with its last one; `moving`: whether the vehicle cannot be at rest."""
        rows = image[::_EVERY].copy()  # a copy: the caller may use the memory of the image again
        last, self._last[side] = self._last.get(side), rows
        if last is None or np.count_nonzero(rows != last) > _MOST_CHANGED * rows.size:
            self._frozen[side], self._readings[side] = False, self._readings[side][-1:]
        else:
            self._frozen[side] |= self._noisy or moving or _moved(self._readings[side], self._noise)


def _moved(readings: list[Readings], noise: SensorNoise) -> bool:
    """Returns whether readings of consecutive frames show significant motion: a velocity, or a change of pose."""
    first, last = readings[0], readings[-1]
    velocities = [one.dvl_mps for one in readings[1:] if one.dvl_mps is not None]
    ratios = [0.0]
    if velocities:
        ratios += list(np.abs(np.mean(velocities, axis=0)) / max(noise.dvl_mps / len(velocities) ** 0.5, _TINY))
    if first.pressure_z_m is not None and last.pressure_z_m is not None:
        ratios.append(abs(last.pressure_z_m - first.pressure_z_m) / max(noise.height_sigma_m * 2**0.5, _TINY))
    if first.ahrs_rpy_rad is not None and last.ahrs_rpy_rad is not None:
        turned = np.abs(np.angle(np.exp(1j * (last.ahrs_rpy_rad - first.ahrs_rpy_rad))))
        ratios += list(turned / np.maximum(noise.attitude_sigmas_rad * 2**0.5, _TINY))
    return max(ratios) > _SIGNIFICANT
