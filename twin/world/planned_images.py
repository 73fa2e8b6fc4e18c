"""Planned frames and keyframes, and the overlaps of their images over a floor."""

from __future__ import annotations

import numpy as np

from twin.controllers.segments import Reference
from twin.controllers.survey_plan import SurveyPlan
from twin.core import geometry
from twin.core.geometry import Array
from twin.core.height_field import HeightField, height_field
from twin.core.image_overlap import image_overlap
from twin.core.records import StereoRig
from twin.judge.flown_path import is_turning, leg_numbers, travel_direction
from twin.judge.overlap import ImagePairs, KeyframePoses, across_pairs, along_pairs
from twin.terrains import Terrain


def planned_references(plan: SurveyPlan) -> Reference:
    """Returns the references of the left camera at all n frames of a plan, without station keeping."""
    tracks = range(1, plan.n_tracks + 1)
    parts = [plan.references(track, plan.frames_of_track(track)[0]) for track in tracks]
    return Reference(*map(np.concatenate, zip(*parts, strict=True)))


def planned_keyframes(plan: SurveyPlan, pattern: str) -> KeyframePoses:
    """Returns the planned keyframes of all tracks, with the camera looking straight down."""
    are_keyframes = [plan.frames_of_track(track)[1] for track in range(1, plan.n_tracks + 1)]
    position, _, yaw, _ = planned_references(plan)
    keyframe, yaw = np.concatenate(are_keyframes), np.asarray(yaw)
    track = np.repeat(np.arange(plan.n_tracks), [len(part) for part in are_keyframes])
    swath = track if pattern == "loops" else np.where(is_turning(yaw), -1, leg_numbers(position))
    poses = np.tile(np.eye(4), (int(keyframe.sum()), 1, 1))
    poses[:, :3, :3] = geometry.rotations_of_down_camera(yaw[keyframe])
    poses[:, :3, 3] = position[keyframe]
    return KeyframePoses(poses, travel_direction(position)[keyframe], swath[keyframe])


def planned_pairs(keyframes: KeyframePoses) -> tuple[ImagePairs, ImagePairs]:
    """Returns the pairs of images from which the overlap along the swaths and the sidelap are computed."""
    return along_pairs(keyframes), across_pairs(keyframes)


def thinned(pairs: ImagePairs, most: int) -> ImagePairs:
    """Returns at most `most` of the pairs, chosen at equal intervals."""
    kept = np.unique(np.linspace(0, len(pairs.keyframe) - 1, min(most, len(pairs.keyframe))).astype(int))
    return ImagePairs(pairs.keyframe[kept], pairs.first[kept], pairs.second[kept])


def overlaps(field: HeightField, pairs: ImagePairs, rig: StereoRig) -> Array:
    """Returns the overlaps (m,) of pairs of images; NaN where the first image of a pair shows no floor."""
    return image_overlap(field, pairs.first, pairs.second, rig)


def floor_of(terrain: Terrain) -> HeightField:
    """Returns the height field of a terrain, for ray casting; there is no floor at its unknown nodes."""
    height = terrain.height_m if terrain.known is None else np.where(terrain.known, terrain.height_m, np.nan)
    return height_field(height, terrain.spacing_m, terrain.west_m, terrain.south_m)
