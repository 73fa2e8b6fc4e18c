"""Global alignment (P15, P16): the poses of all nodes that agree best with the motions measured between them.

Eliminating the multipliers of the mixed-adjustment model, eq. (7), leaves a least-squares problem whose blocks are the
links. `pose_graph` solves it (with Huber weights) and gives the marginals. Links that contradict the rest are dropped
and told.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.links import Link, Links
from twin.core.records import SensorNoise, StereoRig
from twin.estimate.adjustment import pose_graph
from twin.estimate.navigation import aiding
from twin.estimate.vision.keyframes import Keyframe

Mask = NDArray[np.bool_]

_OUTLIER_CHI2 = 40.0  # six degrees of freedom: one in 2 million
_OF_THE_WORST = 0.01
_ROUNDS = 10
_MOST_ITERATIONS = 100
_FEW_ITERATIONS = 10  # of a round: with gross links in, Huber's weights settle slowly
_HUBER = 3.0


class Aligned(NamedTuple):
    """Poses (n, 4, 4) and marginal covariances (n, 6, 6) of the nodes asked for, and the links that were dropped."""

    poses: Array
    covs: Array
    dropped: list[Link]


def align(
    nodes: Sequence[Keyframe],
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
        marginals_of: numbers of the few nodes whose covariance is wanted, zeros for the others; all if None.

    Raises:
        LinAlgError: the links do not hold every node.
    """
    places = {node.number: k for k, node in enumerate(nodes)}
    fit = _Fit(Links.of(links), places, _graph(nodes, links, anchors, places, rig, noise))
    dropped: list[Link] = []
    found = fit.optimise(pose_graph.State(np.array([node.world_from_camera for node in nodes])), _FEW_ITERATIONS)
    for _ in range(_ROUNDS):
        wrong = fit.contradictions(found.chi2[0])
        if not wrong.any():
            break
        dropped += fit.links.kept(wrong)
        fit, state = fit.without(wrong), found.state
        del found  # its factor goes before the next one comes
        found = fit.optimise(state, _FEW_ITERATIONS)
    if not found.reached:
        state = found.state
        del found
        found = fit.optimise(state, _MOST_ITERATIONS)
    return Aligned(found.state.poses, _marginals(found, marginals_of, places), dropped)


class _Fit(NamedTuple):
    """What a window knows: its links, places of the nodes by number, and the graph whose first pairs the links are."""

    links: Links
    places: dict[int, int]
    graph: pose_graph.Graph

    def optimise(self, start: pose_graph.State, iterations: int) -> pose_graph.Optimum:
        return pose_graph.optimise(self.graph, start, iterations)

    def contradictions(self, chi2: Array) -> Mask:
        """(n,) links that contradict the rest by their chi2 (n,).

        Those small beside the worst may be its doing, and stay for now. The path's own chain always stands.
        """
        chi2 = np.where(self.links.j - self.links.i == 1, 0.0, chi2)
        return chi2 > max(_OUTLIER_CHI2, _OF_THE_WORST * float(chi2.max(initial=0.0)))

    def without(self, wrong: Mask) -> _Fit:
        kept = self.links.kept(~wrong)
        pairs = [pose_graph.motions(kept, self.places, _HUBER), *self.graph.pairs[1:]]
        return _Fit(kept, self.places, self.graph._replace(pairs=pairs))


def _graph(nodes, links, anchors, places, rig, noise) -> pose_graph.Graph:
    held = [node for node in nodes if node.number in anchors]
    known = pose_graph.given(
        [places[node.number] for node in held],
        np.array([node.world_from_camera for node in held]).reshape(-1, 4, 4),
        np.array([anchors[node.number] for node in held]).reshape(-1, 6, 6),
    )
    singles, pairs = [known, *aiding.singles(nodes, rig, noise)], [pose_graph.motions(links, places, _HUBER)]
    walked = aiding.displacements(nodes, rig)
    if not len(walked.i):
        return pose_graph.Graph(len(nodes), singles, pairs)
    return pose_graph.Graph(len(nodes), singles, [*pairs, walked], noise.dvl_scale)


def _marginals(found: pose_graph.Optimum, wanted: Sequence[int] | None, places: dict[int, int]) -> Array:
    if wanted is None:
        return found.into_marginals()
    covs = np.zeros((len(places), 6, 6))
    for number in wanted:
        covs[places[number]] = found.marginal(places[number])
    return covs
