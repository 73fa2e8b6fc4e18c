"""The method in the paper's order: F2F at every frame; stereo, F2M and network at keyframes; GA at a track's end."""

from __future__ import annotations

import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.growing_array import Rows
from twin.core.links import Link, Links
from twin.core.records import Alignment, Estimate, Frame, SensorNoise, StereoRig, SurveyResult, Trajectory
from twin.errors import SurveyAborted
from twin.estimate import network
from twin.estimate.alignment import Aligned, align
from twin.estimate.navigation.dead_reckoning import Instruments, Reckoning, reckon, said
from twin.estimate.navigation.dvl import VelocityLog
from twin.estimate.navigation.pose_filter import PoseFilter, carried, clipped
from twin.estimate.stereo_vision import Vision
from twin.estimate.trajectory import interpolate_between_keyframes
from twin.estimate.vision.keyframes import Keyframe
from twin.scenario.model import EstimateConfig

_REFERENCE_COV = np.eye(6) * 1e-12  # the first pose defines the frame
_START_NODES = 4  # the reference position stays in the window: loops come back to it
_MOST_BEHIND = 8  # nodes whose links are still being measured
_HELD_COV = np.eye(6) * 1e-10  # nodes older than the window are held
_F2M_SIGMA = np.array([5e-4] * 3 + [1e-3] * 3)  # what the mosaic's own sampling leaves [rad, m]


class Navigator:
    """Positions the vehicle from frames alone.

    Args:
        vision: what answers for the stereo camera.
        rig, noise: calibration as believed.
        settings: the scenario's [estimate].
        start: (4, 4) world_from_camera of the reference position, where the survey begins by plan.
        watch: context manager per stage name.
        beside: links are measured by a thread beside the flight: worth it where images take long.
    """

    def __init__(
        self,
        vision: Vision,
        rig: StereoRig,
        noise: SensorNoise,
        settings: EstimateConfig,
        start: Array,
        watch: Callable[[str], AbstractContextManager[None]],
        beside: bool = True,
    ):
        self.vision, self.rig, self.noise, self.settings, self.watch = vision, rig, noise, settings, watch
        self.velocity_log = VelocityLog(rig, noise)
        self.filter = PoseFilter(start.copy(), rig, noise)
        self.f2f_pose = start.copy()
        self.since_node = (np.eye(4), np.zeros((6, 6)))
        self.cov_at_node = np.zeros((6, 6))
        self.alignable = True
        self.keys: list[Keyframe] = []
        self.nodes: list[Keyframe] = []
        self.node_poses = np.empty((64, 4, 4))  # theirs, and room for more
        self.links = Links()
        self.measuring: deque[Callable[[], list[Link]]] = deque()
        self.behind = ThreadPoolExecutor(1) if beside else None
        self.times_s, self.f2f_poses, self.online_poses = Rows(), Rows(4, 4), Rows(4, 4)
        self.dropped: list[Link] = []
        self.alignments: list[Alignment] = []
        self.before_ga: list[Array] = []
        self.after_ga: list[Array] = []

    def update(self, frame: Frame, track: int) -> Estimate:
        """Takes one frame; a frame with a right image is a keyframe of the track (from 1)."""
        seen, status = self.vision.track_frame(frame)
        reckoned, moved = reckon(self.reckoning, self.instruments, seen.a_from_b, seen.cov, *said(frame.readings))
        self.go_on(reckoned)
        if frame.right is not None:
            status = self._visit_keyframe(frame, track, status)
        online, f2f = self.filter.world_from_camera.copy(), self.f2f_pose
        self.record(frame.time_s, f2f, online)
        velocity = geometry.log(moved) * self.rig.frame_rate_hz
        sigma_m = float(np.sqrt(np.trace(self.filter.cov[3:, 3:])))
        return Estimate(frame.time_s, online, f2f, velocity, sigma_m, status)

    @property
    def reckoning(self) -> Reckoning:
        """Where the frames have led so far."""
        believed = self.filter.world_from_camera, np.ascontiguousarray(self.filter.cov)
        return Reckoning(self.f2f_pose, *believed, *self.since_node)

    @property
    def instruments(self) -> Instruments:
        """What speaks at every frame."""
        return Instruments(self.filter.level, self.velocity_log.beams, self.velocity_log.way)

    def go_on(self, reckoned: Reckoning) -> None:
        """Takes over where frames have led."""
        self.f2f_pose, self.since_node = reckoned.f2f, (reckoned.walked, reckoned.walked_cov)
        self.filter.world_from_camera, self.filter.cov = reckoned.online, reckoned.cov

    def record(self, times_s: float | Array, f2f: Array, online: Array) -> None:
        """Notes one frame or more: times () or (n,) [s], poses (4, 4) or (n, 4, 4)."""
        self.times_s.add(times_s)
        self.f2f_poses.add(f2f)
        self.online_poses.add(online)

    def align_track(self, track: int) -> None:
        """Global alignment over the window that ends with this track; the vehicle keeps station meanwhile."""
        if not self.settings.use_ga or len(self.nodes) < 2:
            return
        self.before_ga.append(self._keyframe_poses()[:, :3, 3].copy())
        self._take_links()
        first = track - self.settings.window_tracks
        with self.watch("ga"):
            aligned = self._align([k for k in self.nodes if k.track >= first], track, marginals=[self.nodes[-1].number])
        self._rebase(aligned)
        self.vision.rebuild_mosaic([k for k in self.keys if k.track >= track])  # the mosaic forgets older ones
        left = bisect_left(self.nodes, first, key=lambda k: k.track)
        if left > _START_NODES:
            self.vision.discard(range(self.nodes[_START_NODES - 1].number + 1, self.nodes[left].number))
        self.after_ga.append(self._keyframe_poses()[:, :3, 3].copy())

    def finish(self) -> SurveyResult:
        """The truly global alignment over all tracks, and the trajectories.

        Raises:
            SurveyAborted, OSError: the alignment or the measuring of links failed; called again, it goes without.
        """
        self._forget_unfinished()
        cov = np.tile(self.filter.cov, (len(self.keys), 1, 1))
        if self.settings.use_ga and self.alignable and len(self.nodes) >= 2:
            with self.watch("ga"):
                aligned = self._align(self.nodes, self.nodes[-1].track, marginals=None)
            owner = np.searchsorted([n.number for n in self.nodes], [k.number for k in self.keys], side="right") - 1
            cov = aligned.covs[owner]
        times, f2f, online = (rows.array for rows in (self.times_s, self.f2f_poses, self.online_poses))
        rows = np.array([k.row for k in self.keys], dtype=np.int64)
        final = interpolate_between_keyframes(f2f, rows, self._keyframe_poses()) if self.settings.use_ga else online
        return SurveyResult(
            f2f=Trajectory(times, f2f),
            online=Trajectory(times, online),
            final=Trajectory(times, final),
            keyframe_rows=rows,
            track_of_keyframe=np.array([k.track for k in self.keys], dtype=np.int64),
            node_cov=cov,
            links=self.links,
            alignments=self.alignments,
            before_ga=self.before_ga,
            after_ga=self.after_ga,
            stereo_observations=[look for look in self.vision.stereo_observations if look.row < len(times)],
        )

    def _forget_unfinished(self) -> None:
        """Drops a keyframe whose frame was interrupted before it was recorded."""
        self._take_links()
        n_frames = len(self.times_s)
        self.keys = [k for k in self.keys if k.row < n_frames]
        self.nodes = [k for k in self.nodes if k.row < n_frames]
        self.links = self.links.kept(self.links.j < len(self.keys))

    def _visit_keyframe(self, frame: Frame, track: int, status: str) -> str:
        """Stereo, F2M, mosaic and network at a keyframe; fresh points for F2F."""
        points = self.vision.observe_stereo(frame, len(self.times_s))
        if points is None:
            self.filter.fix(frame.readings)
            return "too few points in stereo"
        key = Keyframe(len(self.keys), len(self.times_s), track, self.filter.world_from_camera, points, frame.readings)
        self.keys.append(key)
        is_node = key.number % self.settings.node_stride == 0
        chain = self._follow_chain(key) if is_node else None
        self.filter.fix(frame.readings)  # after the chain, so that it corrects what the chain leaves
        with self.watch("f2m"):
            self._register_with_mosaic(key, chain)
            key.world_from_camera = self.filter.world_from_camera
            self.vision.add_to_mosaic(key.number, key.world_from_camera)
        if is_node:
            self._connect(key, chain)
        self.vision.restart_tracking()
        key.points = None  # links start from the new node's points: memory need not hold the old ones
        return status

    def _register_with_mosaic(self, key: Keyframe, chain: Link | None) -> None:
        """Corrects the position by the mosaic (F2M), as far as the motion since that was laid is less sure."""
        pose, step_cov = self.filter.world_from_camera, self.since_node[1] if chain is None else chain.cov
        to_world, from_world = geometry.adjoint(pose), geometry.adjoint(geometry.inverse(pose))
        if self.nodes:
            key.walked_cov = self.nodes[-1].walked_cov + to_world @ step_cov @ to_world.T
        found = self.vision.register_with_mosaic(pose) if self.settings.use_f2m else None
        if found is not None:
            walked_cov = from_world @ (key.walked_cov - self.keys[found.laid_by].walked_cov) @ from_world.T
            since = clipped(walked_cov, step_cov, least=1.0) if self.nodes else walked_cov
            cov = found.correction.cov + np.diag(_F2M_SIGMA**2)
            learnt = self.filter.correct_pose(pose @ found.correction.a_from_b, cov, since)
            if learnt is not None:
                key.walked_cov = key.walked_cov - to_world @ learnt @ to_world.T

    def _follow_chain(self, node: Keyframe) -> Link | None:
        """Measures the motion since the last node, and lets it take the place of the F2F motion in the online position.

        Two stereo pairs tell the motion better than the frames between them do (the paper's better start values
        for GA, section IV-5); what the navigation sensors corrected meanwhile is kept.
        """
        if not self.nodes:
            return None
        last, (walked, _) = self.nodes[-1], self.since_node
        pose = last.world_from_camera[None]
        share = float(network.overlaps(node, pose, self.rig, self.settings.patch_px)[0])
        links = self._measure(node, [(last, share)])
        if not links:
            return None
        link = links[0]
        aided = geometry.inverse(last.world_from_camera @ walked) @ self.filter.world_from_camera
        cov = carried(self.cov_at_node, link.i_from_j) + link.cov
        self.filter.reset(last.world_from_camera @ link.i_from_j @ aided, cov)
        node.world_from_camera = self.filter.world_from_camera
        return link

    def _connect(self, node: Keyframe, chain: Link | None) -> None:
        """Links a new node to earlier ones by measured motions; to the last one by F2F where that failed."""
        s = self.settings
        with self.watch("network"):
            first = bisect_left(self.nodes, node.track - s.window_tracks, key=lambda k: k.track)
            oldest, n = min(_START_NODES, first), len(self.nodes)
            window = self.nodes[:oldest] + self.nodes[first:]
            poses = np.concatenate([self.node_poses[:oldest], self.node_poses[first:n]])
            chosen = network.choose_links(node, window, poses, self.rig, s.min_overlap, s.max_links, s.patch_px)
        others = [(k, share) for k, share in chosen if k is not self.nodes[-1]]
        bridge = self._bridge(node) if self.nodes and chain is None else None
        measure = partial(self._links_of, replace(node), others, chain, bridge)  # its points are given up below
        self.measuring.append(self.behind.submit(measure).result if self.behind else measure)
        self._take_links(all_but=_MOST_BEHIND)
        walked = self.velocity_log.at_node(node.number)
        node.walked = walked if chain else None  # without a chain, the F2F motion has it in
        self.nodes.append(node)
        if len(self.nodes) > len(self.node_poses):
            self.node_poses = np.concatenate([self.node_poses, np.empty_like(self.node_poses)])
        self.node_poses[len(self.nodes) - 1] = node.world_from_camera
        self.cov_at_node = self.filter.cov
        self.since_node = (np.eye(4), np.zeros((6, 6)))

    def _bridge(self, node: Keyframe) -> Link:
        """The F2F motion since the last node, where the two stereo pairs do not tell it."""
        relative, cov = self.since_node
        return Link(self.nodes[-1].number, node.number, relative, cov + np.eye(6) * 1e-10, 0.0, 0)

    def _links_of(
        self, node: Keyframe, others: list[tuple[Keyframe, float]], chain: Link | None, bridge: Link | None
    ) -> list[Link]:
        """All links of one new node."""
        measured = self._measure(node, others)
        return network.share_noise([*measured, chain] if chain else measured) + ([bridge] if bridge else [])

    def _take_links(self, all_but: int = 0) -> None:
        """Takes over the links that were measured while the survey went on; only the alignment needs them.

        Raises:
            OSError: images could not be read or written; what is left then is no network to align.
        """
        while len(self.measuring) > all_but:
            try:
                self.links.add(self.measuring[0]())
            except OSError:
                self.measuring.clear()
                self.alignable = False
                raise
            self.measuring.popleft()

    def _measure(self, node: Keyframe, others: list[tuple[Keyframe, float]]) -> list[Link]:
        """The links from earlier nodes (with the share of the node that they see) that could be measured."""
        motions = self.vision.measure_motions(node, [other for other, _ in others])
        links = [
            network.to_link(node, other, share, motion)
            for (other, share), motion in zip(others, motions, strict=True)
            if motion is not None
        ]
        return links

    def _align(self, nodes: list[Keyframe], track: int, marginals: list[int] | None) -> Aligned:
        """Aligns the last nodes (with those older ones that they are linked to, held); all keyframes move along."""
        first = nodes[0].number
        links = self.links.kept(self.links.j >= first)
        held = set(links.i[links.i < first].tolist())
        everyone = [k for k in self.nodes if k.number in held] + nodes
        anchors = dict.fromkeys(held, _HELD_COV) | {0: _REFERENCE_COV}
        begun = time.perf_counter()
        try:
            aligned = align(everyone, links, anchors, self.rig, self.noise, marginals)
        except np.linalg.LinAlgError as error:
            self.alignable = False
            raise SurveyAborted(f"global alignment failed: {error}") from None
        ms = (time.perf_counter() - begun) * 1e3
        self.alignments.append(Alignment(track, ms, len(everyone), len(links), len(aligned.dropped)))
        self.dropped += aligned.dropped
        if aligned.dropped:
            dropped = {link[:2] for link in aligned.dropped}
            ends = zip(self.links.i.tolist(), self.links.j.tolist(), strict=True)
            self.links = self.links.kept(np.array([pair not in dropped for pair in ends]))
        poses = {k.number: pose for k, pose in zip(everyone, aligned.poses, strict=True)}
        self._move_keyframes({number: pose for number, pose in poses.items() if number >= first})
        return aligned

    def _move_keyframes(self, poses: dict[int, Array]) -> None:
        """Gives nodes their new poses; keyframes between them move along with the node before, if that moved."""
        moving = self.keys[min(poses) :]
        old = np.array([key.world_from_camera for key in moving])
        numbers = {node.number for node in self.nodes}
        owner = np.maximum.accumulate([k if key.number in numbers else 0 for k, key in enumerate(moving)])
        new = np.array([poses.get(key.number, pose) for key, pose in zip(moving, old, strict=True)])
        shift = new[owner] @ np.linalg.inv(old[owner])
        for key, pose in zip(moving, geometry.rigid(shift @ old), strict=True):  # else errors treble
            key.world_from_camera = pose
        for k, node in enumerate(self.nodes):
            self.node_poses[k] = node.world_from_camera

    def _rebase(self, aligned: Aligned) -> None:
        """Moves the online position along with the last keyframe."""
        last = self.keys[-1]
        last_from_now = geometry.inverse(self.online_poses.array[last.row]) @ self.filter.world_from_camera
        self.filter.reset(last.world_from_camera @ last_from_now, carried(aligned.covs[-1], last_from_now))
        self.cov_at_node = aligned.covs[-1]

    def _keyframe_poses(self) -> Array:
        return np.array([k.world_from_camera for k in self.keys]).reshape(-1, 4, 4)
