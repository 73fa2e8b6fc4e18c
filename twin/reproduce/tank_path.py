"""Paths of the stereo rig on the overhead track of the tank, which is not straight: planned positions, true poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry

Array = NDArray[np.float64]

STEP_M, HEIGHT_M = 0.05, 1.524  # between frames; of the cameras above the floor (5 ft)
LEG_M, LEG_SPACING_M, N_LEGS = 0.97, 0.25, 5
N_LOOP = 30  # steps of one loop
#: Bend of the track: the rig is displaced by up to BEND_M across it, within about BEND_WIDTH_M of x = BEND_AT_M.
BEND_M, BEND_AT_M, BEND_WIDTH_M = 0.012, 0.2, 0.15
JITTER_M, JITTER_RAD = 0.001, float(np.deg2rad(0.1))  # standard deviation of each axis


class RigPath(NamedTuple):
    """Path of the rig.

    Args:
        planned_m: (n, 3) positions of the left camera as read on the track.
        world_from_camera: (n, 4, 4) true poses of the left camera.
        repeats: numbers (from 0) of the frames that repeat frame 0.
    """

    planned_m: Array
    world_from_camera: Array
    repeats: tuple[int, ...] = ()

    @property
    def start(self) -> Array:
        """Returns the planned pose (4, 4) of the left camera at the first frame: level, optical axis along -z."""
        return geometry.pose(geometry.rotations_of_down_camera(np.zeros(1))[0], self.planned_m[0])


def lawnmower_path(n_pairs: int, seed: int) -> RigPath:
    """Returns the path of the first test: parallel legs along x joined by half circles, 5 cm between pairs.

    Args:
        n_pairs: number of stereo pairs; the path is long enough for 137.
        seed: seed of the jitter.
    """
    turn_m = LEG_SPACING_M / 2
    angle = np.linspace(0, np.pi, 181)[:-1]
    turn = turn_m * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    sides = [-1 if k % 2 else 1 for k in range(N_LEGS)]
    south_m = -(N_LEGS - 1) / 2 * LEG_SPACING_M
    parts = [
        np.concatenate([[[-LEG_M / 2, 0.0]], turn + [LEG_M / 2, 0.0]]) * [side, 1] + [0.0, south_m + k * LEG_SPACING_M]
        for k, side in enumerate(sides)
    ]
    points = np.concatenate(parts)
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    along = STEP_M * np.arange(n_pairs)
    return _rig_path(np.column_stack([np.interp(along, lengths, points[:, axis]) for axis in range(2)]), seed)


def two_loops_path(seed: int) -> RigPath:
    """Returns the path of the second test: two circles that touch at the start; frames 30 and 60 repeat frame 0."""
    radius_m = N_LOOP * STEP_M / (2 * np.pi)
    angle = 2 * np.pi * np.arange(N_LOOP + 1) / N_LOOP
    loop = radius_m * np.column_stack([1 - np.cos(angle), np.sin(angle)])
    path = _rig_path(np.concatenate([loop, loop[1:] * [-1, 1]]), seed)
    poses = path.world_from_camera.copy()
    repeats = N_LOOP, 2 * N_LOOP
    poses[list(repeats)] = poses[0]
    return RigPath(path.planned_m, poses, repeats)


def _rig_path(xy: Array, seed: int) -> RigPath:
    """Returns the path for planned positions `xy` (n, 2) [m]; true poses include the bend of the track and jitter."""
    rng, n = np.random.default_rng(seed), len(xy)
    planned = np.column_stack([xy, np.full(n, HEIGHT_M)])
    bend = BEND_M * np.exp(-(((xy[:, 0] - BEND_AT_M) / BEND_WIDTH_M) ** 2))
    position = planned + np.column_stack([np.zeros(n), bend, np.zeros(n)]) + rng.normal(0, JITTER_M, (n, 3))
    level = geometry.rotations_of_down_camera(np.zeros(n))
    turned = np.array([geometry.so3_exp(w) for w in rng.normal(0, JITTER_RAD, (n, 3))])
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = level @ turned, position
    return RigPath(planned, poses)
