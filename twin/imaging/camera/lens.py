"""Brown-Conrady lens distortion, with the parameters of OpenCV (Brown 1971, Close-range camera calibration).

With x = X / Z, y = Y / Z and r^2 = x^2 + y^2, the distorted coordinates in units of the focal length are

    x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.scenario.model import CalibrationErrorConfig, LensConfig

STEPS = 40  # maximum number of steps of Newton's method
TOLERANCE = 1e-12  # of distorted coordinates, about 1e-9 px


class Distortion(NamedTuple):
    """Distortion coefficients of a lens; all zero = a pinhole."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0


def true_lens(lens: LensConfig) -> Distortion:
    return Distortion(lens.k1, lens.k2, lens.k3, lens.p1, lens.p2)


def believed_lens(lens: LensConfig, calibration: CalibrationErrorConfig) -> Distortion:
    """Returns the distortion by which frames are rectified: the true distortion minus the calibration errors."""
    return true_lens(lens)._replace(k1=lens.k1 - calibration.k1_error, k2=lens.k2 - calibration.k2_error)


def distort(normalised: Array, lens: Distortion) -> Array:
    """Returns the distorted image coordinates (..., 2) of rays with normalised coordinates (..., 2)."""
    x, y = normalised[..., 0], normalised[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3))
    across = x * radial + 2 * lens.p1 * x * y + lens.p2 * (r2 + 2 * x * x)
    down = y * radial + lens.p1 * (r2 + 2 * y * y) + 2 * lens.p2 * x * y
    return np.stack([across, down], axis=-1)


def undistort(distorted: Array, lens: Distortion) -> Array:
    """Returns the coordinates (..., 2) with given distorted ones; NaN where none is found below the radius `fold`."""
    normalised = newton(
        lambda at: distort(at, lens) - distorted, lambda at, _: _jacobian(at, lens), distorted, TOLERANCE, 1e3
    )
    before_fold = np.hypot(normalised[..., 0], normalised[..., 1]) < fold(lens)
    return np.where(before_fold[..., None], normalised, np.nan)


def fold(lens: Distortion) -> float:
    """Returns the normalised radius r of the first maximum of r (1 + k1 r^2 + k2 r^4 + k3 r^6); inf if it has none."""
    # the derivative, divided by r^6, is a polynomial in 1 / r^2 with leading coefficient 1: no division by zero
    roots = np.roots([1.0, 3 * lens.k1, 5 * lens.k2, 7 * lens.k3])
    real = roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 1e-12)]
    return float(1 / np.sqrt(real.max())) if real.size else np.inf


def newton(
    residual_at: Callable[[Array], Array], jacobian_at: Callable[[Array, Array], Array], start: Array,
    tolerance: float, factor: float,
) -> Array:  # fmt: skip
    """Returns the points (..., 2) where a function (..., 2) is below `tolerance`, by Newton's method from `start`.

    A point is NaN where it is not below `factor` times that. `jacobian_at` gets points and residuals.
    """
    at = start
    for _ in range(STEPS):
        residual = residual_at(at)
        if np.nanmax(np.abs(residual), initial=0.0) < tolerance:
            break
        at = at - _solved(jacobian_at(at, residual), residual)
    x, y = np.moveaxis(np.abs(residual_at(at)), -1, 0)
    converged = np.maximum(x, y) < factor * tolerance
    return np.where(converged[..., None], at, np.nan)


def _solved(jacobian: Array, residual: Array) -> Array:
    """Returns the Newton step jacobian^-1 residual (..., 2); not finite where the Jacobian (..., 2, 2) is singular."""
    (a, b), (c, d) = (jacobian[..., 0, 0], jacobian[..., 0, 1]), (jacobian[..., 1, 0], jacobian[..., 1, 1])
    with np.errstate(all="ignore"):
        x, y = d * residual[..., 0] - b * residual[..., 1], a * residual[..., 1] - c * residual[..., 0]
        return np.stack([x, y], axis=-1) / (a * d - b * c)[..., None]


def _jacobian(normalised: Array, lens: Distortion) -> Array:
    x, y = normalised[..., 0], normalised[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3))
    bend = 2 * (lens.k1 + r2 * (2 * lens.k2 + 3 * r2 * lens.k3))
    along_x = radial + bend * x * x + 2 * lens.p1 * y + 6 * lens.p2 * x
    along_y = radial + bend * y * y + 6 * lens.p1 * y + 2 * lens.p2 * x
    across = bend * x * y + 2 * lens.p1 * x + 2 * lens.p2 * y
    return np.stack([np.stack([along_x, across], -1), np.stack([across, along_y], -1)], -2)
