"""Least-squares adjustment of factor graphs of poses.

The names exported here are the interface; all are defined in `pose_graph`. A caller builds a `FactorGraph` of
`UnaryFactors` and `BinaryFactors` (`prior_factors` and `motion_factors` create the common ones) and passes it with an
initial `GraphState` to `optimise`, which returns a `Solution` with poses and marginal covariances.

The other modules are not used outside this package. `elimination` and `block_cholesky` are the sparse Cholesky solver,
`chordal` solves pose graphs without initial poses.
"""

from twin.estimate.adjustment.pose_graph import (
    BinaryFactors,
    FactorGraph,
    GraphState,
    Solution,
    UnaryFactors,
    motion_factors,
    optimise,
    pose_residual_jacobians,
    pose_residuals,
    prior_factors,
)

__all__ = [
    "BinaryFactors",
    "FactorGraph",
    "GraphState",
    "Solution",
    "UnaryFactors",
    "motion_factors",
    "optimise",
    "pose_residual_jacobians",
    "pose_residuals",
    "prior_factors",
]
