"""Vision that measures what images would tell: the truth with errors drawn from a calibrated model.

It stands on the left of the wall: it knows the truth and gives out measurements only, each with the covariance that the
image estimators would claim. A few points of a keyframe stand for all that would be matched, with their noise scaled
accordingly, and go through the very equations that the links are solved by; a node's own stereo noise is drawn once and
enters all its links.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import ElevationMap, Frame, MapGrid, StereoObservation, StereoRig, SurveyResult
from twin.estimate import network
from twin.estimate.mapping import elevation
from twin.estimate.vision import stereo
from twin.estimate.vision.f2f import MOST_POINTS as F2F_POINTS
from twin.estimate.vision.f2f import coast
from twin.estimate.vision.keyframes import Keyframe
from twin.estimate.vision.mosaic import Registration
from twin.estimate.vision.stereo import StereoPoints
from twin.estimate.vision.two_view_motion import Motion
from twin.scenario.model import EstimateConfig
from twin.surrogate import sampling
from twin.surrogate.error_model import ErrorModel
from twin.surrogate.floor_rays import Floor
from twin.surrogate.map_model import CellErrors, Chart
from twin.surrogate.matchability import Conditions
from twin.surrogate.mosaic_model import Cells, Owners, cells_of

_RASTER = (6, 8)  # rows and columns of points
_FIELD = 128  # cells of the floor until what it makes matches err by is the same again
_LEAST_POINTS = 12  # of those that the raster stands for
_BLOCK = 4096  # numbers drawn at a time


class _Seen(NamedTuple):
    """A keyframe.

    Args:
        pose: true pose (4, 4).
        points: (n, 3) as (x, y, disparity), where rays of the raster met the floor.
        met: (n,) which rays these are.
        noise: (rows, cols, 3) standard normal numbers of the images there.
        bound_px: Cramer-Rao bound of a patch's place.
        uneven_px: how far the floor under a patch lies out of its plane, as `conditions`.
        n_points: matched points that they stand for.
        unit_cov, unit_root: (6, 6) covariance of a motion against known depths by eq. (2), and its root, where
            normalised points err by one.
        cells: of the floor that the points lie in.
    """

    pose: Array
    points: Array
    met: NDArray[np.int64]
    noise: Array
    bound_px: float
    uneven_px: float
    n_points: float
    unit_cov: Array
    unit_root: Array
    cells: Cells


class FrameErrors(NamedTuple):
    """What motions from frame to frame err by: root of the true covariance, claimed one (6, 6), share undone."""

    root: Array
    cov: Array
    undone: float


class SurrogateVision:
    """Measurements drawn for one survey.

    Args:
        rig: calibration.
        settings: the scenario's [estimate].
        model: of the errors.
        truth: gives the true pose (4, 4) of the left camera now.
        floor: the true one.
        conditions: how well patches can be placed.
        chart: the floor by the cells of the map.
        rng: stream of all draws.
        watch: context manager per stage name.
    """

    def __init__(
        self,
        rig: StereoRig,
        settings: EstimateConfig,
        model: ErrorModel,
        truth: Callable[[], Array],
        floor: Floor,
        conditions: Conditions,
        chart: Chart,
        rng: np.random.Generator,
        watch: Callable[[str], AbstractContextManager[None]],
    ):
        self.rig, self.settings, self.model, self.watch = rig, settings, model, watch
        self._truth, self._conditions, self._rng, self.floor, self.chart = truth, conditions, rng, floor, chart
        margin_px = float(stereo.margin_px(settings.patch_px))
        self._camera = (
            rig.focal_px, rig.cx_px, rig.cy_px, float(rig.width_px), float(rig.height_px), margin_px, rig.baseline_m
        )  # fmt: skip
        self._pixels = _raster(rig)
        self._rays = stereo.normalised(self._pixels, rig)
        self.last_pose: Array | None = None  # true one of the last frame
        self.last_numbers = np.zeros(6)  # that its motion was drawn by
        self._poses: dict[int, Array] = {}  # true ones of all keyframes
        self._seen: dict[int, _Seen] = {}  # those that links may be asked for
        self._now: _Seen | None = None
        self.stereo_observations: list[StereoObservation] = []
        self._f2f: FrameErrors | None = None
        self._last_motion = np.eye(4)
        self._owners = Owners()
        self._key, self._own, self._drawing = int(rng.integers(2**63)), np.random.Generator(np.random.Philox(0)), Lock()
        self._begin: Any = self._own.bit_generator.state
        self._drawn, self._used = np.zeros((0, 6)), 0
        self._relief = rng.standard_normal((_FIELD, _FIELD, 2))
        one = np.zeros((1, 2))
        self._unit_cov = stereo.fuse(one, one, np.eye(2)[None], rig)[1][0]  # of a point whose place errs by a pixel
        self._unit_root = np.linalg.cholesky(self._unit_cov)

    @property
    def bounds_px(self) -> tuple[float, float]:
        """Least and greatest Cramer-Rao bound that the survey can meet."""
        bounds_px = self._conditions.bounds_px
        return float(bounds_px.min()), float(bounds_px.max())

    @property
    def lamp_share(self) -> float:
        """How much of the light is the lamps'."""
        return self._conditions.lamp_share

    @property
    def bound_px(self) -> float:
        """Cramer-Rao bound of a patch's place at the last keyframe."""
        assert self._now is not None
        return self._now.bound_px

    @property
    def stand_for(self) -> float:
        """By how much the points of the last keyframe are fewer than those they stand for."""
        assert self._now is not None
        return len(self._now.points) / self._now.n_points

    def way_in_depths(self, a_from_b: Array) -> float:
        """Length of a motion (4, 4) by the depth of the floor under the last keyframe."""
        assert self._now is not None
        return float(np.linalg.norm(a_from_b[:3, 3]) * np.mean(self._now.points[:, 2]) / self.rig.baseline_m)

    def track_frame(self, frame: Frame) -> tuple[Motion, str]:
        now = self._truth()
        last, self.last_pose = self.last_pose, now
        if last is None:
            return Motion(np.eye(4), np.eye(6) * 1e-12, 0, 0.0), "ok"
        if self._f2f is None:
            return coast(self._last_motion)
        numbers = self.draw(1)[0]
        self._last_motion = sampling.moved(self._f2f, last, now, numbers, self.last_numbers)
        self.last_numbers = numbers
        return Motion(self._last_motion, self._f2f.cov, F2F_POINTS, 0.0), "ok"

    @property
    def following(self) -> FrameErrors | None:
        """What frames err by since the last keyframe; None where nothing can be followed."""
        return self._f2f

    def observe_stereo(self, frame: Frame, row: int) -> StereoPoints | None:
        self._f2f = None  # until `restart`: where stereo finds nothing, there is nothing to follow
        with self.watch("stereo"):
            pose, model = self._truth(), self.model
            self.chart.see(pose)
            depth_m = self.floor.depth_at(self._pixels, pose, self.rig)
            met = np.flatnonzero(depth_m < np.inf)
            if len(met) < sampling.LEAST_POINTS:
                self.stereo_observations.append(StereoObservation(row, 0, None))
                return None
            mean_m = float(depth_m[met].mean())
            bound_px = self._conditions.bound_px(mean_m)
            n_points = len(met) / len(self._rays) * model.points(bound_px) * self.settings.points
            self.stereo_observations.append(StereoObservation(row, int(n_points), None))
            met = met[self._shown(met, depth_m)]
            if n_points < _LEAST_POINTS or len(met) < sampling.LEAST_POINTS:
                return None
            depth_m = depth_m[met]
            truth = np.column_stack([self._rays[met], self.rig.baseline_m / depth_m])
            n = len(truth)
            place = model.place_px(bound_px) * np.sqrt(n / n_points)
            noise = self._rng.standard_normal((*_RASTER, 3))
            unit = sampling.unit_motion(truth, self.rig.baseline_m, float(F2F_POINTS))
            cells = cells_of(pose, truth, self.rig.baseline_m)
            uneven_px = self._conditions.uneven_px(mean_m)
            self._now = _Seen(pose, truth, met, noise, bound_px, uneven_px, n_points, *unit, cells)
            measured = truth + noise.reshape(-1, 3)[met] @ (self._unit_root.T * place * model.place_excess)
            xyz = np.column_stack([measured[:, :2], np.ones(n)]) * (self.rig.baseline_m / measured[:, 2:])
            cov = np.broadcast_to(self._unit_cov * place**2, (n, 3, 3))
            pixels, around_px = self._pixels[met].astype(np.float32), self.rig.focal_px * measured[:, 2]
            return StereoPoints(pixels, np.zeros((n, 2)), around_px, measured, cov, xyz)

    def _shown(self, rows: NDArray[np.int64], depth_m: Array) -> NDArray[np.bool_]:
        """Which of these points of the raster, whose depths are `depth_m[rows]`, both cameras see well inside."""
        shift_px = self.rig.focal_px * self.rig.baseline_m / depth_m[rows]
        left_px, right_px = self._pixels[rows], self._pixels[rows]
        right_px[:, 0] -= shift_px
        in_left, in_right = (stereo.well_inside(px, self.rig, self.settings.patch_px) for px in (left_px, right_px))
        return in_left & in_right

    def restart_tracking(self) -> None:
        assert self._now is not None
        model = self.model
        root, cov = self._motion_errors(model.f2f_px(self._now.bound_px))
        alone = model.f2f_excess / np.sqrt(1 + model.f2f_undone**2)
        self._f2f, self.last_numbers = FrameErrors(alone * root, cov, model.f2f_undone), np.zeros(6)

    def _motion_errors(self, sigma_px: float) -> tuple[Array, Array]:
        """Root and covariance (6, 6) of a motion against known depths by eq. (2), where points err by so much."""
        assert self._now is not None
        sigma = sigma_px / self.rig.focal_px
        return self._now.unit_root * sigma, self._now.unit_cov * sigma**2

    def register_with_mosaic(self, world_from_camera: Array) -> Registration | None:
        assert self._now is not None
        now = self._now.pose
        shares = self._owners.shares(self._now.cells)
        if shares is None:
            return None
        true = np.array([self._poses[number] for number in shares.numbers])
        offset = sampling.mosaic_offset(shares.believed, true, shares.parts, now, world_from_camera)
        root, cov = self._motion_errors(self.model.mosaic_px(self._now.bound_px))
        error = root @ self.draw(1)[0] * self.model.mosaic_excess
        found = Motion(geometry.exp(offset + error), cov, len(self._now.points), 1.0)
        return Registration(found, shares.numbers[int(np.searchsorted(np.cumsum(shares.parts), 0.5))])

    def add_to_mosaic(self, number: int, world_from_camera: Array) -> None:
        assert self._now is not None
        self._poses[number], self._seen[number] = self._now.pose, self._now
        self._owners.lay(number, world_from_camera, self._now.cells)

    def rebuild_mosaic(self, keys: Sequence[Keyframe]) -> None:
        self._owners.clear()
        for key in keys:
            self._owners.lay(key.number, key.world_from_camera, self._seen[key.number].cells)

    def measure_motions(self, node: Keyframe, others: Sequence[Keyframe]) -> list[Motion | None]:
        return self.links(node, others, self.model)

    def discard(self, numbers: range) -> None:
        for number in numbers:
            self._seen.pop(number, None)

    def links(self, node: Keyframe, others: Sequence[Keyframe], model: ErrorModel) -> list[Motion | None]:
        """What `measure` answers by this model."""
        with self.watch("network"):
            assert self._now is not None
            here = self._seen.get(node.number, self._now)
            return [self._link(here, self._seen[k.number], node.number, k.number, model) for k in others]

    def _link(self, here: _Seen, there: _Seen, number: int, other: int, model: ErrorModel) -> Motion | None:
        """The motion between two keyframes: one step of its equations from the truth, on noisy points.

        Its numbers are its own, whichever link is measured first.
        """
        bound_px = max(here.bound_px, there.bound_px)
        n = len(here.points)
        fewer = np.sqrt(n / (here.n_points * model.matched(bound_px)))
        place = model.place_px(bound_px) * fewer
        excess = model.place_excess * np.hypot(1, model.lamps * self.lamp_share)
        numbers = self._numbers_of(number, other, n + 1)
        in_view, motion, cov = sampling.link(
            here.points, here.noise.reshape(-1, 3)[here.met], there.noise, self._relief, numbers, there.pose, here.pose,
            self._camera, self._unit_cov * place**2, self._unit_root * (place * excess), model.steady,
            model.relief * here.uneven_px / self.rig.focal_px * fewer, model.common_px / self.rig.focal_px, model.apart,
            network.COMMON_PX / self.rig.focal_px, model.correlation,
        )  # fmt: skip
        n_matched = int(in_view / n * here.n_points * model.matched(bound_px))
        if (
            in_view < sampling.LEAST_POINTS
            or n_matched < _LEAST_POINTS
            or model.matched(bound_px) < network.LEAST_SHARE
        ):
            return None
        return Motion(motion, cov, n_matched, 1.0)

    def _numbers_of(self, number: int, other: int, n: int) -> Array:
        """Standard normal numbers (n, 3) of a link."""
        begin = self._begin | {"state": {"key": [self._key, 0], "counter": [0, 0, number, other]}}
        with self._drawing:  # links are measured by other threads
            self._own.bit_generator.state = begin
            return self._own.standard_normal((n, 3))

    def build_map(
        self, result: SurveyResult, grid: MapGrid, step_cov: Array, progress: Callable[[int], None]
    ) -> ElevationMap:
        model, mapper, shape = self.model, elevation.ElevationMapper(grid), (grid.rows, grid.cols)
        shared, lost = self._rng.standard_normal(shape, np.float32), self._rng.random(shape, np.float32)
        believed = result.final.world_from_camera[result.keyframe_rows]
        true = [self._poses[k] for k in range(len(believed))]
        depths_m, bounds_px = self._conditions.depths_m, self._conditions.bounds_px
        depth_px, complete = (np.array([law(b) for b in bounds_px]) for law in (model.depth_px, model.complete))
        errors = CellErrors(shared, lost, model.lateral_px, depths_m, depth_px * model.depth_excess, depth_px, complete)
        for k, (pose, next_pose) in enumerate(zip(true, [*true[1:], None], strict=True)):
            patch = self.chart.hand_over(pose, next_pose, believed[k], result.node_cov[k], errors, self._rng)
            if patch is not None:
                mapper.retire(patch)
            progress(k + 1)
        return mapper.result()

    def draw(self, n: int) -> Array:
        """Six standard normal numbers, n times (n, 6); drawn by the block."""
        while self._used + n > len(self._drawn):
            fresh = self._rng.standard_normal((_BLOCK, 6))
            self._drawn, self._used = np.concatenate([self._drawn[self._used :], fresh]), 0
        self._used += n
        return self._drawn[self._used - n : self._used]


def _raster(rig: StereoRig) -> Array:
    """Pixels (n, 2) of the points, evenly over the image."""
    rows, cols = ((np.arange(n) + 0.5) / n for n in _RASTER)
    v, u = (a.ravel() for a in np.meshgrid(rows * rig.height_px, cols * rig.width_px, indexing="ij"))
    return np.column_stack([u, v]) - 0.5
