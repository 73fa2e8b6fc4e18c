"""The keyframe network: keyframes, links between those that are nodes, and the global alignment of the nodes."""

from __future__ import annotations

import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.links import Link, Links
from twin.core.quality import DisparityOffset
from twin.core.records import Alignment, Displacement, SensorNoise, StereoRig
from twin.core.settings import EstimatorSettings
from twin.core.timing import StageTimer
from twin.errors import SurveyAborted
from twin.estimate import link_selection
from twin.estimate.alignment import AlignmentResult, align
from twin.estimate.vision.keyframes import Keyframe
from twin.estimate.vision_interface import Vision

_REFERENCE_COV = np.eye(6) * 1e-12  # the first pose defines the world frame
_FIXED_COV = np.eye(6) * 1e-10  # nodes older than the window are practically fixed
_START_NODES = 4  # the first nodes are candidates for every link, because loops return to the reference position
_MOST_PENDING = 8  # largest number of nodes with link measurements in progress


class LinkQueue:
    """Queue of link measurements, one entry per node, in chronological order.

    Args:
        background: whether links are measured in a separate thread, which is faster with images; otherwise `collect`
            measures them.
    """

    def __init__(self, background: bool):
        self._executor = ThreadPoolExecutor(1) if background else None
        self._pending: deque[Callable[[], list[Link]]] = deque()

    def submit(self, measure: Callable[[], list[Link]]) -> None:
        """Adds the measurement of the links of one node; `measure` is a function that measures and returns them."""
        self._pending.append(self._executor.submit(measure).result if self._executor else measure)

    def collect(self, all_but: int = 0) -> Iterator[list[Link]]:
        """Yields the links of one node at a time, oldest first, until at most `all_but` nodes are pending.

        Raises:
            OSError: images could not be read or written.
            Exception: a measurement failed for another reason. After any error, all pending measurements are dropped.
        """
        while len(self._pending) > all_but:
            try:
                links = self._pending[0]()
            except Exception:
                self._pending.clear()
                raise
            self._pending.popleft()
            yield links

    def drop(self) -> None:
        """Drops the pending measurements; those submitted to the thread may still run, but their links are not used."""
        self._pending.clear()

    def close(self) -> None:
        """Drops the pending measurements and ends the thread, after the measurement in progress."""
        self.drop()
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)


@dataclass
class AlignmentHistory:
    """Record of the link measurements and the global alignments so far.

    Attributes:
        alignments: duration and size of each alignment.
        dropped: links rejected as outliers by any alignment.
        before_ga: for each alignment at the end of a track, positions (n, 3) of the keyframes just before it [m].
        after_ga: for each alignment at the end of a track, positions (n, 3) of the keyframes just after it [m].
        link_residuals: for each attempted link measurement, the residual of the points divided by the expected one;
            NaN where the measurement failed.
        disparity_offsets: for each measured link, the offset of all disparities, estimated from the points of the link;
            links that do not determine an offset are left out.
        frame_sigmas_m: the standard deviation (3-D) of the position of each keyframe relative to the previous keyframe,
            from frame-to-frame motion alone [m]; keyframes at which it is not known are left out.
        nodes_bridged: number of nodes linked to the previous node by the F2F motion (predicted where tracking failed),
            because this link could not be measured.
        independent_errors: see `AlignmentResult`, of the final alignment; None before it.
    """

    alignments: list[Alignment] = field(default_factory=list[Alignment])
    dropped: list[Link] = field(default_factory=list[Link])
    before_ga: list[Array] = field(default_factory=list[Array])
    after_ga: list[Array] = field(default_factory=list[Array])
    link_residuals: list[float] = field(default_factory=list[float])
    disparity_offsets: list[DisparityOffset] = field(default_factory=list[DisparityOffset])
    frame_sigmas_m: list[float] = field(default_factory=list[float])
    nodes_bridged: int = 0
    independent_errors: float | None = None


class KeyframeNetwork:
    """Keyframes of a survey, those of them that are nodes, and the measured motions that link the nodes.

    Args:
        vision: source of the visual measurements, including the links.
        stopwatch: returns the context manager that times the stage of a given name.

    Attributes:
        reference_cov: (6, 6) prior covariance of the first node [rotation, translation] (rad, m); by default it is
            negligible, because the first pose defines the world frame.
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
        self._queue = LinkQueue(vision.runs_in_background)
        self._alignable = True
        self.reference_cov = _REFERENCE_COV

    def close(self) -> None:
        """Drops the pending link measurements and ends the background thread."""
        self._queue.close()

    @property
    def poses(self) -> Array:
        """Returns the world_from_camera (n, 4, 4) of all keyframes."""
        return np.array([k.world_from_camera for k in self.keyframes]).reshape(-1, 4, 4)

    def add(self, keyframe: Keyframe) -> None:
        """Adds a keyframe, and releases the matched points of the previous keyframe."""
        if self.keyframes:
            self.keyframes[-1].points = None  # links start from the points of the newer node
        self.keyframes.append(keyframe)

    def is_node(self, keyframe: Keyframe) -> bool:
        """Returns whether a keyframe becomes a node."""
        return keyframe.number % self.settings.node_stride == 0

    def overlap_with_last(self, world_from_camera: Array) -> float:
        """Returns the predicted overlap, 0 to 1, of the last keyframe with the left image at a pose (4, 4).

        This is the fraction of the keyframe's matched points that project into that image (`link_selection.overlaps`).
        """
        last = self.keyframes[-1]
        poses = np.ascontiguousarray(world_from_camera[None])
        return float(link_selection.overlaps(last, poses, self.rig, self.settings.patch_px)[0])

    def link_to_last_node(self, node: Keyframe) -> Link | None:
        """Returns the measured link from the last node to a new one; None for the first node or a failed measurement.

        Raises:
            OSError: images could not be read or written.
        """
        if not self.nodes:
            return None
        last = self.nodes[-1]
        pose = last.world_from_camera[None]
        overlap = float(link_selection.overlaps(node, pose, self.rig, self.settings.patch_px)[0])
        links = self._measure(node, [(last, overlap)])
        return links[0] if links else None

    def connect(
        self, node: Keyframe, chain: Link | None, bridge: Link | None, displacement: Displacement | None
    ) -> None:
        """Adds a node and queues the measurement of its links to earlier nodes other than the last one.

        Args:
            chain: measured link from the last node; None if the measurement failed or this is the first node.
            bridge: link from the last node that consists of the F2F motion, fused with the DVL; it replaces a `chain`
                that could not be measured; otherwise None.
            displacement: displacement since the last node, measured by the DVL; None if it was not measured.

        Raises:
            OSError: images could not be read or written; the network is incomplete and `align_all` returns None.
        """
        s = self.settings
        with self.stopwatch("network"):
            first = bisect_left(self.nodes, node.track - s.window_tracks, key=lambda k: k.track)
            oldest, n = min(_START_NODES, first), len(self.nodes)
            window = self.nodes[:oldest] + self.nodes[first:]
            poses = np.concatenate([self._node_poses[:oldest], self._node_poses[first:n]])
            chosen = link_selection.choose_links(node, window, poses, self.rig, s.min_overlap, s.max_links, s.patch_px)
        others = [(k, overlap) for k, overlap in chosen if k is not self.nodes[-1]]
        # a copy, because the points of the node are released before its links are measured
        self._queue.submit(partial(self._links_of, replace(node), others, chain, bridge))
        self.history.nodes_bridged += bridge is not None
        self._collect_links(all_but=_MOST_PENDING)
        node.dvl_displacement = displacement if chain else None  # `bridge` already includes it
        self.nodes.append(node)
        if len(self.nodes) > len(self._node_poses):
            self._node_poses = np.concatenate([self._node_poses, np.empty_like(self._node_poses)])
        self._node_poses[len(self.nodes) - 1] = node.world_from_camera

    def align_window(self, track: int) -> Array | None:
        """Aligns the nodes of the window of tracks that ends with `track`, and rebuilds the mosaic from this track.

        Returns:
            (6, 6) marginal covariance of the pose of the last node [rotation, translation] (rad, m), in its camera
            axes; None if the global alignment is switched off, there are fewer than two nodes, or none of the nodes
            lies in the window.

        Raises:
            SurveyAborted: the alignment failed.
            OSError: images could not be read or written.
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
        """Aligns all nodes by the links in the network. Call `truncate` first, which adds the links in progress.

        Returns:
            (n_keyframes, 6, 6) for each keyframe, the marginal covariance of the pose of the latest node up to this
            keyframe. None if the global alignment is switched off, if an earlier alignment failed or a queued link
            measurement raised an error, if `abandon_alignment` was called, or if there are fewer than two nodes.

        Raises:
            SurveyAborted: the alignment failed; a second call returns None.
        """
        if not (self.settings.use_ga and self._alignable and len(self.nodes) >= 2):
            return None
        with self.stopwatch("ga"):
            aligned = self._align(self.nodes, self.nodes[-1].track, marginals=None)
        self.history.independent_errors = aligned.independent_errors
        numbers = [k.number for k in self.keyframes]
        return aligned.covs[np.searchsorted([n.number for n in self.nodes], numbers, side="right") - 1]

    def abandon_alignment(self) -> None:
        """Drops the pending link measurements and disables `align_all`, because the network is then incomplete."""
        self._queue.drop()
        self._alignable = False

    def truncate(self, n_frames: int) -> None:
        """Removes the keyframes, nodes and links of all frames after the first `n_frames`.

        First waits for the link measurements in progress and adds their links. Keyframes of later frames exist if an
        interrupt stopped the processing of a frame.

        Args:
            n_frames: number of frames to keep.

        Raises:
            OSError: images could not be read or written; the network is incomplete and `align_all` returns None.
        """
        self._collect_links()
        self.keyframes = [k for k in self.keyframes if k.row < n_frames]
        self.nodes = [k for k in self.nodes if k.row < n_frames]
        self.links = self.links.select(self.links.j < len(self.keyframes))

    def _links_of(
        self, node: Keyframe, others: list[tuple[Keyframe, float]], chain: Link | None, bridge: Link | None
    ) -> list[Link]:
        """Returns all links of one new node; the covariances of the measured links are inflated for shared noise."""
        measured = self._measure(node, others)
        return link_selection.inflate_for_shared_noise([*measured, chain] if chain else measured) + (
            [bridge] if bridge else []
        )

    def _measure(self, node: Keyframe, others: list[tuple[Keyframe, float]]) -> list[Link]:
        """Returns the links from earlier nodes that could be measured, and adds the results to the history."""
        motions = self.vision.measure_motions(node, [other for other, _ in others])
        self.history.link_residuals += [np.nan if motion is None else motion.residual for motion in motions]
        offsets = [motion.disparity_offset for motion in motions if motion is not None]
        self.history.disparity_offsets += [offset for offset in offsets if offset is not None]
        return [
            link_selection.to_link(node, other, overlap, motion)
            for (other, overlap), motion in zip(others, motions, strict=True)
            if motion is not None
        ]

    def _collect_links(self, all_but: int = 0) -> None:
        """Adds the links of pending nodes to the network, oldest first, until at most `all_but` nodes are pending.

        Raises:
            OSError: images could not be read or written.
            Exception: a measurement failed for another reason. After any error, the network is incomplete and
                `align_all` returns None.
        """
        try:
            for links in self._queue.collect(all_but):
                self.links.add(links)
        except Exception:
            self._alignable = False
            raise

    def _align(self, nodes: list[Keyframe], track: int, marginals: list[int] | None) -> AlignmentResult:
        """Aligns the given nodes, which are the latest ones, and moves all keyframes from the first of them on.

        Older nodes that are linked to the given nodes are held fixed. Keyframes that are not nodes keep their pose
        relative to the preceding node. Links rejected as outliers are removed from the network.

        Args:
            marginals: numbers of the nodes whose marginal covariances are computed; None for all nodes.

        Returns:
            The result for the fixed nodes followed by the given ones.

        Raises:
            SurveyAborted: the alignment failed.
        """
        first = nodes[0].number
        links = self.links.select(self.links.j >= first)
        fixed = set(links.i[links.i < first].tolist())
        everyone = [k for k in self.nodes if k.number in fixed] + nodes
        anchors = dict.fromkeys(fixed, _FIXED_COV) | {0: self.reference_cov}
        start_s = time.perf_counter()
        try:
            aligned = align(everyone, links, anchors, self.rig, self.noise, marginals)
        except np.linalg.LinAlgError as error:
            self._alignable = False
            raise SurveyAborted(f"global alignment failed: {error}") from None
        ms = (time.perf_counter() - start_s) * 1e3
        n_nodes, n_dropped = len(everyone), len(aligned.dropped)
        self.history.alignments.append(
            Alignment(track, ms, n_nodes, len(links), n_dropped, aligned.link_chi2, aligned.converged)
        )
        self.history.dropped += aligned.dropped
        if aligned.dropped:
            dropped = {link[:2] for link in aligned.dropped}
            ends = zip(self.links.i.tolist(), self.links.j.tolist(), strict=True)
            self.links = self.links.select(np.array([pair not in dropped for pair in ends]))
        poses = {k.number: pose for k, pose in zip(everyone, aligned.poses, strict=True)}
        self._move({number: pose for number, pose in poses.items() if number >= first})
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
