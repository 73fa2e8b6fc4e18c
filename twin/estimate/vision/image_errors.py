"""Smooth errors of the image positions that a wrong lens, port or rectification leaves, and their standard deviations.

Each of three errors is a polynomial of second degree in the position: that of the columns of the left image, of the
columns of the right image, and of the rows, of which stereo points have the mean of both images. The coefficients are
those of polynomials that are orthonormal over the image.
"""

import numpy as np

from twin.core.geometry import Array

_BASIS = 6  # polynomials of an error
N_COEFFICIENTS = 3 * _BASIS


def image_errors(points: Array, half_size: Array) -> Array:
    """Returns the derivatives (n, 3, 18) of normalised (x, y, disparity) of points (n, 3) by the coefficients."""
    # `half_size` (2,) is half the width and height of the image [focal lengths]
    x, y = points[:, :2].T / half_size[:, None] * 3**0.5  # of unit variance over the image
    square_x, square_y = ((t * t - 1) / 0.8**0.5 for t in (x, y))
    basis = np.stack([np.ones_like(x), x, y, x * y, square_x, square_y], axis=1)
    errors = np.zeros((len(points), 3, N_COEFFICIENTS))
    left, right, rows = (slice(k * _BASIS, (k + 1) * _BASIS) for k in range(3))
    errors[:, 0, left], errors[:, 1, rows] = basis, basis
    errors[:, 2, left], errors[:, 2, right] = basis, -basis
    return errors


def change_by_distortion(points: Array) -> Array:
    """Returns the change (n, 3) of normalised (x, y, disparity) of stereo points per k1 that is not corrected."""
    # both cameras have the radial distortion x (1 + k1 r^2) (Brown 1966)
    x, y, disparity = points.T
    left, right = (column * (column**2 + y**2) for column in (x, x - disparity))
    rows = y * (x**2 + (x - disparity) ** 2 + 2 * y**2) / 2  # mean of both images
    return np.column_stack([left, rows, left - right])


def coefficient_sigmas(row_pattern: float) -> Array:
    """Returns the standard deviations (18,) of the coefficients, given the RMS of a systematic row difference."""
    # columns of a camera are taken to err as much as rows, and two cameras independently
    one_camera = row_pattern / 2**0.5
    return np.repeat([one_camera, one_camera, one_camera / 2**0.5], _BASIS) / _BASIS**0.5
