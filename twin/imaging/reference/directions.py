"""Compiled random sampling of directions: from the table of a phase function, and in lobes around a direction."""

import numpy as np

from twin.kernels import kernel

GUIDE_G = 0.9  # mean cosine of the wider lobe around a lamp or the sun, see `sample_guide`


@kernel(inline="always")
def density_at(density_per_sr, cosine):
    cells = density_per_sr.shape[0]
    x = np.sqrt(np.sqrt(max(0.5 - 0.5 * cosine, 0.0)))
    return density_per_sr[min(int(x * cells), cells - 1)]


@kernel
def cell_of(cumulative, u):
    """Returns the cell i of a table for which cumulative[i] <= u < cumulative[i + 1], for u in [0, 1)."""
    low, high = 0, cumulative.shape[0] - 1
    while high - low > 1:
        middle = (low + high) >> 1
        if cumulative[middle] <= u:
            low = middle
        else:
            high = middle
    return low


@kernel
def sample_cosine(cumulative, rng):
    """Returns a random cosine of the scattering angle, sampled from the phase function."""
    cells = cumulative.shape[0] - 1
    k = cell_of(cumulative, rng.random())
    low, high = (k / cells) ** 4, ((k + 1) / cells) ** 4
    return 1 - 2 * (low + (high - low) * rng.random())


@kernel
def sample_angle(cumulative_angle, rng):
    """Returns a random angle in [0, pi] with a density proportional to the phase function times the angle."""
    cells = cumulative_angle.shape[0] - 1
    k = cell_of(cumulative_angle, rng.random())
    low, high = 2 * np.arcsin((k / cells) ** 2), 2 * np.arcsin(((k + 1) / cells) ** 2)
    return np.sqrt(low**2 + (high**2 - low**2) * rng.random())


@kernel
def turn(x, y, z, cosine, sine, azimuth):
    """Returns the unit vector at a polar angle and an azimuth around (x, y, z), in the frame of Duff et al. (2017)."""
    sign = 1.0 if z >= 0 else -1.0
    a = -1 / (sign + z)
    b = x * y * a
    e, f = sine * np.cos(azimuth), sine * np.sin(azimuth)
    return (
        cosine * x + e * (1 + sign * x * x * a) + f * b,
        cosine * y + e * sign * b + f * (sign + y * y * a),
        cosine * z - e * sign * x - f * y,
    )


@kernel
def turn_by_cosine(x, y, z, cosine, rng):
    sine = np.sqrt(max(1 - cosine * cosine, 0.0))
    return turn(x, y, z, cosine, sine, 2 * np.pi * rng.random())


@kernel
def sample_guide(cumulative_angle, rng):
    """Returns the cosine of a random angle from the direction to a light: half by `sample_angle`, half wider."""
    # uniform between 0 and a `sample_angle`, for light scattered once; Henyey-Greenstein of mean cosine `GUIDE_G`
    if rng.random() < 0.5:
        return np.cos(sample_angle(cumulative_angle, rng) * rng.random())
    g = GUIDE_G
    part = (1 - g * g) / (1 - g + 2 * g * rng.random())
    return min((1 + g * g - part * part) / (2 * g), 1.0)


@kernel
def guide_density(density_per_sr, beyond, angle_integral, cosine):
    """Returns the density [1/sr] of the directions of `sample_guide` at the cosine of the angle from lamp or sun."""
    g, cells = GUIDE_G, density_per_sr.shape[0]
    x = np.sqrt(np.sqrt(max(0.5 - 0.5 * cosine, 1e-18)))
    k = min(int(x * cells), cells - 1)
    angle, end = 2 * np.arcsin(min(x * x, 1.0)), 2 * np.arcsin(((k + 1) / cells) ** 2)
    once = (beyond[k + 1] + density_per_sr[k] * (end - angle)) / angle_integral
    once /= 2 * np.pi * max(2 * x * x * np.sqrt(max(1 - x**4, 0.0)), 1e-12)
    return 0.5 * once + 0.5 * (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)
