"""Record of the estimated poses, frame by frame."""

from __future__ import annotations

from twin.core.geometry import Array
from twin.core.growing_array import GrowingArray


class PoseLog:
    """Times and estimated poses of all frames; each frame takes 264 bytes of memory.

    Attributes:
        n_lost: number of frames whose motion was not measured but predicted.
        repeats: rows of the frames at which a camera was frozen, by status (`vision.repeated_images`).
    """

    def __init__(self) -> None:
        self.n_lost = 0
        self.repeats: dict[str, list[int]] = {}
        self._times_s, self._f2f, self._online = GrowingArray(), GrowingArray(4, 4), GrowingArray(4, 4)

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

    def append(self, times_s: float | Array, f2f: Array, online: Array) -> None:
        """Appends one frame, with a time [s] and poses (4, 4), or n frames, with times (n,) and poses (n, 4, 4)."""
        self._times_s.append(times_s)
        self._f2f.append(f2f)
        self._online.append(online)
