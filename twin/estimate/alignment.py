"""Global alignment (P15, P16): the poses of all nodes that agree best with the motions measured between them.

Eliminating the multipliers of the mixed-adjustment model, eq. (7), leaves a least-squares problem whose blocks are the
links: a graph of between-factors. gtsam solves it (Levenberg-Marquardt with Huber weights) and gives the marginals.
Links that contradict the rest are dropped and told.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np

from twin import geometry
from twin.estimate import pose_filter
from twin.estimate.key_points import KeyPoint
from twin.geometry import Array
from twin.records import Link, SensorNoise, StereoRig

_OUTLIER_CHI2 = 40.0  # six degrees of freedom: one in 2 million
_ROUNDS = 3
_FREE_M = 1e3  # standard deviation that leaves a coordinate free
_HUBER = 3.0


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
) -> Aligned:
    """Aligns a window of nodes.

    Args:
        nodes: of the window, with their poses so far as start values.
        links: motions between nodes of the window.
        anchors: number of each held node: its covariance (6, 6) [rotation, translation].
        rig, noise: calibration as believed.
        marginals_of: numbers of the nodes whose covariance is wanted; all if None, zeros for the others.
    """
    kept, dropped = list(links), []
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for _ in range(_ROUNDS):
        graph, start = _graph(nodes, kept, anchors, rig, noise)
        values = gtsam.LevenbergMarquardtOptimizer(graph, start, _parameters()).optimize()
        wrong = [link for link in kept if _chi2(link, values) > _OUTLIER_CHI2 and not _is_chain(link)]
        if not wrong:
            break
        dropped += wrong
        kept = [link for link in kept if not any(link is w for w in wrong)]
    return Aligned(
        np.stack([values.atPose3(k.number).matrix() for k in nodes]),
        _marginals(graph, values, nodes, marginals_of),
        dropped,
    )


def _parameters() -> gtsam.LevenbergMarquardtParams:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-9)
    parameters.setAbsoluteErrorTol(1e-9)
    return parameters


def _is_chain(link: Link) -> bool:
    return link.j - link.i == 1


def _graph(nodes, links, anchors, rig, noise) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    camera_from_body = geometry.inverse(rig.body_from_camera)
    for node in nodes:
        pose = gtsam.Pose3(node.world_from_camera)
        start.insert(node.number, pose)
        if node.number in anchors:
            graph.add(gtsam.PriorFactorPose3(node.number, pose, _gaussian(anchors[node.number])))
        _add_aiding(graph, node, camera_from_body, noise)
    for link in links:
        robust = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(_HUBER), _gaussian(link.cov))
        graph.add(gtsam.BetweenFactorPose3(link.i, link.j, gtsam.Pose3(link.i_from_j), robust))
    return graph, start


def _add_aiding(graph: gtsam.NonlinearFactorGraph, node: KeyPoint, camera_from_body: Array, noise: SensorNoise) -> None:
    if node.readings.pressure_z_m is not None:
        position = node.world_from_camera[:3, 3].copy()
        position[2] = node.readings.pressure_z_m
        sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.array([_FREE_M, _FREE_M, noise.pressure_m]))
        graph.add(gtsam.GPSFactor(node.number, position, sigmas))
    if node.readings.ahrs_rpy_rad is not None:
        rotation, cov = pose_filter.attitude(node.readings.ahrs_rpy_rad, camera_from_body, noise)
        graph.add(gtsam.PoseRotationPrior3D(node.number, gtsam.Rot3(rotation), _gaussian(cov)))


def _gaussian(cov: Array) -> gtsam.noiseModel.Gaussian:
    return gtsam.noiseModel.Gaussian.Covariance((cov + cov.T) / 2)


def _chi2(link: Link, values: gtsam.Values) -> float:
    between = values.atPose3(link.i).between(values.atPose3(link.j))
    error = gtsam.Pose3.Logmap(gtsam.Pose3(link.i_from_j).between(between))
    return float(error @ np.linalg.solve(link.cov, error))


def _marginals(graph, values, nodes: Sequence[KeyPoint], wanted: Sequence[int] | None) -> Array:
    marginals = gtsam.Marginals(graph, values)
    covs = np.zeros((len(nodes), 6, 6))
    for k, node in enumerate(nodes):
        if wanted is None or node.number in wanted:
            covs[k] = marginals.marginalCovariance(node.number)
    return covs
