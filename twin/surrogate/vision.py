"""Vision that measures what images would tell: the truth with errors drawn from a calibrated model.

It stands on the left of the wall: it knows the truth and gives out measurements only, each with the covariance that the
image estimators would claim. A few points of a key point stand for all that would be matched, with their noise scaled
accordingly, and go through the very equations that the links are solved by; a node's own stereo noise is drawn once and
enters all its links.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin import geometry
from twin.config import Estimation
from twin.estimate import elevation, network, observation, stereo
from twin.estimate.f2f import MOST_POINTS as F2F_POINTS
from twin.estimate.f2f import coast
from twin.estimate.key_points import KeyPoint
from twin.estimate.mosaic import Registration
from twin.estimate.motion import Motion
from twin.estimate.stereo import StereoPoints
from twin.geometry import Array
from twin.records import ElevationMap, Frame, MapGrid, StereoRig, SurveyResult
from twin.surrogate.chart import CellErrors, Chart
from twin.surrogate.conditions import Conditions
from twin.surrogate.floor import Floor
from twin.surrogate.model import ErrorModel
from twin.surrogate.owners import Owners

_RASTER = (6, 8)  # rows and columns of points
_LEAST_POINTS = 12  # of these, and of those they stand for
_LEAST_SHARE = 0.3  # as of the links
_BLOCK = 4096  # numbers drawn at a time


class _Seen(NamedTuple):
    """A key point.

    Args:
        pose: true pose (4, 4).
        points: (n, 3) as (x, y, disparity), where rays of the raster met the floor.
        met: (n,) which rays these are.
        noise: (rows, cols, 3) standard normal numbers of the images there.
        bound_px: Cramer-Rao bound of a patch's place.
        n_points: matched points that they stand for.
    """

    pose: Array
    points: Array
    met: NDArray[np.int64]
    noise: Array
    bound_px: float
    n_points: float


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
        settings: Estimation,
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
        self._camera = (rig.focal_px, rig.cx_px, rig.cy_px, float(rig.width_px), float(rig.height_px), rig.baseline_m)
        self._pixels = _raster(rig)
        self._rays = stereo.normalised(self._pixels, rig)
        self._last: Array | None = None
        self._seen: dict[int, _Seen] = {}
        self._now: _Seen | None = None
        self._f2f: tuple[Array, Array, Array] | None = None  # root of the true covariance, claimed one, lasting error
        self._last_motion = np.eye(4)
        self._owners = Owners(rig)
        self._key = int(rng.integers(2**63))
        self._drawn, self._used = np.zeros((0, 6)), 0
        one = np.zeros((1, 2))
        self._unit_cov = stereo.fuse(one, one, np.eye(2)[None], rig)[1][0]  # of a point whose place errs by a pixel
        self._unit_root = np.linalg.cholesky(self._unit_cov)

    @property
    def bounds_px(self) -> tuple[float, float]:
        """Least and greatest Cramer-Rao bound that the survey can meet."""
        return self._conditions.bounds_px

    @property
    def bound_px(self) -> float:
        """Cramer-Rao bound of a patch's place at the last key point."""
        assert self._now is not None
        return self._now.bound_px

    @property
    def stand_for(self) -> float:
        """By how much the points of the last key point are fewer than those they stand for."""
        assert self._now is not None
        return len(self._now.points) / self._now.n_points

    def step(self, frame: Frame) -> tuple[Motion, str]:
        now = self._truth()
        last, self._last = self._last, now
        if last is None:
            return Motion(np.eye(4), np.eye(6) * 1e-12, 0, 0.0), "ok"
        if self._f2f is None:
            return coast(self._last_motion)
        root, cov, lasting = self._f2f
        self._last_motion = _moved(last, now, root, self._draw(), lasting)
        return Motion(self._last_motion, cov, F2F_POINTS, 0.0), "ok"

    def look(self, frame: Frame, row: int) -> StereoPoints | None:
        self._f2f = None  # until `restart`: where stereo finds nothing, there is nothing to follow
        with self.watch("stereo"):
            pose, model = self._truth(), self.model
            self.chart.see(pose)
            depth_m = self.floor.depth_at(self._pixels, pose, self.rig)
            met = np.flatnonzero(depth_m < np.inf)
            if len(met) < _LEAST_POINTS:
                return None
            depth_m = depth_m[met]
            bound_px = self._conditions.bound_px(float(depth_m.mean()))
            n_points = len(met) / len(self._rays) * model.points(bound_px) * self.settings.points
            if n_points < _LEAST_POINTS:
                return None
            truth = np.column_stack([self._rays[met], self.rig.baseline_m / depth_m])
            n = len(truth)
            place = model.place_px(bound_px) * np.sqrt(n / n_points)
            noise = self._rng.standard_normal((*_RASTER, 3))
            self._now = _Seen(pose, truth, met, noise, bound_px, n_points)
            measured = truth + noise.reshape(-1, 3)[met] @ (self._unit_root.T * place * model.place_excess)
            xyz = np.column_stack([measured[:, :2], np.ones(n)]) * (self.rig.baseline_m / measured[:, 2:])
            cov = np.broadcast_to(self._unit_cov * place**2, (n, 3, 3))
            return StereoPoints(self._pixels[met].astype(np.float32), np.zeros((n, 2)), measured, cov, xyz)

    def restart(self) -> None:
        assert self._now is not None
        model = self.model
        root, cov = self._motion_errors(model.f2f_px(self._now.bound_px))
        lasting = model.f2f_excess * model.f2f_lasting * (root @ self._draw())
        self._f2f = (model.f2f_excess * np.sqrt(1 - model.f2f_lasting**2) * root, cov, lasting)

    def _motion_errors(self, sigma_px: float) -> tuple[Array, Array]:
        """Root and covariance (6, 6) of a motion against known depths by eq. (2), where points err by so much."""
        assert self._now is not None
        points = self._now.points
        weight = np.full(len(points), F2F_POINTS / len(points))
        rows = observation.image_motion(points[:, 0], points[:, 1], self.rig.baseline_m / points[:, 2])
        normal, _ = observation.normal_equations(rows, weight, np.zeros((len(points), 2)))
        cov = np.asarray(np.linalg.inv(normal) * (sigma_px / self.rig.focal_px) ** 2, np.float64)
        return np.asarray(np.linalg.cholesky(cov), np.float64), cov

    def register(self, world_from_camera: Array) -> Registration | None:
        assert self._now is not None
        now = self._now.pose
        shares = self._owners.shares(now, self._now.points)
        if shares is None:
            return None
        predicted_from_world, offset = geometry.inverse(world_from_camera), np.zeros(6)
        for number, believed, share in shares:
            told = believed @ geometry.inverse(self._seen[number].pose) @ now
            offset += share * geometry.log(predicted_from_world @ told)
        root, cov = self._motion_errors(self.model.mosaic_px(self._now.bound_px))
        error = root @ self._draw() * self.model.mosaic_excess
        found = Motion(geometry.exp(offset + error), cov, len(self._now.points), 1.0)
        older = np.cumsum([share for _, _, share in sorted(shares, key=lambda s: s[0])])
        return Registration(found, sorted(number for number, _, _ in shares)[int(np.searchsorted(older, 0.5))])

    def lay(self, number: int, world_from_camera: Array) -> None:
        assert self._now is not None
        self._seen[number] = self._now
        self._owners.lay(number, world_from_camera, self._now.pose, self._now.points)

    def relay(self, keys: Sequence[KeyPoint]) -> None:
        self._owners.clear()
        for key in keys:
            seen = self._seen[key.number]
            self._owners.lay(key.number, key.world_from_camera, seen.pose, seen.points)

    def measure(self, node: KeyPoint, others: Sequence[KeyPoint]) -> list[Motion | None]:
        with self.watch("network"):
            assert self._now is not None
            here = self._seen.get(node.number, self._now)
            return [self._link(here, self._seen[k.number], node.number, k.number) for k in others]

    def _link(self, here: _Seen, there: _Seen, number: int, other: int) -> Motion | None:
        """The motion between two key points: one step of its equations from the truth, on noisy points.

        Its numbers are its own, whichever link is measured first.
        """
        model = self.model
        rng = np.random.Generator(np.random.Philox(key=self._key, counter=[0, 0, number, other]))
        there_from_here = geometry.inverse(there.pose) @ here.pose
        bound_px = max(here.bound_px, there.bound_px)
        n = len(here.points)
        place = model.place_px(bound_px) * np.sqrt(n / (here.n_points * model.matched(bound_px)))
        fresh, common = rng.standard_normal((n, 3)), rng.standard_normal(3) * model.common_px / self.rig.focal_px
        error, normal, by_common, in_view = _solve(
            here.points, here.noise.reshape(-1, 3)[here.met], there.noise, fresh, model.steady, common, there_from_here,
            self._camera, self._unit_cov * place**2, self._unit_root * (place * model.place_excess),
        )  # fmt: skip
        n_matched = int(in_view / n * here.n_points * model.matched(bound_px))
        if in_view < _LEAST_POINTS or n_matched < max(_LEAST_POINTS, _LEAST_SHARE * here.n_points):
            return None
        inverse = np.linalg.inv(normal)
        shared = inverse @ by_common * network.COMMON_PX / self.rig.focal_px
        claimed = inverse * model.correlation + shared @ shared.T
        return Motion(there_from_here @ geometry.exp(inverse @ error), claimed, n_matched, 1.0)

    def map(
        self, result: SurveyResult, grid: MapGrid, step_cov: Array, progress: Callable[[int], None]
    ) -> ElevationMap:
        model, mapper, shape = self.model, elevation.ElevationMapper(grid), (grid.rows, grid.cols)
        shared, lost = self._rng.standard_normal(shape, np.float32), self._rng.random(shape, np.float32)
        believed = result.final.world_from_camera[result.key_frames]
        seen = [self._seen[k] for k in range(len(believed))]
        depths_m, bounds_px = self._conditions.table
        depth_px, complete = (np.array([law(b) for b in bounds_px]) for law in (model.depth_px, model.complete))
        errors = CellErrors(shared, lost, model.lateral_px, depths_m, depth_px * model.depth_excess, depth_px, complete)
        for k, (here, following) in enumerate(zip(seen, [*seen[1:], None], strict=True)):
            next_pose = None if following is None else following.pose
            patch = self.chart.hand_over(here.pose, next_pose, believed[k], result.node_cov[k], errors, self._rng)
            if patch is not None:
                mapper.retire(patch)
            progress(k + 1)
        return mapper.result()

    def _draw(self) -> Array:
        """Six standard normal numbers, drawn by the block."""
        if self._used == len(self._drawn):
            self._drawn, self._used = self._rng.standard_normal((_BLOCK, 6)), 0
        self._used += 1
        return self._drawn[self._used - 1]


def _raster(rig: StereoRig) -> Array:
    """Pixels (n, 2) of the points, evenly over the image."""
    rows, cols = ((np.arange(n) + 0.5) / n for n in _RASTER)
    v, u = (a.ravel() for a in np.meshgrid(rows * rig.height_px, cols * rig.width_px, indexing="ij"))
    return np.column_stack([u, v]) - 0.5


@njit(cache=True, nogil=True)
def _moved(last, now, root, numbers, lasting):
    """The motion (4, 4) from one pose to the next, with an error."""
    return geometry.inverse(last) @ now @ geometry.exp(root @ numbers + lasting)


@njit(cache=True, nogil=True)
def _solve(points, here, there, fresh, steady, common, there_from_here, camera, cov, root):
    """Right side (6,), normal matrix (6, 6), effect of a shared error (6, 3), and how many points both see.

    Args:
        points: (n, 3) of the later key point.
        here: (n, 3) standard normal: what the later pair errs by at these points.
        there: (rows, cols, 3) the same of the earlier pair, over its image.
        fresh: (n, 3) what it errs by in this match alone; `steady` is the other's share.
        common: (3,) bias that all points share, normalised.
        cov, root: (3, 3) claimed covariance of a point in either pair, root of the true one.
    """
    focal, cx, cy, width, height, baseline = camera
    seen, _, _ = observation.transfer(points, there_from_here, baseline)
    n, margin, passing = 0, 5.0, np.sqrt(1 - steady * steady)
    a, b = np.empty_like(points), np.empty_like(points)
    for k in range(len(points)):
        u, v = seen[k, 0] * focal + cx, seen[k, 1] * focal + cy
        if margin <= u < width - margin and margin <= v < height - margin and u - focal * seen[k, 2] >= margin:
            cell = there[int(v / height * there.shape[0]), int(u / width * there.shape[1])]
            for r in range(3):
                a[n, r] = seen[k, r] + common[r]
                b[n, r] = points[k, r]
                for c in range(r + 1):
                    a[n, r] += root[r, c] * (steady * cell[c] + passing * fresh[k, c])
                    b[n, r] += root[r, c] * here[k, c]
            n += 1
    a, b = a[:n], b[:n]
    covs = np.empty((n, 3, 3))
    for k in range(n):
        covs[k] = cov
    error, _, by_motion, information, _ = observation.linearised(a, b, b, covs, covs, there_from_here, baseline)
    normal, right, by_common = observation.reduced(error, by_motion, information, np.ones(n))
    return right, normal, by_common, n
