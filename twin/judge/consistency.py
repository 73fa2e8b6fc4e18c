"""Consistency of the estimated covariances: NEES, and fraction of errors within two sigma."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

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
    frames = result.keyframe_rows[1 : min(len(result.keyframe_rows), len(result.node_cov))]
    final, true = result.final.world_from_camera, truth.trajectory.world_from_camera
    start = anchor(final[0], true[0]) if len(frames) else np.eye(4)
    cells = np.zeros(0) if elevation is None else normalised_error(elevation, truth)
    positions = position_consistency(result, start @ final[frames], true[frames], np.arange(1, len(frames) + 1))
    return positions | {"within_2sigma_map": mean(np.abs(cells) <= 2)}


def position_consistency(
    result: SurveyResult, moved: Array, true: Array, keyframes: NDArray[np.int64]
) -> dict[str, float | None]:
    """Returns the metrics of keyframes (n,) with positive definite covariances, of their poses moved to the truth."""
    in_world, cov = moved[:, :3, 3] - true[:, :3, 3], result.node_cov[keyframes, 3:, 3:]
    finite = np.asarray(np.isfinite(cov).all(axis=(1, 2)))
    usable = np.linalg.eigvalsh(np.where(finite[:, None, None], cov, 0.0))[:, 0] > 0
    error, cov = np.einsum("nji,nj->ni", moved[:, :3, :3], in_world)[usable], cov[usable]  # both in camera axes
    low, high = nees_interval(result.quality.independent_errors) or (None, None)
    sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    return {
        "nees_position_mean": mean(nees(error, cov)),
        "nees_position_low": low,
        "nees_position_high": high,
        "within_2sigma_position": mean(np.abs(error) <= 2 * sigma),
    }


def nees(error: Array, cov: Array) -> Array:
    """Returns e' C^-1 e (n,) of errors (n, d), covariances (n, d, d); d is expected (Bar-Shalom et al. 2001, 5.4.2)."""
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
    low, high = chdtri(3 * independent_errors, [1 - tail, tail]) / independent_errors
    return float(low), float(high)
