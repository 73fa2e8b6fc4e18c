"""Consistency of the estimated covariances: NEES, and fraction of errors within two sigma."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from twin.core.records import Array, ElevationMap, SurveyResult, Truth
from twin.judge.map_error import normalised_error
from twin.judge.summary_statistics import mean
from twin.judge.trajectory_errors import anchor

#: Share of the surveys with consistent covariances whose mean NEES lies in the interval.
CONSISTENT_SHARE = 0.99


def consistency_metrics(result: SurveyResult, elevation: ElevationMap | None, truth: Truth) -> dict[str, float | None]:
    """Returns `consistency.*` of metrics.json.

    For consistent covariances and normal errors the mean NEES of the positions is 3 and the fraction of errors within
    two sigma 0.954. `nees_position_low` and `_high` are those of `nees_interval`. `within_2sigma_position` is over the
    three camera axes of the keyframes, `within_2sigma_map` over the map cells with an error.
    """
    error, cov = _keyframe_errors(result, truth)
    low, high = nees_interval(result.quality.independent_errors) or (None, None)
    sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    cells = np.zeros(0) if elevation is None else normalised_error(elevation, truth)
    return {
        "nees_position_mean": mean(nees(error, cov)),
        "nees_position_low": low,
        "nees_position_high": high,
        "within_2sigma_position": mean(np.abs(error) <= 2 * sigma),
        "within_2sigma_map": mean(np.abs(cells) <= 2),
    }


def _keyframe_errors(result: SurveyResult, truth: Truth) -> tuple[Array, Array]:
    """Returns errors (n, 3) [m] and estimated covariances (n, 3, 3) of the final keyframes, both in camera axes.

    Without the first keyframe, anchored at the truth, and those without a positive definite covariance.
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
    finite = np.asarray(np.isfinite(cov).all(axis=(1, 2)))
    usable = np.linalg.eigvalsh(np.where(finite[:, None, None], cov, 0.0))[:, 0] > 0
    return in_camera[usable], cov[usable]


def nees(error: Array, cov: Array) -> Array:
    """Returns the normalised estimation error squared e' C^-1 e (n,) of errors (n, d) with covariances (n, d, d).

    Its expectation is d for consistent covariances (Bar-Shalom, Li & Kirubarajan 2001, section 5.4.2).
    """
    return np.einsum("ni,ni->n", error, np.linalg.solve(cov, error[..., None])[..., 0])


def nees_interval(independent_errors: float | None) -> tuple[float, float] | None:
    """Returns the bounds between which the mean NEES of the positions of 99 % of consistent surveys lies.

    It is distributed as chi-square with 3 k degrees of freedom, divided by k (Bar-Shalom, Li & Kirubarajan 2001,
    section 5.4.2), for k independent errors (not necessarily whole), to which the errors correlated along the path are
    equivalent.
    """
    if independent_errors is None:
        return None
    tail = (1 - CONSISTENT_SHARE) / 2
    low, high = chi2.ppf([tail, 1 - tail], 3 * independent_errors) / independent_errors
    return float(low), float(high)
