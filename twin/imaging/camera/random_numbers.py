"""Counter-based random numbers for the pixels of an image; they do not depend on the order or number of threads."""

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from twin.kernels import kernel

NORMAL_BITS = 12  # random bits that index the table of normal numbers, which fits into the first-level cache
NORMAL_MASK = (1 << NORMAL_BITS) - 1


@cache
def normal_numbers() -> NDArray[np.float32]:
    """Returns 2^NORMAL_BITS equally probable normal numbers, up to 3.7 in magnitude, with mean 0 and variance 1."""
    quantiles = ndtri((np.arange(1 << NORMAL_BITS) + 0.5) / (1 << NORMAL_BITS))
    return (quantiles / quantiles.std()).astype(np.float32)


def seed_of(rng: np.random.Generator) -> np.uint64:
    return rng.integers(1 << 64, dtype=np.uint64)


@kernel(inline="always")
def random_bits(seed, index):
    """Returns 64 random bits: element `index` of the sequence of `seed` (SplitMix64; Steele, Lea & Flood 2014)."""
    z = seed + index * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
