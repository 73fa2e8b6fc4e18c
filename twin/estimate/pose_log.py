"""Record of the estimated poses, frame by frame."""

from __future__ import annotations

from twin.core.geometry import Array
from twin.core.series import GrowingArray


class PoseLog:
    """Times and estimated poses of all frames; each frame takes 360 bytes of memory.

    Attributes:
        n_lost: number of frames whose motion was not measured but predicted.
        repeats: rows of the frames at which a camera was frozen, by status (`vision.repeated_images`).
    """

    def __init__(self) -> None:
        self.n_lost = 0
        self.repeats: dict[str, list[int]] = {}
        self._times_s, self._f2f, self._online = GrowingArray(), GrowingArray(4, 4), GrowingArray(4, 4)
        self._steps, self._variances = GrowingArray(6), GrowingArray(6)

    def __len__(self) -> int:
        return len(self._times_s)

    @property
    def times_s(self) -> Array:
        """Returns the times (n,) of the frames [s]."""
        return self._times_s.array

    @property
    def f2f(self) -> Array:
        """Returns the world_from_camera (n, 4, 4) from frame-to-frame motion alone."""
        return self._f2f.array

    @property
    def online(self) -> Array:
        """Returns the world_from_camera (n, 4, 4) as estimated online."""
        return self._online.array

    @property
    def steps(self) -> Array:
        """Returns the twists (n, 6) from frame to frame: those of vision, or of the online pose where vision failed.

        The online pose also has the noise of the navigation sensors, but where vision fails they determine it.
        """
        return self._steps.array

    @property
    def variances(self) -> Array:
        """Returns the variances (n, 6) of `steps` [rad^2, m^2], in the axes of the later frame."""
        return self._variances.array

    def append(self, times_s: float | Array, f2f: Array, online: Array, steps: Array, variances: Array) -> None:
        """Appends one frame, with a time [s], poses (4, 4) and `steps` (6,), or n frames, with a leading axis n."""
        self._times_s.append(times_s)
        self._f2f.append(f2f)
        self._online.append(online)
        self._steps.append(steps)
        self._variances.append(variances)
