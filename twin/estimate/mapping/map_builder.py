"""The map from spooled keyframes along the final trajectory: Kalman depth filter, composition, mosaic (P18 to P20)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import ElevationMap, Image, MapGrid, StereoRig
from twin.estimate.mapping import depth_filter, elevation, surface
from twin.estimate.mapping.depth_filter import DepthMap, Mask
from twin.estimate.mapping.surface import Patch
from twin.estimate.vision import disparity

Array = NDArray[np.float64]
Map = NDArray[np.float32]

#: Stereo less certain than this [px] stays out of the map. Where texture fades into noise, half of what is less certain
#: is a mismatch: with a limit of 1 px the cells that err by more than 0.1 m double, with 0.35 px they are a third.
SURE_PX = 0.5


class KeyframeImages(NamedTuple):
    """The stereo pair of a keyframe, (H, W, 3) uint8 RGB."""

    left: Image
    right: Image


class _Seen(NamedTuple):
    """A stereo pair, its left image in grey and its depth by stereo alone."""

    pair: KeyframeImages
    gray: Map
    stereo: DepthMap


class _State(NamedTuple):
    """The filter at a keyframe: its map, gray left image and pose, and the map as the grid sees it."""

    depth: DepthMap
    gray: Map
    pose: Array
    patch: Patch | None


def build_map(
    keyframes: Iterable[KeyframeImages],
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
        keyframes: stereo pairs along the path, read one at a time.
        poses: (n, 4, 4) world_from_camera of the left camera.
        node_cov: (n, 6, 6) covariance of each pose [rotation, translation], in the camera (rad, m).
        progress: called with the number of keyframes done.
        step_cov: (n, 6, 6) covariance of each pose relative to the one before (the first is not used); exact if None.
        max_disparity_px: largest disparity searched; found from the images if None.
    """
    mapper, light, reach = elevation.ElevationMapper(grid), Light(rig), disparity.Reach(rig, max_disparity_px)
    steps = np.zeros((len(poses), 6, 6)) if step_cov is None else step_cov
    old = None
    for k, (pair, gray, stereo) in enumerate(_ahead(_look(pair, reach, rig) for pair in keyframes)):
        depth, taken = stereo, None
        if old is not None:
            depth, taken = _step(old, stereo, gray, poses[k], steps[k], rig)
        patch = surface.rasterise(depth, poses[k], node_cov[k], rig, grid)
        if old is not None and old.patch is not None:
            mapper.retire(old.patch, patch, taken)
        if patch is not None:
            light.see(pair.left)
            mapper.add_colours(patch, pair.left, light.gain())
        old = _State(depth, gray, poses[k], patch)
        if progress is not None:
            progress(k + 1)
    if old is not None and old.patch is not None:
        mapper.retire(old.patch)
    return mapper.result()


def _ahead(items: Iterator[_Seen]) -> Iterator[_Seen]:
    """The same items, the next one made on the second core while the last one is used."""
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(next, items, None)
        while (item := coming.result()) is not None:
            coming = pool.submit(next, items, None)
            yield item


def _look(pair: KeyframeImages, reach: disparity.Reach, rig: StereoRig) -> _Seen:
    """A stereo pair with its left image in grey and its depth map."""
    left, right = (np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8) for image in pair)
    stereo = disparity.dense_disparity(left, right, reach.max_disparity_px).surer_than(SURE_PX)
    reach.see(stereo.disparity_px)
    return _Seen(pair, left.astype(np.float32), depth_filter.stereo_depth(stereo, rig))


def _step(
    old: _State, stereo: DepthMap, gray: Map, pose: Array, step_cov: Array, rig: StereoRig
) -> tuple[DepthMap, Mask]:
    """Carries the filter to the next keyframe: old map, new stereo, then depth from the motion between them."""
    old_from_new = geometry.inverse(old.pose) @ pose
    fused, taken = depth_filter.carry(old.depth, stereo, geometry.inverse(old_from_new), step_cov, rig)
    motion = depth_filter.motion_depth(gray, old.gray, fused, old_from_new, step_cov, rig)
    return depth_filter.fuse(fused, motion), taken


class Light:
    """The mean light of the images so far: lamps travel with the camera, the floor does not, so only lamps stay."""

    def __init__(self, rig: StereoRig) -> None:
        self._size = (rig.width_px, rig.height_px)
        self._sum = np.zeros((-(-rig.height_px // 4), -(-rig.width_px // 4), 3), np.float32)
        self._count = 0

    def see(self, rgb: Image) -> None:
        """Takes an image into the mean, at a quarter of its size and blurred: only the lamps are wanted."""
        small = cv2.resize(rgb, self._sum.shape[1::-1], interpolation=cv2.INTER_AREA).astype(np.float32)
        self._sum += cv2.blur(small, (9, 9))
        self._count += 1

    def gain(self) -> Map:
        """(H, W, 3) factor that evens the light out."""
        mean = self._sum / self._count + 1
        return np.asarray(cv2.resize(mean.mean(axis=(0, 1)) / mean, self._size), np.float32)
