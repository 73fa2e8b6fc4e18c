import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.links import Link, Links
from twin.core.quality import CalibrationEstimate, DisparityOffset, DistortionError, YawEffect
from twin.core.records import Alignment, Displacement, SensorNoise, StereoRig
from twin.core.series import GrowingArray
from twin.core.settings import EstimatorSettings
from twin.core.timing import StageTimer
from twin.errors import SurveyAborted
from twin.estimate import calibration_errors, link_selection
from twin.estimate.alignment import AlignmentResult, align
from twin.estimate.calibration_errors import row_pattern
from twin.estimate.self_calibration import MeasuredErrors, fused
from twin.estimate.vision.epipolar_calibration import NOTICEABLE_PX
from twin.estimate.vision.stereo import Keyframe
from twin.estimate.vision.two_view_motion import Motion
from twin.estimate.vision_interface import Vision

_REFERENCE_COV = np.eye(6) * 1e-12  # the first pose defines the world frame
_FIXED_COV = np.eye(6) * 1e-10  # nodes older than the window are practically fixed
_START_NODES = 4  # the first nodes are candidates for every link, because loops return to the reference position
_REMEASURED_PX = 0.05  # error of disparities above which a link is measured again, as its effect is not linear
_VIEWED_NODES = 200  # latest nodes whose views are counted at every keyframe: the time grows with their square
_MOST_PENDING = 8  # largest number of nodes with link measurements in progress


class LinkAttempt(NamedTuple):
    """Result of the measurement of one link."""

    link: Link | None  #: None if the measurement failed
    motion: Motion | None  #: the measured motion

    @property
    def yaw(self) -> YawEffect | None:
        return None if self.motion is None else self.motion.yaw


@dataclass
class AlignmentHistory:
    """Record of the link measurements, in the order of the nodes, and of the global alignments so far."""

    alignments: list[Alignment] = field(default_factory=list[Alignment])
    dropped: list[Link] = field(default_factory=list[Link])  #: links rejected as outliers by any alignment
    #: before_ga, after_ga: positions (n, 3) of the keyframes just before and after each alignment of a track [m].
    before_ga: list[Array] = field(default_factory=list[Array])
    after_ga: list[Array] = field(default_factory=list[Array])
    link_residuals: list[float] = field(default_factory=list[float])  #: those of all `LinkAttempt`s; NaN: failed
    #: disparity_offsets, yaws, distortions: estimates and sigmas (n, 2) of all `LinkAttempt`s that have them.
    disparity_offsets: GrowingArray = field(default_factory=lambda: GrowingArray(2))
    yaws: GrowingArray = field(default_factory=lambda: GrowingArray(2))
    distortions: GrowingArray = field(default_factory=lambda: GrowingArray(2))
    #: standard deviations (3-D) of positions relative to the previous keyframe, by F2F alone [m], where known.
    frame_sigmas_m: list[float] = field(default_factory=list[float])
    nodes_bridged: int = 0  #: number of nodes whose link to the previous node is the F2F motion
    independent_errors: float | None = None  #: see `AlignmentResult`, of the final alignment; None before it
    calibration: CalibrationEstimate = CalibrationEstimate()  #: that of the last alignment


class KeyframeNetwork:
    """Keyframes of a survey, those of them that are nodes, and the measured motions that link the nodes.

    Links are measured in a separate thread if `vision.runs_in_background`, otherwise when they are collected.
    `reference_cov` (6, 6) is the first node's prior covariance [rotation, translation] (rad, m), by default negligible.
    """

    def __init__(
        self, vision: Vision, rig: StereoRig, noise: SensorNoise, settings: EstimatorSettings, stopwatch: StageTimer
    ):
        self.vision, self.rig, self.noise, self.settings, self.stopwatch = vision, rig, noise, settings, stopwatch
        self.keyframes: list[Keyframe] = []
        self.nodes: list[Keyframe] = []
        self.links = Links()
        self.history = AlignmentHistory()
        self._node_poses = np.empty((64, 4, 4))  # capacity grows by doubling
        self._executor = ThreadPoolExecutor(1) if vision.runs_in_background else None
        #: for each pending node: waits for its links, link to the last node, F2F motion in its place.
        self._pending: deque[tuple[Callable[[], list[LinkAttempt]], list[LinkAttempt], list[Link]]] = deque()
        self._alignable = True
        self.reference_cov = _REFERENCE_COV

    def __getstate__(self) -> dict[str, Any]:
        """Returns the state after all pending links have been measured in the separate thread."""
        pending = self._pending
        if self._executor is not None:
            pending = deque(
                (partial(list[LinkAttempt], measure()), chain, bridge) for measure, chain, bridge in pending
            )
        return vars(self) | {"_executor": None, "_pending": pending}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._executor = ThreadPoolExecutor(1) if self.vision.runs_in_background else None

    def close(self) -> None:
        """Drops the pending link measurements and ends the thread, after the measurement in progress."""
        self._pending.clear()
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)

    @property
    def poses(self) -> Array:
        return np.array([k.world_from_camera for k in self.keyframes]).reshape(-1, 4, 4)

    def add(self, keyframe: Keyframe) -> None:
        if self.keyframes:
            self.keyframes[-1].points = None  # links start from the points of the newer node
        self.keyframes.append(keyframe)

    def overlap(self, keyframe: Keyframe, world_from_camera: Array) -> float:
        """Returns the predicted overlap (`link_selection.overlaps`) of a keyframe with the image at a pose."""
        return float(link_selection.overlaps(keyframe, world_from_camera[None], self.rig, self.settings.patch_px)[0])

    def link_to_last_node(self, node: Keyframe) -> LinkAttempt | None:
        """Measures the link from the last node to a new one; None for the first node. Raises OSError."""
        if not self.nodes:
            return None
        last = self.nodes[-1], self.overlap(node, self.nodes[-1].world_from_camera)
        attempt = self._measure(node, [last])[0]
        if self.rig.yaw_sigma_rad and attempt.yaw is not None:
            yaw_rad, _ = self.yaw_rad(attempt.yaw)
            if abs(yaw_rad - node.yaw_rad) * self.rig.focal_px > _REMEASURED_PX:
                node.yaw_rad = yaw_rad
                attempt = self._measure(node, [last])[0]
        return attempt

    def _measure(self, node: Keyframe, others: list[tuple[Keyframe, float]]) -> list[LinkAttempt]:
        motions = self.vision.measure_motions(node, [other for other, _ in others])
        return [
            LinkAttempt(motion and link_selection.to_link(node, other, overlap, motion), motion)
            for (other, overlap), motion in zip(others, motions, strict=True)
        ]

    def connect(
        self, node: Keyframe, chain: LinkAttempt | None, bridge: Link | None, displacement: Displacement | None
    ) -> None:
        """Adds a node and starts the measurement of its links to earlier nodes other than the last one.

        `chain` is the link from the last node (`link_to_last_node`), `bridge` the F2F motion since then, fused with the
        DVL, in place of one that could not be measured; `displacement` is that by the DVL, None if not measured. Raises
        OSError if images could not be read or written; the network is then incomplete and `align_all` returns None.
        """
        with self.stopwatch("network"):
            first = bisect_left(self.nodes, node.track - self.settings.window_tracks, key=lambda k: k.track)
            oldest, n = min(_START_NODES, first), len(self.nodes)
            window = self.nodes[:oldest] + self.nodes[first:]
            poses = np.concatenate([self._node_poses[:oldest], self._node_poses[first:n]])
            chosen = link_selection.choose_links(node, window, poses, self.rig, self.settings)
        others = [(k, overlap) for k, overlap in chosen if k is not self.nodes[-1]]
        # a copy, because the points of the node are released before its links are measured
        measure = partial(self._measure, replace(node), others)
        started = self._executor.submit(measure).result if self._executor else measure
        self._pending.append((started, [chain] if chain else [], [bridge] if bridge else []))
        self.history.nodes_bridged += bridge is not None
        self._collect_links(all_but=_MOST_PENDING)
        node.dvl_displacement = displacement if chain and chain.link else None  # `bridge` already includes it
        self.nodes.append(node)
        if len(self.nodes) > len(self._node_poses):
            self._node_poses = np.concatenate([self._node_poses, np.empty_like(self._node_poses)])
        self._node_poses[n] = node.world_from_camera

    def _collect_links(self, all_but: int = 0) -> None:
        """Adds the links of pending nodes to the network, oldest first, until at most `all_but` nodes are pending."""
        # after any error of a measurement, nothing is pending, and the network is incomplete
        while len(self._pending) > all_but:
            measure, chain, bridge = self._pending[0]
            try:
                attempts = measure() + chain
                measured = [attempt.link for attempt in attempts if attempt.link is not None]
                links = link_selection.inflate_for_shared_noise(measured)
            except Exception:
                self.abandon_alignment()
                raise
            self._pending.popleft()
            self.links.add(links + bridge)
            self.history.link_residuals += [np.nan if a.motion is None else a.motion.residual for a in attempts]
            motions = [attempt.motion for attempt in attempts if attempt.motion is not None]
            self.history.disparity_offsets.append([m.disparity_offset for m in motions if m.disparity_offset])
            self.history.yaws.append([motion.yaw[:2] for motion in motions if motion.yaw])
            self.history.distortions.append([motion.distortion for motion in motions if motion.distortion])

    def align_window(self, track: int) -> Array | None:
        """Aligns the nodes of the window of tracks that ends with `track`, and rebuilds the mosaic from this track.

        Returns the marginal covariance (6, 6) of the pose of the last node [rotation, translation] (rad, m), in its
        camera axes; None if the global alignment is switched off, or with fewer than two nodes or none in the window.
        Raises SurveyAborted if the alignment failed, OSError if images could not be read or written.
        """
        first = track - self.settings.window_tracks
        if not self.settings.use_ga or len(self.nodes) < 2 or self.nodes[-1].track < first:
            return None
        before = self.poses[:, :3, 3].copy()
        self._collect_links()
        with self.stopwatch("ga"):
            aligned = self._align([k for k in self.nodes if k.track >= first], track, marginals=[self.nodes[-1].number])
        self.vision.rebuild_mosaic([k for k in self.keyframes if k.track >= track])
        left = bisect_left(self.nodes, first, key=lambda k: k.track)
        if left > _START_NODES:
            self.vision.discard(range(self.nodes[_START_NODES - 1].number + 1, self.nodes[left].number))
        self.history.before_ga.append(before)
        self.history.after_ga.append(self.poses[:, :3, 3].copy())
        return aligned.covs[-1]

    def align_all(self) -> Array | None:
        """Aligns all nodes by the links in the network; call `truncate` first. Raises SurveyAborted."""
        # returns, for each keyframe, the marginal covariance (6, 6) of the pose of the latest node up to it; None if
        # switched off, abandoned or failed before, or with fewer than two nodes
        if not (self.settings.use_ga and self._alignable and len(self.nodes) >= 2):
            return None
        with self.stopwatch("ga"):
            aligned = self._align(self.nodes, self.nodes[-1].track, marginals=None)
        self.history.independent_errors = aligned.independent_errors
        numbers = [k.number for k in self.keyframes]
        return aligned.covs[np.searchsorted([n.number for n in self.nodes], numbers, side="right") - 1]

    def abandon_alignment(self) -> None:
        """Drops the pending link measurements and disables `align_all`, because the network is then incomplete."""
        self._pending.clear()
        self._alignable = False

    def truncate(self, n_frames: int) -> None:
        """Adds the links in progress, and removes keyframes, nodes and links of frames after the first `n_frames`.

        Keyframes of later frames exist if an interrupt stopped the processing of a frame. Raises OSError if images
        could not be read or written; the network is then incomplete and `align_all` returns None.
        """
        self._collect_links()
        self.keyframes = [k for k in self.keyframes if k.row < n_frames]
        self.nodes = [k for k in self.nodes if k.row < n_frames]
        self.links = self.links.select(self.links.j < len(self.keyframes))

    def yaw_rad(self, *latest: YawEffect) -> tuple[float, float]:
        """Returns yaw and sigma [rad] of the right camera by calibration, links, and `latest` not yet among them."""
        pending = [attempt.yaw for _, chain, _ in self._pending for attempt in chain if attempt.yaw is not None]
        others = np.reshape([yaw[:2] for yaw in (*pending, *latest)], (-1, 2))
        yaws, n_nodes = np.concatenate([self.history.yaws.array, others]), len(self.nodes) - 1 + len(latest)
        return fused(self.rig.yaw_sigma_rad, self.disparity_offset(yaws, n_nodes, _VIEWED_NODES))

    def disparity_offset(self, offsets: Array, n_nodes: int, n_viewed: int | None = None) -> DisparityOffset | None:
        """Returns the mean of the offsets (n, 2) of links, with the views of the latest `n_viewed` nodes or of all."""
        if not len(offsets):
            return None
        return calibration_errors.disparity_offset(offsets, n_nodes, self._mean_views(n_viewed), self.rig.focal_px)

    def distortion(self) -> DistortionError | None:
        """Returns the mean error of k1 by all links; None without one."""
        found, n_nodes = self.history.distortions.array, len(self.nodes) - 1
        if not len(found) or n_nodes < 1:
            return None
        return DistortionError(*calibration_errors.weighted_mean(found, n_nodes, self._mean_views()))

    def _mean_views(self, n_latest: int | None = None) -> float:
        n = len(self.nodes)
        first = 0 if n_latest is None else max(n - n_latest, 0)
        depth_m = np.array([node.depth_m for node in self.nodes[first:]])
        return calibration_errors.mean_views(self._node_poses[first:n], depth_m, self.rig)

    def offset_by_motions(self) -> DisparityOffset | None:
        """Returns the offset of all disparities by the links; None where they are corrected for the yaw instead."""
        if self.rig.yaw_sigma_rad:
            return None
        return self.disparity_offset(self.history.disparity_offsets.array, len(self.nodes) - 1)

    def _row_pattern(self) -> float:
        """Returns the RMS of the systematic row difference so far [focal lengths]; 0 if it is not noticeable."""
        epipolar = self.vision.epipolar_error()
        if epipolar is None:
            return 0.0
        pattern = row_pattern(epipolar, self.history.calibration, self.offset_by_motions(), self.rig)
        return pattern if pattern * self.rig.focal_px > NOTICEABLE_PX else 0.0

    def _align(self, nodes: list[Keyframe], track: int, marginals: list[int] | None) -> AlignmentResult:
        """Aligns the given nodes, which are the latest ones, and moves all keyframes from the first of them on."""
        # older nodes that are linked to them are held fixed, and are the first ones of the result; rejected links are
        # removed; marginal covariances are those of the nodes `marginals`, None: all. Raises SurveyAborted.
        first = nodes[0].number
        links = self.links.select(self.links.j >= first)
        fixed = set(links.i[links.i < first].tolist())
        everyone = [k for k in self.nodes if k.number in fixed] + nodes
        anchors = dict.fromkeys(fixed, _FIXED_COV) if first else {0: self.reference_cov}
        start_s = time.perf_counter()
        yaw = self.disparity_offset(self.history.yaws.array, len(self.nodes) - 1) if self.rig.yaw_sigma_rad else None
        measured = MeasuredErrors(yaw, self._row_pattern())
        try:
            aligned = align(everyone, links, anchors, self.rig, self.noise, marginals, measured)
        except np.linalg.LinAlgError as error:
            self._alignable = False
            raise SurveyAborted(f"global alignment failed: {error}") from None
        ms = (time.perf_counter() - start_s) * 1e3
        sizes = len(everyone), len(links), len(aligned.dropped)
        self.history.alignments.append(Alignment(track, ms, *sizes, aligned.link_chi2, aligned.converged))
        self.history.dropped += aligned.dropped
        self.history.calibration = aligned.calibration
        if aligned.dropped:
            dropped = {link[:2] for link in aligned.dropped}
            ends = zip(self.links.i.tolist(), self.links.j.tolist(), strict=True)
            self.links = self.links.select(np.array([pair not in dropped for pair in ends]))
        self._move({k.number: pose for k, pose in zip(nodes, aligned.poses[-len(nodes) :], strict=True)})
        return aligned

    def _move(self, poses: dict[int, Array]) -> None:
        """Sets the poses of nodes, by number; later keyframes that are not nodes follow the preceding node."""
        moving = self.keyframes[min(poses) :]
        old = np.array([keyframe.world_from_camera for keyframe in moving])
        numbers = {node.number for node in self.nodes}
        node_row = np.maximum.accumulate([k if keyframe.number in numbers else 0 for k, keyframe in enumerate(moving)])
        new = np.array([poses.get(keyframe.number, pose) for keyframe, pose in zip(moving, old, strict=True)])
        shift = new[node_row] @ np.linalg.inv(old[node_row])
        # without orthogonalisation, rounding errors triple with every alignment
        for keyframe, pose in zip(moving, geometry.nearest_rigid(shift @ old), strict=True):
            keyframe.world_from_camera = pose
        for k, node in enumerate(self.nodes):
            self._node_poses[k] = node.world_from_camera
