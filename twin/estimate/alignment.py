"""Global alignment (P15, P16): the poses of all nodes that agree best with the motions measured between them.

Eliminating the multipliers of the mixed-adjustment model, eq. (7), leaves a least-squares problem whose blocks are the
links: a graph of between-factors. `pose_graph` solves it (with Huber weights) and gives the marginals.
Links that contradict the rest are dropped and told.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from twin.estimate import aiding, pose_graph
from twin.estimate.key_points import KeyPoint
from twin.geometry import Array
from twin.records import Link, SensorNoise, StereoRig

Mask = NDArray[np.bool_]

_OUTLIER_CHI2 = 40.0  # six degrees of freedom: one in 2 million
_OF_THE_WORST = 0.01
_ROUNDS = 10
_MOST_ITERATIONS = 100
_FEW_ITERATIONS = 10  # of a round: with gross links in, Huber's weights settle slowly
_HUBER = 3.0


class Factors(NamedTuple):
    """Those made before, by the numbers of their nodes: windows share most of theirs."""

    of_links: dict[tuple[int, int], gtsam.BetweenFactorPose3]
    of_readings: dict[int, gtsam.NonlinearFactorGraph]


class Aligned(NamedTuple):
    """Poses (n, 4, 4) and marginal covariances (n, 6, 6) of the nodes asked for, and the links that were dropped."""

    poses: Array
    covs: Array
    dropped: list[Link]


def align(
    nodes: Sequence[KeyPoint],
    links: Sequence[Link],
    anchors: dict[int, Array],
    rig: StereoRig,
    noise: SensorNoise,
    marginals_of: Sequence[int] | None = None,
    factors: Factors | None = None,
) -> Aligned:
    """Aligns a window of nodes.

    Args:
        nodes: of the window, with their poses so far as start values.
        links: motions between nodes of the window.
        anchors: number of each held node: its covariance (6, 6) [rotation, translation].
        rig, noise: calibration as believed.
        marginals_of: numbers of the nodes whose covariance is wanted; all if None, zeros for the others.
        factors: of links and nodes aligned before; those of new ones are added.
    """
    factors = Factors({}, {}) if factors is None else factors
    graph, values = _without_links(nodes, anchors, rig, noise, factors.of_readings)
    fit = _Fit(graph, list(links), _factors_of(links, factors.of_links))
    dropped: list[Link] = []
    found = fit.optimise(values, _FEW_ITERATIONS, marginals_of)
    for _ in range(_ROUNDS):
        wrong = fit.contradictions(found.values)
        if not wrong.any():
            break
        dropped += [link for link, out in zip(fit.links, wrong, strict=True) if out]
        fit = fit.without(wrong)
        found = fit.optimise(found.values, _FEW_ITERATIONS, marginals_of)
    if not found.reached:
        found = fit.optimise(found.values, _MOST_ITERATIONS, marginals_of)
    poses = np.stack([found.values.atPose3(k.number).matrix() for k in nodes])
    return Aligned(poses, _marginals(found, nodes, marginals_of), dropped)


class _Fit(NamedTuple):
    """What a window knows: the factors of its nodes alone, and its links with a factor each."""

    of_nodes: gtsam.NonlinearFactorGraph
    links: list[Link]
    of_links: list[gtsam.BetweenFactorPose3]

    def graph(self) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(self.of_nodes)
        for factor in self.of_links:
            graph.add(factor)
        return graph

    def optimise(self, start: gtsam.Values, iterations: int, last: Sequence[int] | None) -> pose_graph.Optimum:
        return pose_graph.optimise(self.graph(), start, iterations, last)

    def contradictions(self, values: gtsam.Values) -> Mask:
        """(n,) links that contradict the rest, but for those small beside the worst, which may be its doing.

        The path's own chain always stands.
        """
        chain = np.array([link.j - link.i == 1 for link in self.links], dtype=bool)
        chi2 = np.where(chain, 0.0, pose_graph.chi2(self.of_links, values, _HUBER))
        return chi2 > max(_OUTLIER_CHI2, _OF_THE_WORST * float(chi2.max(initial=0.0)))

    def without(self, wrong: Mask) -> _Fit:
        rows = np.flatnonzero(~wrong)
        return _Fit(self.of_nodes, [self.links[k] for k in rows], [self.of_links[k] for k in rows])


def _factors_of(
    links: Sequence[Link], known: dict[tuple[int, int], gtsam.BetweenFactorPose3]
) -> list[gtsam.BetweenFactorPose3]:
    new = [link for link in links if link[:2] not in known]
    known.update(zip((link[:2] for link in new), pose_graph.between_factors(new, _HUBER), strict=True))
    return [known[link[:2]] for link in links]


def _without_links(nodes, anchors, rig, noise, known) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for node in nodes:
        pose = gtsam.Pose3(node.world_from_camera)
        start.insert(node.number, pose)
        if node.number in anchors:
            graph.add(gtsam.PriorFactorPose3(node.number, pose, pose_graph.gaussian(anchors[node.number])))
    aiding.add_readings(graph, start, nodes, rig, noise, known)
    return graph, start


def _marginals(found: pose_graph.Optimum, nodes: Sequence[KeyPoint], wanted: Sequence[int] | None) -> Array:
    covs = np.zeros((len(nodes), 6, 6))
    rows = [k for k, node in enumerate(nodes) if wanted is None or node.number in wanted]
    covs[rows] = found.marginals([nodes[k].number for k in rows])
    return covs
