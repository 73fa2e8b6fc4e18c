"""From electrons to numbers: chance, a full well, noise of reading, gain, and whole digital numbers.

The linear model of EMVA 1288: photons make electrons by Poisson's law, reading adds normal noise, and the camera tells
K (electrons + noise) above a black level, cut off at its highest number. Left out: dark current, which is small in the
milliseconds of an exposure in cold water, and that pixels differ from one another.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.imaging.noise import NORMAL_BITS, NORMAL_MASK, normal_numbers, random_bits, seed_of
from twin.imaging.row_parallel import in_row_bands

Raw = NDArray[np.uint16]

FEW_ELECTRONS = 10  # up to here each electron is drawn; above, a normal number is bent to Poisson's skewness
MOST_DRAWN = 80  # that is never reached: ten are expected


class Pixels(NamedTuple):
    """What turns light into numbers.

    Args:
        electrons_per_cd: (3,) expected electrons by 1 cd/m2 on the axis in this exposure, for R, G, B.
        full_well_e: electrons that a pixel holds.
        read_noise_e: deviation of the noise of reading [e-].
        dn_per_e: digital numbers of an electron, K of EMVA 1288.
        black_dn, top_dn: number without light, and the highest number.
    """

    electrons_per_cd: NDArray[np.float64]
    full_well_e: float
    read_noise_e: float
    dn_per_e: float
    black_dn: float
    top_dn: float


def read_out(
    light: NDArray[np.float32],
    vignetting: NDArray[np.float32],
    pixels: Pixels,
    bayer: bool,
    rng: np.random.Generator | None,
) -> Raw:
    """Digital numbers (H, W) of one band a pixel, R G / G B from the top left, or (H, W, 3) of all.

    Args:
        light: (H, W, 3) [cd/m2].
        vignetting: (H, W) share of the light that arrives.
        rng: gives one number an image; None is an image without noise.
    """
    height, width = vignetting.shape
    out = np.empty((height, width, 1 if bayer else 3), np.uint16)
    seed = np.uint64(0) if rng is None else seed_of(rng)
    numbers = np.array([*pixels.electrons_per_cd, *pixels[1:]], np.float32)
    chances = normal_numbers(), seed, rng is not None
    in_row_bands(lambda first, end: _read_out(light, vignetting, numbers, *chances, out, first, end), height)
    return out[..., 0] if bayer else out


@njit(cache=True, nogil=True)
def _read_out(light, vignetting, pixels, normal, seed, noisy, out, first, end):
    """Fills rows `first` to `end` of `out` (H, W, 1 or 3)."""
    width, bands = out.shape[1:]
    n, few = width * bands, np.float32(FEW_ELECTRONS)
    expected, shot, reading = np.zeros(n, np.float32), np.zeros(n, np.float32), np.zeros(n, np.float32)
    chance = np.zeros(n, np.uint32)
    for v in range(first, end):
        n_few = 0
        for u in range(width):
            for k in range(bands):
                band = (v & 1) + (u & 1) if bands == 1 else k
                electrons = max(pixels[band] * vignetting[v, u] * light[v, u, band], np.float32(0.0))
                expected[u * bands + k] = electrons
                n_few += electrons < few
        if noisy:
            for k in range(n):
                bits = random_bits(seed, np.uint64(v * n + k))
                chance[k] = np.uint32(bits & np.uint64(0xFFFFFFFF))
                shot[k] = normal[(bits >> np.uint64(32 - NORMAL_BITS)) & np.uint64(NORMAL_MASK)]
                reading[k] = normal[bits >> np.uint64(64 - NORMAL_BITS)]
            _many(expected, shot)
            for k in range(n if n_few else 0):
                if expected[k] < few:
                    shot[k] = _few(expected[k], chance[k])
        else:
            shot[:] = expected
        _digitise(shot, reading, pixels, out[v].reshape(-1))


@njit(cache=True, nogil=True)
def _many(expected, shot):
    """Turns normal numbers z in `shot` into whole electrons of Poisson's mean m, variance and skewness.

    They are m + s z + (z^2 - 1) / 6, the first terms of Cornish & Fisher (1938), with s^2 = m - 1/18 - 1/12: what the
    bend and the rounding add to the variance.
    """
    half, zero = np.float32(0.5), np.float32(0.0)
    for k in range(shot.size):
        z, m = shot[k], expected[k]
        bend = (z * z - np.float32(1.0)) * np.float32(1 / 6)
        sigma = np.sqrt(max(m - np.float32(1 / 18 + 1 / 12), zero))
        shot[k] = max(np.floor(m + sigma * z + bend + half), zero)


@njit(cache=True, nogil=True)
def _few(expected, chance):
    """A number of electrons by inversion of Poisson's distribution, from 32 random bits."""
    chance = (np.float64(chance) + 0.5) * 2.0**-32
    probability = np.exp(-np.float64(expected))
    below, count = probability, 0
    while below < chance and count < MOST_DRAWN:
        count += 1
        probability *= expected / count
        below += probability
    return np.float32(count)


@njit(cache=True, nogil=True)
def _digitise(electrons, noise, pixels, out):
    """Fills `out` (n,) with digital numbers of `electrons` and the noise of reading."""
    full_well, read_noise, dn_per_e, black, top = pixels[3], pixels[4], pixels[5], pixels[6], pixels[7]
    half, zero = np.float32(0.5), np.float32(0.0)
    for k in range(out.size):
        level = black + dn_per_e * (min(electrons[k], full_well) + read_noise * noise[k])
        out[k] = np.uint16(min(max(level + half, zero), top))
