"""Reflection of light by the floor: Lambertian, Oren-Nayar or Hapke, and specular highlights.

A material has a bidirectional reflectance f [1/sr]: radiance = f * illuminance. With mu_i and mu_o the cosines of
incidence and view, c that of the phase angle g, and rho the albedo of the texture:

Lambertian: f = rho / pi.
Oren & Nayar 1994 (qualitative model, their eq. 30), sigma the standard deviation of the slope angle of V-grooves:
    f = rho / pi * (A + B max(0, s) / max(mu_i, mu_o)),  s = c - mu_i mu_o,
    A = 1 - 0.5 sigma^2 / (sigma^2 + 0.33),  B = 0.45 sigma^2 / (sigma^2 + 0.09)
Hapke 1981 (isotropic scatterers; Hapke 1986 for B_g), w from the diffusive reflectance rho = (1 - gamma) / (1 + gamma):
    f = w / (4 pi) / (mu_i + mu_o) * (1 + B_g + H(mu_i) H(mu_o) - 1),
    H(x) = (1 + 2x) / (1 + 2x gamma),  gamma = sqrt(1 - w),  B_g = B0 / (1 + tan(g/2) / h)
Specular highlights of a share F (the rest is reflected as above), D and G of GGX (Walter et al. 2007, eqs. 20, 33, 34):
    f_s = F D(m) G(i) G(o) / (4 mu_i mu_o)

Daylight, and lamp light that was scattered on its way to the floor, are reflected as by a Lambertian floor.
"""

from typing import NamedTuple

import numpy as np

from twin.kernels import kernel
from twin.scenario.model import TerrainConfig

OPPOSITION, OPPOSITION_WIDTH = 0.5, 0.07  # B0 and h of Hapke's model: a floor of opaque grains
LAMBERT, OREN_NAYAR, HAPKE = 0, 1, 2
KINDS = {"lambert": LAMBERT, "oren_nayar": OREN_NAYAR, "hapke": HAPKE}

_FAST = {"contract", "arcp", "nsz", "reassoc"}


class Material(NamedTuple):
    kind: int  # LAMBERT, OREN_NAYAR or HAPKE
    a: np.float32  # coefficients A and B of Oren and Nayar's model
    b: np.float32
    specular: np.float32  # share F of the light that is mirrored
    alpha_squared: np.float32  # square of GGX's width parameter, the tangent of the highlight's `specular_width_deg`


def material_of(terrain: TerrainConfig) -> Material | None:
    """Returns the reflection of a floor; None if it is Lambertian without highlights."""
    if terrain.material == "lambert" and not terrain.specular:
        return None
    square = np.deg2rad(terrain.roughness_deg) ** 2
    a, b = 1 - 0.5 * square / (square + 0.33), 0.45 * square / (square + 0.09)
    width = np.tan(np.deg2rad(terrain.specular_width_deg)) ** 2
    return Material(KINDS[terrain.material], *(np.float32(value) for value in (a, b, terrain.specular, width)))


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def reflectance(material, albedo, mu_i, mu_o, phase):
    """Returns the bidirectional reflectance [1/sr], in single precision, for an albedo of 0 to 1."""
    # `mu_i`, `mu_o`: cosines of incidence and of view, above 0; `phase`: that of the phase angle
    kind, a, b, specular, alpha_squared = material
    one, two, zero = np.float32(1), np.float32(2), np.float32(0)
    tiny = np.float32(1e-6)
    per_pi = np.float32(1 / np.pi)
    diffuse = albedo * per_pi
    if kind == OREN_NAYAR:
        diffuse *= a + b * max(phase - mu_i * mu_o, zero) / max(mu_i, mu_o)
    elif kind == HAPKE:
        gamma = (one - albedo) / (one + albedo)
        half_angle = np.sqrt(max(one - phase, zero) / max(one + phase, tiny))
        opposition = np.float32(OPPOSITION) / (one + half_angle / np.float32(OPPOSITION_WIDTH))
        many = (one + two * mu_i) * (one + two * mu_o) / ((one + two * mu_i * gamma) * (one + two * mu_o * gamma))
        diffuse = (one - gamma * gamma) * np.float32(0.25) * per_pi / (mu_i + mu_o) * (opposition + many)
    if specular == zero:
        return diffuse
    half_squared = (mu_i + mu_o) * (mu_i + mu_o) / max(two + two * phase, tiny)  # squared cosine of normal and m
    spread = half_squared * (alpha_squared - one) + one
    distribution = alpha_squared * per_pi / (spread * spread)
    mask_i = mu_i + np.sqrt(alpha_squared + (one - alpha_squared) * mu_i * mu_i)
    mask_o = mu_o + np.sqrt(alpha_squared + (one - alpha_squared) * mu_o * mu_o)
    return (one - specular) * diffuse + specular * distribution / (mask_i * mask_o)


@kernel(forceinline=True, fastmath=_FAST, error_model="numpy")
def add_reflected(material, lamp, albedo, here, y, focal, normal, arriving, reflected):
    """Adds the light [cd/m2] of one lamp that a row of W pixels reflects, before loss on the way, to `reflected`."""
    # `lamp` starts with its position in camera axes [m]; `albedo` (W, 3) uint8; `here` (W,) depth [m]; `normal` (3, W)
    # in camera axes; `arriving` (3, W) illuminance by the lamp, attenuated on its path to the floor [lx]
    one, half, tiny = np.float32(1), np.float32(0.5), np.float32(1e-4)
    for u in range(here.size):
        if arriving[0, u] + arriving[1, u] + arriving[2, u] <= np.float32(0):
            continue
        z = here[u]
        x = (np.float32(u) - half * np.float32(here.size - 1)) / focal
        per_r = one / np.sqrt(x * x + y * y + one)
        ix, iy, iz = lamp[0] - x * z, lamp[1] - y * z, lamp[2] - z
        per_d = one / np.sqrt(ix * ix + iy * iy + iz * iz)
        nx, ny, nz = normal[0, u], normal[1, u], normal[2, u]
        mu_i = max((ix * nx + iy * ny + iz * nz) * per_d, tiny)
        mu_o = max(-(x * nx + y * ny + nz) * per_r, tiny)
        phase = -(ix * x + iy * y + iz) * per_d * per_r
        for c in range(3):
            rho = np.float32(albedo[u, c]) * np.float32(1 / 255)
            reflected[c, u] += arriving[c, u] * reflectance(material, rho, mu_i, mu_o, phase)
