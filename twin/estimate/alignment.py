"""Global alignment: maximum-likelihood poses of the nodes, given the links between them and the sensor readings.

The mixed adjustment model (Negahdaripour & Madjidi 2003, eq. 7) reduces to one residual block per link; solved as a
factor graph with a Huber loss on the links. Outlier links are removed and reported.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.core.links import Link, Links
from twin.core.quality import CalibrationEstimate
from twin.core.records import Mask, SensorNoise, StereoRig
from twin.estimate.adjustment import pose_graph
from twin.estimate.navigation import aiding
from twin.estimate.self_calibration import NOTHING_MEASURED, MeasuredErrors, SharedParameters, shared_parameters
from twin.estimate.vision.stereo import Keyframe

_OUTLIER_CHI2 = 40.0  # chi-square with six degrees of freedom; one inlier in 2 million exceeds it
_MIN_SHARE_OF_WORST = 0.01  # a link with a chi2 below this fraction of the largest is not removed in the same round
_MAX_ROUNDS = 10
_MAX_ITERATIONS = 100
_ROUND_ITERATIONS = 10  # iterations per round; the Huber weights converge slowly while the graph has gross outliers
_DRAWS = 200  # drawn errors of all poses, from which the number of independent errors is estimated to about 15 %
_DRAWN_AT_ONCE = 10  # of them, to limit memory
_HUBER = 3.0  # threshold of the Huber loss in standard deviations


class AlignmentResult(NamedTuple):
    poses: Array  #: (n, 4, 4) aligned world_from_camera of the nodes
    #: (n, 6, 6) marginal covariances, [rotation, translation] (rad, m) in camera axes; zeros where not requested.
    covs: Array
    dropped: list[Link]  #: links that were removed as outliers
    link_chi2: float  #: mean chi-square of the remaining links per degree of freedom; 1 is expected, 0 without links
    converged: bool  #: false if the iterations ended before the minimum was reached
    calibration: CalibrationEstimate  #: errors of the calibration, estimated with the poses
    #: number of independent position errors to which those of all nodes are equivalent (`_independent_errors`); None
    #: unless the covariances of all nodes were requested.
    independent_errors: float | None = None


def align(
    nodes: Sequence[Keyframe], links: Sequence[Link], anchors: dict[int, Array], rig: StereoRig, noise: SensorNoise,
    marginals_of: Sequence[int] | None = None, measured: MeasuredErrors = NOTHING_MEASURED,
) -> AlignmentResult:  # fmt: skip
    """Returns the maximum-likelihood poses of a window of nodes, their covariances, and the links removed as outliers.

    The poses of the nodes are the initial values; `anchors` are prior covariances (6, 6) [rotation, translation] (rad,
    m) about them by node number, also of nodes that are not in the window. Covariances are those of the nodes
    `marginals_of`, None: all. The errors `measured` of the calibration are estimated together with the poses. Raises
    LinAlgError if the links, anchors and sensor readings do not constrain every node.
    """
    links, dropped = Links.from_sequence(links), list[Link]()
    displacements = [kind for kind in [aiding.displacement_factors(nodes, rig)] if len(kind.i)]
    shared = shared_parameters(rig, noise, bool(displacements), measured)
    unary = [_anchor_factors(nodes, anchors), *aiding.unary_factors(nodes, rig, noise)]
    binary = [_motion_factors(nodes, links, shared), *displacements]
    graph = pose_graph.FactorGraph(len(nodes), unary, binary, shared.prior)
    start = pose_graph.GraphState(np.array([node.world_from_camera for node in nodes]), shared.prior.mean)
    solution = pose_graph.optimise(graph, start, _ROUND_ITERATIONS)
    for _ in range(_MAX_ROUNDS):
        outliers = _outliers(graph, solution.chi2[0])
        if not outliers.any():
            break
        dropped += links.select(outliers)
        links, state = links.select(~outliers), solution.state
        del solution  # frees its Cholesky factor before the next one is allocated
        graph = graph._replace(binary=[_motion_factors(nodes, links, shared), *displacements])
        solution = pose_graph.optimise(graph, state, _ROUND_ITERATIONS)
    if not solution.converged:
        state = solution.state
        del solution
        solution = pose_graph.optimise(graph, state, _MAX_ITERATIONS)
    poses, chi2, calibration = solution.state.poses, _mean_chi2(links, solution.chi2[0]), shared.estimate(solution)
    if marginals_of is None:
        draws = _draw_positions(solution)  # before the marginals, which overwrite the factor
        covs = solution.marginals_in_place()
        independent = _independent_errors(draws, covs[1:, 3:, 3:])
        return AlignmentResult(poses, covs, dropped, chi2, solution.converged, calibration, independent)
    covs = np.zeros((len(nodes), 6, 6))
    for k, node in enumerate(nodes):
        if node.number in marginals_of:
            covs[k] = solution.marginal(k)
    return AlignmentResult(poses, covs, dropped, chi2, solution.converged, calibration)


def _anchor_factors(nodes: Sequence[Keyframe], anchors: dict[int, Array]) -> pose_graph.UnaryFactors:
    """Returns the priors of the anchored nodes, at their initial poses."""
    anchored = [(k, node) for k, node in enumerate(nodes) if node.number in anchors]
    return pose_graph.prior_factors(
        [k for k, _ in anchored],
        np.array([node.world_from_camera for _, node in anchored]).reshape(-1, 4, 4),
        np.array([anchors[node.number] for _, node in anchored]).reshape(-1, 6, 6),
    )


def _motion_factors(nodes: Sequence[Keyframe], links: Links, shared: SharedParameters) -> pose_graph.BinaryFactors:
    index_of = {node.number: k for k, node in enumerate(nodes)}
    return pose_graph.motion_factors(links, index_of, _HUBER, shared.effect_on(links))


def _outliers(graph: pose_graph.FactorGraph, chi2: Array) -> Mask:
    """Returns a mask (n,) of the links to remove, by the squared norms `chi2` (n,) of their whitened residuals."""
    # not those below 1 % of the largest, which may have distorted them, nor those between consecutive nodes
    motions = graph.binary[0]
    chi2 = np.where(motions.j - motions.i == 1, 0.0, chi2)
    return chi2 > max(_OUTLIER_CHI2, _MIN_SHARE_OF_WORST * float(chi2.max(initial=0.0)))


def _mean_chi2(links: Links, chi2: Array) -> float:
    """Returns the mean chi-square per degree of freedom by covariances before inflation; 0 without links."""
    return float(np.mean(chi2 * links.shared_by)) / 6 if len(chi2) else 0.0


def _draw_positions(solution: pose_graph.Solution) -> list[Array]:
    """Returns draws (n - 1, 3, `_DRAWN_AT_ONCE`) of position errors of all nodes but the first, the reference [m]."""
    rng = np.random.default_rng(0)
    return [solution.sample(_DRAWN_AT_ONCE, rng)[1:, 3:].copy() for _ in range(_DRAWS // _DRAWN_AT_ONCE)]


def _independent_errors(draws: Sequence[Array], covs: Array) -> float | None:
    """Returns the number k of independent position errors whose mean NEES varies as much as that of all nodes."""
    # of 3 k squared normal numbers, the sum / k has the variance 6 / k; `draws` (n, 3, m) of the joint covariance [m],
    # `covs` (n, 3, 3) [m2]
    known = np.linalg.eigvalsh(covs)[:, 0] > 0
    if not known.any():
        return None
    root = np.linalg.cholesky(covs[known])
    nees = [np.sum(np.linalg.solve(root, errors[known]) ** 2, axis=(0, 1)) for errors in draws]
    return float(6 / np.var(np.concatenate(nees) / known.sum()))
