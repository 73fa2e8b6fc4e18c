"""The map from spooled key points along the final trajectory: Kalman depth filter, composition, mosaic (P18 to P20)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin import geometry
from twin.estimate import depth_filter, disparity, elevation
from twin.estimate.depth_filter import DepthMap, Mask
from twin.records import ElevationMap, Image, MapGrid, StereoRig

Array = NDArray[np.float64]
Map = NDArray[np.float32]

#: Disparities are searched up to that of a surface at this part of the rig's distance to the grid's reference.
LEAST_SHARE_SEEN = 0.05


class KeyPointImages(NamedTuple):
    """The stereo pair of a key point, (H, W, 3) uint8 RGB."""

    left: Image
    right: Image


class _State(NamedTuple):
    """The filter at a key point: its map, gray left image and pose."""

    depth: DepthMap
    gray: Map
    pose: Array
    cov: Array


def build_map(
    key_points: Iterable[KeyPointImages],
    poses: Array,
    node_cov: Array,
    rig: StereoRig,
    grid: MapGrid,
    progress: Callable[[int], None] | None = None,
    step_cov: Array | None = None,
    max_disparity_px: int | None = None,
) -> ElevationMap:
    """Composes the elevation map, its uncertainty and the photo mosaic.

    Args:
        key_points: stereo pairs along the path, read one at a time.
        poses: (n, 4, 4) world_from_camera of the left camera.
        node_cov: (n, 6, 6) covariance of each pose [rotation, translation], in the camera (rad, m).
        progress: called with the number of key points done.
        step_cov: (n, 6, 6) covariance of each pose relative to the one before (the first is not used); exact if None.
        max_disparity_px: largest disparity searched; a quarter of the image's width if None.
    """
    mapper, light = elevation.ElevationMapper(grid), Light()
    steps = np.zeros((len(poses), 6, 6)) if step_cov is None else step_cov
    search = max_disparity_px or rig.width_px // 4
    state = None
    for k, pair in enumerate(key_points):
        gray = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in pair]
        stereo = depth_filter.stereo_depth(disparity.dense_disparity(gray[0], gray[1], search), rig)
        new = _State(stereo, gray[0].astype(np.float32), poses[k], node_cov[k])
        if state is not None:
            new, kept = _step(state, new, steps[k], rig)
            _retire(mapper, state, ~kept, rig)
        light.see(pair.left)
        patch = elevation.rasterise(new.depth, new.pose, new.cov, rig, grid)
        if patch is not None:
            mapper.add_colours(patch, pair.left, light.gain())
        state = new
        if progress is not None:
            progress(k + 1)
    if state is not None:
        _retire(mapper, state, np.ones_like(state.depth.depth_m, dtype=bool), rig)
    return mapper.result()


def _step(old: _State, new: _State, step_cov: Array, rig: StereoRig) -> tuple[_State, Mask]:
    """Carries the filter to the next key point: old map, new stereo, then depth from the motion between them."""
    old_from_new = geometry.inverse(old.pose) @ new.pose
    fused, kept = depth_filter.carry(old.depth, new.depth, geometry.inverse(old_from_new), step_cov, rig)
    motion = depth_filter.motion_depth(new.gray, old.gray, fused, old_from_new, step_cov, rig)
    return new._replace(depth=depth_filter.fuse(fused, motion)), kept


def _retire(mapper: elevation.ElevationMapper, state: _State, retired: Mask, rig: StereoRig) -> None:
    """Hands the retired pixels of a map to the composite map."""
    patch = elevation.rasterise(state.depth, state.pose, state.cov, rig, mapper.grid)
    if patch is not None:
        mapper.add_heights(patch, retired)


class Light:
    """The mean light of the images so far: lamps travel with the camera, the floor does not, so the mean shows the lamps."""

    def __init__(self) -> None:
        self._sum: Map | None = None
        self._count = 0

    def see(self, rgb: Image) -> None:
        """Takes an image into the mean, at a quarter of its size and blurred: only the lamps are wanted."""
        small = cv2.resize(rgb, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA).astype(np.float32)
        soft = cv2.blur(small, (9, 9))
        self._sum = soft if self._sum is None else self._sum + soft
        self._count, self._shape = self._count + 1, rgb.shape[:2]

    def gain(self) -> Map:
        """(H, W, 3) factor that evens the light out."""
        mean = self._sum / self._count + 1
        return cv2.resize(mean.mean(axis=(0, 1)) / mean, self._shape[::-1], interpolation=cv2.INTER_LINEAR)
