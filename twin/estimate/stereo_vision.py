"""What the method asks of the stereo camera: motion, points, corrections, links and a map; and how images answer.

`pipeline.Navigator` knows the questions only, so whoever else answers them (a model of the errors, say) flies the same
survey.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.records import ElevationMap, Frame, Image, MapGrid, StereoObservation, StereoRig, SurveyResult
from twin.estimate.mapping.map_builder import KeyframeImages, build_map
from twin.estimate.network import PairMatch
from twin.estimate.vision import disparity, image_scale, matching, stereo
from twin.estimate.vision.f2f import FrameToFrame
from twin.estimate.vision.image_spool import ImageSpool
from twin.estimate.vision.keyframes import Keyframe
from twin.estimate.vision.mosaic import Mosaic, Registration
from twin.estimate.vision.stereo import StereoPoints
from twin.estimate.vision.two_view_motion import Motion
from twin.scenario.model import EstimateConfig

_LEAST_POINTS = 12  # of a keyframe


class Vision(Protocol):
    """The stereo camera as the method uses it. Poses are (4, 4) of the left camera, motions as of `Motion`.

    Args:
        stereo_observations: so far, with both cameras.
    """

    stereo_observations: list[StereoObservation]

    def track_frame(self, frame: Frame) -> tuple[Motion, str]:
        """F2F: the motion since the last frame, and "ok" or why it failed."""
        ...

    def observe_stereo(self, frame: Frame, row: int) -> StereoPoints | None:
        """Stereo at a keyframe, which is row `row` of the trajectory; None where too few points are found."""
        ...

    def restart_tracking(self) -> None:
        """F2F goes on from the keyframe just looked at."""
        ...

    def register_with_mosaic(self, world_from_camera: Array) -> Registration | None:
        """F2M: correction of the predicted pose of the keyframe; None where the mosaic does not tell."""
        ...

    def add_to_mosaic(self, number: int, world_from_camera: Array) -> None:
        """Lays the keyframe into the mosaic."""
        ...

    def rebuild_mosaic(self, keys: Sequence[Keyframe]) -> None:
        """Lays the mosaic anew with these keyframes alone, the last ones of the path."""
        ...

    def measure_motions(self, node: Keyframe, others: Sequence[Keyframe]) -> list[Motion | None]:
        """Motion from each of other nodes to this one; None where images do not tell. Safe to call from a thread."""
        ...

    def discard(self, numbers: range) -> None:
        """No motion from these keyframes will be asked for any more."""
        ...

    def build_map(
        self, result: SurveyResult, grid: MapGrid, step_cov: Array, progress: Callable[[int], None]
    ) -> ElevationMap:
        """The elevation map along the final trajectory."""
        ...


class StereoVision:
    """Vision by the images themselves, at the scale that the first keyframe asks for.

    Args:
        rig: calibration as believed.
        settings: the scenario's [estimate].
        cell_m: cell of the mosaic at full size, about a pixel's footprint.
        folder: where the keyframes' images and the mosaic's tiles are spooled.
        watch: context manager per stage name.
    """

    def __init__(
        self,
        rig: StereoRig,
        settings: EstimateConfig,
        cell_m: float,
        folder: Path,
        watch: Callable[[str], AbstractContextManager[None]],
    ):
        self.full_rig, self.settings, self.watch = rig, settings, watch
        self._cell_m, self._folder = cell_m, folder
        self._use(binning=1)
        self.stereo_observations: list[StereoObservation] = []
        self._depth_of_keyframe: dict[int, NDArray[np.float16]] = {}
        self._points: StereoPoints | None = None

    def _use(self, binning: int) -> None:
        """Makes the tools for images of this scale."""
        self.binning, self.rig = binning, self.full_rig.binned(binning)
        self.spool = ImageSpool(self._folder, binning)
        self.f2f = FrameToFrame(self.rig, self.settings.patch_px)
        self.mosaic = Mosaic(self._cell_m * binning, self._folder / "mosaic")
        self.matcher = PairMatch(self.rig, self.spool, self.settings.patch_px)
        self.reach = disparity.Reach(self.rig)
        self._gray = np.zeros((self.rig.height_px, self.rig.width_px), np.float32)
        self._image = np.zeros((self.rig.height_px, self.rig.width_px), np.uint8)
        self._depth_m = np.zeros((self.rig.height_px, self.rig.width_px), np.float32)

    def _settle_scale(self, left: Image, right: Image) -> None:
        """Goes on at the scale that this pair asks for; nothing has been laid or kept yet."""
        binning = image_scale.binning(left, right, self.full_rig, self.settings)
        if binning != self.binning:
            self._use(binning)
            self._take(left)
            self.f2f.step(self._image)

    def _take(self, left: Image) -> None:
        """Makes the image of the left camera the one of now."""
        self._gray = matching.gray(left, self.binning)
        self._image = matching.normalise(self._gray)

    def track_frame(self, frame: Frame) -> tuple[Motion, str]:
        with self.watch("f2f"):
            self._take(frame.left)
            return self.f2f.step(self._image)

    def observe_stereo(self, frame: Frame, row: int) -> StereoPoints | None:
        assert frame.right is not None
        with self.watch("stereo"):
            if self._points is None:
                self._settle_scale(frame.left, frame.right)
            right = matching.gray(frame.right, self.binning)
            dense_px = disparity.search(self._image, matching.normalise(right), self.reach.max_disparity_px)
            self.reach.see(dense_px)
            points = stereo.points_of_pair(
                self._gray, right, dense_px, self.rig, self.settings.points, self.settings.patch_px
            )
        self.stereo_observations.append(StereoObservation(row, len(points.xyz), matching.contrast(self._gray)))
        if len(points.xyz) < _LEAST_POINTS:
            return None
        self._points, self._depth_m = points, _depth(dense_px, self.rig)
        self.spool.put(row, frame.left, frame.right, (self._gray, right))
        return points

    def restart_tracking(self) -> None:
        if self._points is not None:
            self.f2f.restart(self._image, self._points)

    def register_with_mosaic(self, world_from_camera: Array) -> Registration | None:
        assert self._points is not None
        half_m = half_window_m(self._points, self.rig)
        return self.mosaic.register(self._image, self._depth_m, world_from_camera, half_m, self.rig)

    def add_to_mosaic(self, number: int, world_from_camera: Array) -> None:
        self.mosaic.add(number, self._image, self._depth_m, world_from_camera, self.rig)
        self._depth_of_keyframe[number] = self._depth_m.astype(np.float16)

    def rebuild_mosaic(self, keys: Sequence[Keyframe]) -> None:
        self.mosaic.clear()
        self._depth_of_keyframe = {k.number: self._depth_of_keyframe[k.number] for k in keys}
        for key in keys:
            image = matching.normalise(self.spool.gray(key.row)[0])
            depth_m = self._depth_of_keyframe[key.number].astype(np.float32)
            self.mosaic.add(key.number, image, depth_m, key.world_from_camera, self.rig)

    def measure_motions(self, node: Keyframe, others: Sequence[Keyframe]) -> list[Motion | None]:
        with self.watch("flow"):
            matches = self.matcher.flows(node, others)
        motions: list[Motion | None] = []
        for other, matched in zip(others, matches, strict=True):
            with self.watch("network"):
                motions.append(None if matched is None else self.matcher.motion(node, other, matched))
        return motions

    def discard(self, numbers: range) -> None:
        """Nothing to do: their images are on disk."""

    def build_map(
        self, result: SurveyResult, grid: MapGrid, step_cov: Array, progress: Callable[[int], None]
    ) -> ElevationMap:
        return build_map(
            (self._pair(int(row)) for row in result.keyframe_rows),
            result.final.world_from_camera[result.keyframe_rows],
            result.node_cov,
            self.rig,
            grid,
            progress=progress,
            step_cov=step_cov,
        )

    def _pair(self, row: int) -> KeyframeImages:
        left, right = self.spool.pair(row)
        return KeyframeImages(matching.binned(left, self.binning), matching.binned(right, self.binning))


def half_window_m(points: StereoPoints, rig: StereoRig) -> float:
    """Half the side of the mosaic to register with: the view, and a fifth, at a depth that nine of ten points keep to.

    A mismatch may lie at any depth: by the farthest point one of 0.5 px asked for 20 GB of mosaic.
    """
    return 0.6 * float(np.quantile(points.xyz[:, 2], 0.9)) * rig.width_px / rig.focal_px


def _depth(disparity_px: NDArray[np.float32], rig: StereoRig) -> NDArray[np.float32]:
    """Depth (height, width) [m], NaN where the disparity is unknown or below one pixel."""
    usable = np.where(disparity_px > 1.0, disparity_px, np.nan)
    return (rig.focal_px * rig.baseline_m / usable).astype(np.float32)
