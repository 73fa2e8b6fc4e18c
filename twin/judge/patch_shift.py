"""Local displacement of one image against another, by normalised cross-correlation of patches."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array

Layer = NDArray[np.float32]


class PatchShift(NamedTuple):
    """Position of a patch in the first image minus its position in the second image."""

    right_px: float
    down_px: float


def patch_shift(patch: Layer, around: Layer, least_correlation: float) -> PatchShift | None:
    """Returns the displacement of a patch (n, n) of the first image against the second image.

    The peak of the correlation is interpolated by a parabola through three values along each axis. Returns None if the
    patch or the part of the second image has no texture, if the peak is below `least_correlation`, if it lies at the
    border of the search range of m pixels, or if the correlation exceeds 90 % of the peak more than three rows or
    columns away from it.

    Args:
        patch: (n, n) part of the first image.
        around: (n + 2 m, n + 2 m) part of the second image with the same centre.
        least_correlation: smallest accepted peak of the normalised cross-correlation.
    """
    if min(patch.std(), around.std()) < 1e-3:
        return None
    score = np.asarray(cv2.matchTemplate(around, patch, cv2.TM_CCOEFF_NORMED), np.float64)
    row, col = np.unravel_index(score.argmax(), score.shape)
    peak, last = score[row, col], score.shape[0] - 1
    if not (0 < row < last and 0 < col < last) or peak < least_correlation:
        return None
    others = score.copy()
    others[max(row - 3, 0) : row + 4, max(col - 3, 0) : col + 4] = -1
    if others.max() > 0.9 * peak:
        return None
    down = row + _vertex(*score[row - 1 : row + 2, col]) - last / 2
    right = col + _vertex(*score[row, col - 1 : col + 2]) - last / 2
    return PatchShift(-float(right), -float(down))


def _vertex(before: float, at: float, after: float) -> float:
    """Returns the vertex of the parabola through values at -1, 0 and 1, of which that at 0 is largest."""
    curvature = before - 2 * at + after
    return 0.0 if curvature >= 0 else 0.5 * (before - after) / curvature


def transfer(patch: Layer, true: Layer, shift: PatchShift) -> tuple[Array, Array]:
    """Returns the cross-spectrum (n, n) of a patch and the true patch, and the power spectrum (n, n) of the true patch.

    Both patches are weighted by a Hann window. The cross-spectrum is corrected for the displacement `shift`, and its
    real part is returned. The ratio of the spectra is the modulation transfer function.
    """
    n = len(patch)
    hann = np.hanning(n + 2)[1:-1]
    taper = hann * hann[:, None]
    first, second = (np.fft.fft2((picture - picture.mean()) * taper) for picture in (patch, true))
    f = np.fft.fftfreq(n)
    phase = np.exp(2j * np.pi * (f * shift.right_px + f[:, None] * shift.down_px))
    return np.real(first * phase * np.conj(second)), np.abs(second) ** 2
