"""Laws of the reflection of the floor: Lambert's limit, reciprocity, energy, retro-reflection, sampled facets."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from twin.core import geometry
from twin.imaging.image_formation import ImageFormation, RenderedView, StampedPose
from twin.imaging.light.illumination import illumination_of
from twin.imaging.scene.materials import material_of, reflectance
from twin.scenario.model import Scenario, TerrainConfig
from twin.terrains import TextureSource, generate

MATERIALS = {
    "lambert": TerrainConfig(),
    "lambert with highlights": TerrainConfig(specular=0.4),
    "oren_nayar 20 deg": TerrainConfig(material="oren_nayar", roughness_deg=20.0),
    "oren_nayar 60 deg": TerrainConfig(material="oren_nayar", roughness_deg=60.0),
    "hapke": TerrainConfig(material="hapke"),
    "hapke with highlights": TerrainConfig(material="hapke", specular=0.1),
    "metal": TerrainConfig(specular=1.0, specular_width_deg=30.0),
}


@njit
def _table(material, albedo, mu_i, mu_o, phase):
    out = np.empty(mu_o.shape, np.float64)
    for k in range(mu_o.size):
        out[k] = reflectance(material, np.float32(albedo), mu_i[k], mu_o[k], phase[k])
    return out


def f(terrain: TerrainConfig, albedo: float, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """Returns the bidirectional reflectance (n,) for unit directions (n, 3) in axes whose z is the normal."""
    material = material_of(terrain) or material_of(TerrainConfig(material="oren_nayar", roughness_deg=0.0))
    phase = (incident * outgoing).sum(-1)
    return _table(material, albedo, *(np.float32(x) for x in (incident[:, 2], outgoing[:, 2], phase)))


def hemisphere(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns directions (m, 3) and their solid angles times the cosine (m,), which sum to pi."""
    square, weight = np.polynomial.legendre.leggauss(n)
    sine, azimuth = np.sqrt((1 + square) / 2), (np.arange(2 * n) + 0.5) * np.pi / n
    x, y = np.outer(sine, np.cos(azimuth)), np.outer(sine, np.sin(azimuth))
    directions = np.stack([x, y, np.sqrt(1 - x**2 - y**2)], -1).reshape(-1, 3)
    return directions, np.repeat(weight / 2 * np.pi / (2 * n), 2 * n)


def towards(angle_deg: float, n: int) -> np.ndarray:
    return np.tile([np.sin(np.deg2rad(angle_deg)), 0.0, np.cos(np.deg2rad(angle_deg))], (n, 1))


@pytest.mark.parametrize("name", MATERIALS)
def test_reflectance_is_reciprocal(name: str) -> None:
    """Single precision: 1e-3, as a narrow highlight multiplies the rounding of the phase angle's cosine."""
    rng = np.random.default_rng(0)
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in np.abs(rng.normal(size=(2, 2000, 3))) + [0, 0, 0.01])
    np.testing.assert_allclose(f(MATERIALS[name], 0.6, a, b), f(MATERIALS[name], 0.6, b, a), rtol=1e-3)


@pytest.mark.parametrize("name", MATERIALS)
def test_no_material_reflects_more_light_than_arrives(name: str) -> None:
    """A white floor reflects at most 1 of any incident light; Hapke's 1.08: H is exact to 4 %, opposition adds."""
    directions, weight = hemisphere(128)
    for angle_deg in (0.0, 30.0, 60.0, 80.0):
        reflected = (f(MATERIALS[name], 1.0, towards(angle_deg, len(weight)), directions) * weight).sum()
        assert 0.1 < reflected < (1.08 if "hapke" in name else 1.005), angle_deg


def test_a_material_without_roughness_is_lambertian() -> None:
    directions, _ = hemisphere(16)
    smooth = TerrainConfig(material="oren_nayar", roughness_deg=0.0)
    values = f(smooth, 0.3, towards(50.0, len(directions)), directions)
    np.testing.assert_allclose(values, 0.3 / np.pi, rtol=1e-6)


def test_retro_reflection_grows_with_roughness() -> None:
    """At 60 deg: A + B sin(60 deg) tan(60 deg), which Oren and Nayar give for equal directions."""
    back = towards(60.0, 1)
    away = back * [-1, 1, 1]
    rough = [TerrainConfig(material="oren_nayar", roughness_deg=sigma) for sigma in (0.0, 10.0, 20.0, 40.0)]
    ratio = [float((f(m, 0.5, back, back) / f(m, 0.5, back, away))[0]) for m in rough]
    assert ratio[0] == pytest.approx(1, abs=1e-6) and np.all(np.diff(ratio) > 0.1)
    square = np.deg2rad(20.0) ** 2
    a, b = 1 - 0.5 * square / (square + 0.33), 0.45 * square / (square + 0.09)
    expected = 0.5 / np.pi * (a + b * np.sin(np.pi / 3) * np.tan(np.pi / 3))
    assert f(rough[2], 0.5, back, back)[0] == pytest.approx(expected, rel=1e-5)


def test_grains_brighten_towards_opposition() -> None:
    incident, grains = towards(20.0, 3), TerrainConfig(material="hapke")
    outgoing = np.array([towards(angle_deg, 1)[0] for angle_deg in (20.0, 15.0, 0.0)])
    bright = f(grains, 0.2, incident, outgoing)
    assert bright[0] > 1.1 * bright[1] > 1.1 * bright[2] * 1.02


@pytest.mark.parametrize("width_deg", [10.0, 35.0])
def test_highlights_agree_with_sampled_microfacets(width_deg: float) -> None:
    """Reflectance at 30 deg, against facets sampled from GGX's distribution (Walter et al. 2007, eqs. 35 and 41)."""
    directions, weight = hemisphere(200)
    metal, incident = TerrainConfig(specular=1.0, specular_width_deg=width_deg), towards(30.0, 1)[0]
    reflected = (f(metal, 0.0, towards(30.0, len(weight)), directions) * weight).sum()
    alpha, rng = np.tan(np.deg2rad(width_deg)), np.random.default_rng(0)
    share, azimuth = rng.uniform(size=200_000), rng.uniform(0, 2 * np.pi, 200_000)
    tangent = alpha * np.sqrt(share / (1 - share))
    facet = np.stack([tangent * np.cos(azimuth), tangent * np.sin(azimuth), np.ones_like(tangent)], -1)
    facet /= np.linalg.norm(facet, axis=1, keepdims=True)
    along = facet @ incident
    out = 2 * along[:, None] * facet - incident

    def mask(cosine: np.ndarray) -> np.ndarray:
        return 2 / (1 + np.sqrt(1 + alpha**2 * (1 / cosine**2 - 1)))

    seen = (along > 0) & (out[:, 2] > 0)
    passed = along[seen] * mask(incident[2]) * mask(out[seen, 2]) / (incident[2] * facet[seen, 2])
    assert reflected == pytest.approx(passed.sum() / seen.size, abs=0.004)  # standard error 0.001 and less


def light_of(**terrain: object) -> np.ndarray:
    """Returns the green light (H, W) of a level floor of albedo 0.5 under one lamp at the camera."""
    scenario = Scenario.model_validate(
        {
            "rig": {"image_width_px": 160, "image_height_px": 120},
            "lamps": [{"position_m": (0.0, 0.075, -0.15)}],
            "water": {"jerlov": "clear"},
            "terrain": terrain,
        }
    )
    floor = generate("flat", (8.0, 8.0), 0.0, 0.0, 0.05, TextureSource(0.05), 0)
    formation = ImageFormation(scenario, illumination_of(scenario), floor, np.random.default_rng(0))
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, 2.0]))
    albedo, depth = np.full((120, 160, 3), 128, np.uint8), np.full((120, 160), 2.0, np.float32)
    parts = formation.components(RenderedView(albedo, depth, 0, StampedPose(pose, 0.0)))
    np.testing.assert_allclose(parts.total, parts.direct + parts.backscatter, rtol=1e-6)
    return parts.total[..., 1]


@pytest.mark.long
def test_the_image_of_a_smooth_rough_floor_is_that_of_lambert() -> None:
    np.testing.assert_allclose(light_of(material="oren_nayar", roughness_deg=0.0), light_of(), rtol=1e-5)


def test_the_image_has_the_reflectance_of_the_material() -> None:
    """A lamp at the camera: light returns the way it came, so the factor is A + B sin(i) tan(i)."""
    ratio = light_of(material="oren_nayar", roughness_deg=30.0) / light_of()
    focal, (v, u) = 80 / np.tan(np.pi / 6), np.mgrid[:120, :160]
    tangent = np.hypot(u - 79.5, v - 59.5) / focal
    square = np.deg2rad(30.0) ** 2
    a, b = 1 - 0.5 * square / (square + 0.33), 0.45 * square / (square + 0.09)
    np.testing.assert_allclose(ratio, a + b * tangent**2 / np.sqrt(1 + tangent**2), rtol=1e-4)


def test_a_highlight_is_where_the_floor_mirrors_the_lamp() -> None:
    """Lamp at the camera: the mirror point is straight below, at the image centre; without it the floor is darker."""
    ratio = light_of(specular=0.05, specular_width_deg=5.0) / light_of()
    assert ratio[59:61, 79:81].min() > 2 and ratio[0, 0] == pytest.approx(0.95, rel=0.01)
