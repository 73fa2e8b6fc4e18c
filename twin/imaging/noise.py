"""Random numbers for every pixel of an image, inside a compiled loop, in any order and by any number of threads."""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import ndtri

NORMAL_BITS = 12  # that choose a normal number: its table stays in the processor's first cache
NORMAL_MASK = (1 << NORMAL_BITS) - 1


@cache
def normal_numbers() -> NDArray[np.float32]:
    """Standard normal numbers that so many random bits choose from, evenly, up to 3.7 sigma; variance is exactly 1."""
    quantiles = ndtri((np.arange(1 << NORMAL_BITS) + 0.5) / (1 << NORMAL_BITS))
    return (quantiles / quantiles.std()).astype(np.float32)


def seed_of(rng: np.random.Generator) -> np.uint64:
    """One number of a stream, from which those of a whole image follow."""
    return rng.integers(1 << 64, dtype=np.uint64)


@njit(cache=True, nogil=True, inline="always")
def random_bits(seed, index):
    """64 random bits of a place in a stream: SplitMix64 (Steele, Lea & Flood 2014), whose draws need no order."""
    z = seed + index * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
