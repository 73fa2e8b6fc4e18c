"""What drifts between the cameras and the floor as a fault: a cloud of silt, and a school of fish."""

from typing import NamedTuple

import cv2
import numpy as np

from twin.core.geometry import Array
from twin.core.records import Image, StereoRig

_RISE_S, _SETTLE_S = 1.0, 3.0  # a cloud of silt rises within this time, and settles at this rate once it ends
_NOISE = 1.5  # standard deviation of the noise of an image of silt alone [grey levels]
_NEAR, _FAR = 0.3, 0.7  # fish swim at these shares of the distance to the floor
_LENGTHS_M, _SPEEDS_MPS, _GREYS = (0.1, 0.3), (0.1, 0.5), (40, 140)
_SLENDERNESS = 0.35  # height of a fish / its length


def silt_share(size: float, since_start_s: float, since_end_s: float) -> float:
    """Returns the share of the contrast that a cloud hides; `since_end_s` is 0 until it ends."""
    return size * min(1.0, since_start_s / _RISE_S) * float(np.exp(-since_end_s / _SETTLE_S))


def behind_silt(image: Image, share: float, rng: np.random.Generator) -> Image:
    """Returns an image that has lost a share of its contrast, at equal brightness; the noise of the camera remains."""
    seen = image.mean(axis=(0, 1)) * share + image * (1 - share)
    seen += rng.standard_normal(image.shape) * (_NOISE * np.sqrt(1 - (1 - share) ** 2))
    return np.clip(np.rint(seen), 0, 255).astype(np.uint8)


class School(NamedTuple):
    """Fish that swim through the view at constant velocities and come back on the other side."""

    share: Array  #: (n,) distance from the cameras / distance to the floor
    start: Array  #: (n, 2) position in the view at the start, fractions of its sides
    velocity_mps: Array  #: (n, 2) velocity along the columns and the rows
    length_m: Array  #: (n,)
    grey: Array  #: (n,)


def new_school(n: int, rng: np.random.Generator) -> School:
    angle = rng.uniform(-np.pi, np.pi, n)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return School(
        rng.uniform(_NEAR, _FAR, n), rng.uniform(0, 1, (n, 2)), direction * rng.uniform(*_SPEEDS_MPS, (n, 1)),
        rng.uniform(*_LENGTHS_M, n), rng.uniform(*_GREYS, n),
    )  # fmt: skip


def behind_fish(image: Image, school: School, time_s: float, camera: int, rig: StereoRig, floor_m: float) -> Image:
    """Returns an image of the left (0) or right (1) camera with a school between it and a floor at a distance [m]."""
    drawn = image.copy()
    for share, start, velocity, length_m, grey in zip(*school, strict=True):
        px_per_m = rig.focal_px / (share * floor_m)
        long, around = length_m * px_per_m / 2, np.array([rig.width_px, rig.height_px])
        room = around + 2 * long
        at = (start * room + velocity * px_per_m * time_s) % room - long
        at[0] -= camera * rig.baseline_m * px_per_m
        angle = float(np.degrees(np.arctan2(velocity[1], velocity[0])))
        centre, axes = (
            (round(float(at[0])), round(float(at[1]))),
            (max(1, round(long)), max(1, round(long * _SLENDERNESS))),
        )
        cv2.ellipse(drawn, centre, axes, angle, 0, 360, (grey, grey, grey), -1)
        cv2.ellipse(drawn, centre, axes, angle, 20, 160, (grey / 2,) * 3, -1)  # its darker back
    return drawn
