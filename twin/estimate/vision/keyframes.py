"""A keyframe of the survey: one stereo pair of the path (the paper's "key point")."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from twin.core.geometry import Array
from twin.core.records import Displacement, Readings
from twin.estimate.vision.stereo import StereoPoints


@dataclass
class Keyframe:
    """One stereo pair of the path.

    Args:
        number: counts the keyframes from 0.
        row: index of its frame in the trajectories.
        track: number of its track, from 1.
        world_from_camera: (4, 4) best pose so far.
        points: matched points of the pair while it is the newest.
        readings: of the navigation sensors.
        walked: displacement since the node before by the DVL; None without.
        walked_cov: (6, 6) what the motions up to here err by in sum, less what the mosaic told, in the world's axes.
    """

    number: int
    row: int
    track: int
    world_from_camera: Array
    points: StereoPoints | None
    readings: Readings
    walked: Displacement | None = None
    walked_cov: Array = field(default_factory=lambda: np.zeros((6, 6)))
