"""Do the estimates know how good they are? Errors against their own covariance."""

from __future__ import annotations

import numpy as np

from twin.core.records import Array, ElevationMap, SurveyResult, Truth
from twin.judge.map_error import normalised_error
from twin.judge.summary_statistics import mean
from twin.judge.trajectory import anchor


def consistency_metrics(result: SurveyResult, elevation: ElevationMap | None, truth: Truth) -> dict[str, float | None]:
    """`consistency.*` of metrics.json: mean NEES of positions (3 if right), shares within two sigma (0.954 if normal).

    `within_2sigma_position` counts every camera axis of every keyframe, `within_2sigma_map` every estimated cell.
    """
    error, cov = keyframe_errors(result, truth)
    sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    cells = np.zeros(0) if elevation is None else normalised_error(elevation, truth)
    return {
        "nees_position_mean": mean(nees(error, cov)),
        "within_2sigma_position": mean(np.abs(error) <= 2 * sigma),
        "within_2sigma_map": mean(np.abs(cells) <= 2),
    }


def keyframe_errors(result: SurveyResult, truth: Truth) -> tuple[Array, Array]:
    """Position errors (n, 3) [m] of the final keyframes and their covariances (n, 3, 3) [m2], both in camera axes.

    The first keyframe is anchored at the truth and left out, as is one without a positive definite covariance.
    """
    n = min(len(result.keyframe_rows), len(result.node_cov))
    frames = result.keyframe_rows[1:n]
    if len(frames) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3, 3))
    final, true = result.final.world_from_camera, truth.trajectory.world_from_camera
    moved = anchor(final[0], true[0]) @ final[frames]
    in_world = moved[:, :3, 3] - true[frames, :3, 3]
    in_camera = np.einsum("nji,nj->ni", moved[:, :3, :3], in_world)
    cov = np.asarray(result.node_cov)[1:n, 3:, 3:]
    usable = _positive_definite(cov)
    return in_camera[usable], cov[usable]


def nees(error: Array, cov: Array) -> Array:
    """Normalised estimation error squared e' C^-1 e of errors (n, d) with covariances (n, d, d)."""
    return np.einsum("ni,ni->n", error, np.linalg.solve(cov, error[..., None])[..., 0])


def _positive_definite(cov: Array) -> np.ndarray:
    """(n,) bool."""
    finite = np.asarray(np.isfinite(cov).all(axis=(1, 2)))
    smallest = np.linalg.eigvalsh(np.where(finite[:, None, None], cov, 0.0))[:, 0]
    return np.asarray(smallest > 0)
