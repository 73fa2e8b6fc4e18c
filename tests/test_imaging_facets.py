"""Shading by facets: stored normals, the facet of each pixel against ray casting, and the light of a tilted plane."""

from __future__ import annotations

import types
from typing import NamedTuple

import numpy as np
import pytest

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.height_field import cast_pixels, height_field
from twin.imaging.image_formation import ImageFormation, RenderedView, StampedPose
from twin.imaging.light.illumination import illumination_of
from twin.imaging.scene.facets import UNIT, Facets
from twin.scenario.model import Scenario
from twin.terrains import Terrain

SCENARIO = Scenario.model_validate(
    {
        "rig": {"image_width_px": 160, "image_height_px": 120},
        "lamps": [{"position_m": (0.2, 0.5, 0.0), "beam": ((0.0, 1.0), (90.0, 1.0)), "intensity_cd": 1000.0}],
        "water": {"jerlov": "clear"},
        "imaging": {"shadows": False},
    }
)
RIG = SCENARIO.believed_rig()
TILTED = geometry.rotation_from_rpy(0.1, -0.15, 2.0) @ geometry.BODY_FROM_DOWN_CAMERA


def rough(spacing_m: float, sigma_m: float, west_m: float = 0.0) -> Terrain:
    """Returns a floor of 6 m by 5 m with independent heights, so that neighbouring facets have nothing in common."""
    rows, cols = round(5 / spacing_m) + 1, round(6 / spacing_m) + 1
    height = np.random.default_rng(3).normal(scale=sigma_m, size=(rows, cols)).astype(np.float32)
    return Terrain(height, spacing_m, west_m - 3.0, -2.5, np.zeros((2, 2, 3), np.uint8), 1.0)


def facet_at(floor: Terrain, points: Array) -> Array:
    """Returns the unit normals (n, 3) of the triangles under points (n, 3)."""
    step, (x, y) = 1e-6, points[:, :2].T
    east = (floor.height_at(x + step, y) - floor.height_at(x - step, y)) / (2 * step)
    north = (floor.height_at(x, y + step) - floor.height_at(x, y - step)) / (2 * step)
    normal = np.stack([-east, -north, np.ones_like(east)], -1)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


class Shading(NamedTuple):
    """Green light of n pixels of a white floor under a lamp.

    Args:
        rendered: (n,) light of the image.
        of_rays: (n, m) light of the facets that m rays through each pixel meet; the first ray is that of the centre.
        one_facet: (n,) whether all rays of the pixel meet the same facet.
    """

    rendered: Array
    of_rays: Array
    one_facet: Array


def shading(floor: Terrain, pose: Array, side: int) -> Shading:
    """Returns the light of the pixels that show the floor with all of their side x side + 1 rays."""
    pixels = np.stack(np.meshgrid(np.arange(RIG.width_px), np.arange(RIG.height_px)), -1).reshape(-1, 2)
    within = np.stack(np.meshgrid(*[(np.arange(side) + 0.5) / side - 0.5] * 2), -1).reshape(-1, 2)
    at = (pixels[:, None] + np.vstack([[[0.0, 0.0]], within])).reshape(-1, 2)
    field = height_field(floor.height_m, floor.spacing_m, floor.west_m, floor.south_m)
    depth = cast_pixels(field, pose[None], RIG, at)[0]
    image = depth.reshape(len(pixels), -1)[:, 0].reshape(RIG.height_px, RIG.width_px).astype(np.float32)
    formation = ImageFormation(SCENARIO, illumination_of(SCENARIO), floor, np.random.default_rng(0))
    light = formation.radiance(
        RenderedView(np.full((*image.shape, 3), 255, np.uint8), image, 0, StampedPose(pose, 0.0))
    )[..., 1]
    points = geometry.transform(pose, np.column_stack([RIG.normalised(at), np.ones(len(at))]) * depth[:, None])
    lamp = pose @ geometry.inverse(RIG.body_from_camera) @ [*SCENARIO.lamps[0].position_m, 1.0]
    to = lamp[:3] - points
    distance = np.linalg.norm(to, axis=1)
    normals = facet_at(floor, points)
    of_rays = (1000 / np.pi * np.maximum((normals * to).sum(1), 0) / distance**3).reshape(len(pixels), -1)
    spread = np.ptp(normals.reshape(len(pixels), -1, 3), axis=1).max(axis=1)
    seen = np.isfinite(of_rays).all(axis=1)
    return Shading(light.ravel()[seen], of_rays[seen], spread[seen] < 1e-4)


@pytest.mark.parametrize("rise", [0.0, 0.3, 3.0, 100.0])
def test_stored_normals_are_exact_to_a_few_thousandths_of_a_degree(rise: float) -> None:
    floor = types.SimpleNamespace(height_m=np.array([[0, rise], [-rise, rise / 2]]), spacing_m=1.0, west_m=0, south_m=0)
    stored = Facets(floor).seen_from(np.eye(4)).normals[0, 0]
    a, b = (stored >> 16) / UNIT, ((stored << 16) >> 16) / UNIT
    decoded = np.stack([2 * a, 2 * b, 1 - a**2 - b**2], -1) / (1 + a**2 + b**2)[:, None]
    exact = np.array([[-rise, rise / 2, 1.0], [-1.5 * rise, rise, 1.0]])
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    assert np.rad2deg(np.linalg.norm(decoded - exact, axis=1)).max() < 0.004


@pytest.mark.parametrize("west_m", [0.0, 900.0])
def test_a_pixel_within_a_facet_is_shaded_by_the_facet_that_its_ray_meets(west_m: float) -> None:
    """Slopes to 70 deg: of the pixels that show a single facet, less than 0.2 % are off by 10 %."""
    pose = geometry.pose(TILTED, np.array([west_m + 0.2, 0.1, 2.2]))
    found = shading(rough(0.12, 0.18, west_m), pose, 8)
    light, truth = found.rendered[found.one_facet], found.of_rays[found.one_facet, 0]
    assert np.mean(np.abs(light - truth) > 0.1 * truth + 1e-3) < 2e-3
    assert np.mean(truth == 0) > 0.001, "no facet is turned away from the lamp"
    assert 0.2 < found.one_facet.mean() < 0.9


def test_a_pixel_with_several_facets_shows_the_mean_light_of_its_area() -> None:
    """Against 8 x 8 rays per pixel: errors of 1.4 %, with a single ray per pixel 5.7 %."""
    pose = geometry.pose(TILTED, np.array([0.2, 0.1, 2.2]))
    found = shading(rough(0.08, 0.02), pose, 8)
    several = ~found.one_facet
    area = found.of_rays[several, 1:].mean(axis=1)
    error, of_one_ray = (light[several] / area - 1 for light in (found.rendered, found.of_rays[:, 0]))
    assert several.mean() > 0.3
    assert error.std() < of_one_ray.std() / 3
    assert abs(error.mean()) < 0.003


def test_the_image_may_extend_beyond_the_floor() -> None:
    """The camera is over the floor's corner: pixels without floor are dark, the others exact."""
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([2.9, 2.4, 2.2]))
    light, rays, _ = shading(rough(0.04, 0.002), pose, 4)
    truth = rays[:, 1:].mean(axis=1)
    assert 0.2 < light.size / (RIG.width_px * RIG.height_px) < 0.6
    assert np.mean(np.abs(light - truth) > 0.1 * truth) < 2e-3
