"""Consistency of the estimated covariances: NEES, and fraction of errors within two sigma."""

from __future__ import annotations

import numpy as np

from twin.core.records import Array, ElevationMap, SurveyResult, Truth
from twin.judge.map_error import normalised_error
from twin.judge.summary_statistics import mean
from twin.judge.trajectory import anchor


def consistency_metrics(result: SurveyResult, elevation: ElevationMap | None, truth: Truth) -> dict[str, float | None]:
    """Returns `consistency.*` of metrics.json.

    For consistent covariances and normal errors the mean NEES of the positions is 3 and the fraction of errors
    within two sigma is 0.954. `within_2sigma_position` is the fraction over the three camera axes of the keyframes that
    `keyframe_errors` returns, `within_2sigma_map` the fraction over the map cells that `normalised_error` returns.
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
    """Returns errors and estimated covariances of the final keyframe positions, both in camera axes.

    The first keyframe is left out because it is anchored at the truth. Keyframes without a positive definite
    covariance are left out as well.

    Returns:
        (n, 3) errors [m]; (n, 3, 3) covariances [m2].
    """
    n = min(len(result.keyframe_rows), len(result.node_cov))
    frames = result.keyframe_rows[1:n]
    if len(frames) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3, 3))
    final, true = result.final.world_from_camera, truth.trajectory.world_from_camera
    anchored = anchor(final[0], true[0]) @ final[frames]
    in_world = anchored[:, :3, 3] - true[frames, :3, 3]
    in_camera = np.einsum("nji,nj->ni", anchored[:, :3, :3], in_world)
    cov = np.asarray(result.node_cov)[1:n, 3:, 3:]
    usable = _positive_definite(cov)
    return in_camera[usable], cov[usable]


def nees(error: Array, cov: Array) -> Array:
    """Returns the normalised estimation error squared e' C^-1 e (n,) of errors (n, d) with covariances (n, d, d).

    Its expectation is d for consistent covariances (Bar-Shalom, Li & Kirubarajan 2001, section 5.4.2).
    """
    return np.einsum("ni,ni->n", error, np.linalg.solve(cov, error[..., None])[..., 0])


def _positive_definite(cov: Array) -> np.ndarray:
    """Returns whether each of the matrices (n, d, d) is finite and positive definite, (n,) bool."""
    finite = np.asarray(np.isfinite(cov).all(axis=(1, 2)))
    smallest = np.linalg.eigvalsh(np.where(finite[:, None, None], cov, 0.0))[:, 0]
    return np.asarray(smallest > 0)
