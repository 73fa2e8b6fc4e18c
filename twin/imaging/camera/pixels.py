"""Pixel model: shot noise, full well, read noise, gain and quantization to digital numbers.

The linear model of EMVA 1288: Poisson-distributed electrons, normal read noise, and a black level plus K (electrons +
noise), clipped to the largest digital number. Dark current and non-uniformity are not modelled.
"""

import numpy as np
from numpy.typing import NDArray

from twin.core.threads import in_row_bands
from twin.imaging.camera.random_numbers import NORMAL_BITS, NORMAL_MASK, normal_numbers, random_bits, seed_of
from twin.kernels import kernel

Raw = NDArray[np.uint16]

FEW_ELECTRONS = 10  # below this mean: exact Poisson numbers; above: normal numbers corrected for skewness
MOST_ELECTRONS = 80  # largest number that `_poisson` returns; for means below 10, the probability of more is negligible


def read_out(
    light: NDArray[np.float32], vignetting: NDArray[np.float32], response: NDArray[np.float32], bayer: bool,
    rng: np.random.Generator | None,
) -> Raw:  # fmt: skip
    """Returns raw digital numbers: (H, W) with a Bayer filter (R G / G B from the top left), else (H, W, 3).

    `light` (H, W, 3) is in cd/m2, `vignetting` (H, W) relative to the axis. `response` (8,): electrons of R, G, B on
    the axis at 1 cd/m2, full well [e-], read noise [e-], digital numbers per electron (K), black level, largest number.
    `rng` gives one number per image; None = no noise.
    """
    height, width = vignetting.shape
    out = np.empty((height, width, 1 if bayer else 3), np.uint16)
    seed = np.uint64(0) if rng is None else seed_of(rng)
    random = normal_numbers(), seed, rng is not None
    in_row_bands(lambda first, end: _read_out(light, vignetting, response, *random, out, first, end), height)
    return out[..., 0] if bayer else out


@kernel
def _read_out(light, vignetting, response, normal, seed, noisy, out, first, end):
    width, bands = out.shape[1:]
    n, few = width * bands, np.float32(FEW_ELECTRONS)
    expected, shot, read = np.zeros(n, np.float32), np.zeros(n, np.float32), np.zeros(n, np.float32)
    uniform = np.zeros(n, np.uint32)
    for v in range(first, end):
        n_few = 0
        for u in range(width):
            for k in range(bands):
                band = (v & 1) + (u & 1) if bands == 1 else k
                electrons = max(response[band] * vignetting[v, u] * light[v, u, band], np.float32(0.0))
                expected[u * bands + k] = electrons
                n_few += electrons < few
        if noisy:
            for k in range(n):
                bits = random_bits(seed, np.uint64(v * n + k))
                uniform[k] = np.uint32(bits & np.uint64(0xFFFFFFFF))
                shot[k] = normal[(bits >> np.uint64(32 - NORMAL_BITS)) & np.uint64(NORMAL_MASK)]
                read[k] = normal[bits >> np.uint64(64 - NORMAL_BITS)]
            _normal_to_poisson(expected, shot)
            for k in range(n if n_few else 0):
                if expected[k] < few:
                    shot[k] = _poisson(expected[k], uniform[k])
        else:
            shot[:] = expected
        _digitise(shot, read, response, out[v].reshape(-1))


@kernel
def _normal_to_poisson(expected, shot):
    """Replaces normal numbers z in `shot` (n,) by about Poisson-distributed counts of mean m, `expected`."""
    # round(m + s z + (z^2 - 1) / 6), the first terms of the Cornish-Fisher expansion (1938); s^2 = m - 1/18 - 1/12
    # compensates for the variance of the quadratic term and of the rounding
    half, zero = np.float32(0.5), np.float32(0.0)
    for k in range(shot.size):
        z, m = shot[k], expected[k]
        skew = (z * z - np.float32(1.0)) * np.float32(1 / 6)
        sigma = np.sqrt(max(m - np.float32(1 / 18 + 1 / 12), zero))
        shot[k] = max(np.floor(m + sigma * z + skew + half), zero)


@kernel
def _poisson(expected, uniform):
    """Returns a Poisson-distributed number of mean `expected`, by inversion, from 32 random bits."""
    uniform = (np.float64(uniform) + 0.5) * 2.0**-32
    probability = np.exp(-np.float64(expected))
    below, count = probability, 0
    while below < uniform and count < MOST_ELECTRONS:
        count += 1
        probability *= expected / count
        below += probability
    return np.float32(count)


@kernel
def _digitise(electrons, noise, response, out):
    full_well, read_noise, dn_per_e, black, top = response[3], response[4], response[5], response[6], response[7]
    half, zero = np.float32(0.5), np.float32(0.0)
    for k in range(out.size):
        level = black + dn_per_e * (min(electrons[k], full_well) + read_noise * noise[k])
        out[k] = np.uint16(min(max(level + half, zero), top))
