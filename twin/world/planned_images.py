"""Keyframes along the planned path, and their overlaps over a floor."""

from __future__ import annotations

import numpy as np

from twin.controllers.survey_plan import SurveyPlan
from twin.core import geometry
from twin.core.geometry import Array
from twin.core.height_field import HeightField, height_field
from twin.core.image_overlap import image_overlap
from twin.core.records import StereoRig
from twin.judge.flown_path import is_turning, leg_numbers, travel_direction
from twin.judge.overlap import ImagePairs, KeyframePoses, across_pairs, along_pairs
from twin.terrains import Terrain


def floor_of(terrain: Terrain) -> HeightField:
    """Returns the height field of a terrain, for ray casting; there is no floor at its unknown nodes."""
    height = terrain.height_m if terrain.known is None else np.where(terrain.known, terrain.height_m, np.nan)
    return height_field(height, terrain.spacing_m, terrain.west_m, terrain.south_m)


def level_floor(height_m: float, reach_m: float) -> HeightField:
    """Returns a level square floor at z = `height_m`, centred at the origin, with sides of 2 `reach_m`."""
    return height_field(np.full((2, 2), height_m), 2 * reach_m, -reach_m, -reach_m)


def planned_keyframes(plan: SurveyPlan, pattern: str) -> KeyframePoses:
    """Returns the planned keyframes of all tracks, with the camera looking straight down."""
    tracks = range(1, plan.n_tracks + 1)
    frames = [plan.frames_of_track(track) for track in tracks]
    references = [plan.references(track, times_s) for track, (times_s, _) in zip(tracks, frames, strict=True)]
    position = np.concatenate([r.position for r in references])
    yaw = np.concatenate([np.asarray(r.yaw) for r in references])
    keyframe = np.concatenate([is_keyframe for _, is_keyframe in frames])
    number = np.repeat(np.arange(plan.n_tracks), [len(r.position) for r in references])
    swath = number if pattern == "loops" else np.where(is_turning(yaw), -1, leg_numbers(position))
    poses = np.tile(np.eye(4), (int(keyframe.sum()), 1, 1))
    poses[:, :3, :3] = geometry.rotations_of_down_camera(yaw[keyframe])
    poses[:, :3, 3] = position[keyframe]
    return KeyframePoses(poses, travel_direction(position)[keyframe], swath[keyframe])


def planned_pairs(keyframes: KeyframePoses) -> tuple[ImagePairs, ImagePairs]:
    """Returns the pairs of images from which the overlap along the swaths and the sidelap are computed."""
    return along_pairs(keyframes), across_pairs(keyframes)


def overlaps(field: HeightField, pairs: ImagePairs, rig: StereoRig) -> Array:
    """Returns the overlaps (m,) of pairs of images; NaN where the first image of a pair shows no floor."""
    return image_overlap(field, pairs.first, pairs.second, rig)


def thinned(pairs: ImagePairs, most: int) -> ImagePairs:
    """Returns at most `most` of the pairs, chosen at equal intervals."""
    kept = np.unique(np.linspace(0, len(pairs.keyframe) - 1, min(most, len(pairs.keyframe))).astype(int))
    return ImagePairs(pairs.keyframe[kept], pairs.first[kept], pairs.second[kept])
