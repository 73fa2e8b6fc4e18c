"""Properties of generated terrains, and of the surface between grid nodes."""

from __future__ import annotations

import pickle
from dataclasses import replace

import cv2
import numpy as np
import pytest

from twin import terrains
from twin.errors import TwinError
from twin.terrains import Terrain, TextureSource
from twin.terrains.ground_cover import COVERS, GRAINS, Cover, Painting
from twin.terrains.textures import COARSEN_TEXELS, painted_texture

KINDS = ("ripples", "fractal", "reef", "cliffs")


def floor(kind: str, seed: int = 1, size_m: tuple[float, float] = (6.0, 4.0)) -> Terrain:
    return terrains.generate(kind, size_m, 0.6, 0.15, 0.05, TextureSource(0.01), seed)


def from_heights(height_m: np.ndarray, spacing_m: float = 0.5) -> Terrain:
    texture = np.full((8, 8, 3), 90, np.uint8)
    return Terrain(np.asarray(height_m, np.float32), spacing_m, -1.0, -2.0, texture, spacing_m)


@pytest.mark.parametrize("kind", KINDS)
def test_a_generated_floor_has_exactly_the_given_base_and_relief(kind: str) -> None:
    terrain = floor(kind)
    assert terrain.lowest_m == np.float32(0.15)
    assert terrain.highest_m == np.float32(0.75)
    assert terrain.size_m == pytest.approx((6.0, 4.0))
    assert (terrain.west_m, terrain.south_m) == pytest.approx((-3.0, -2.0))
    assert terrain.texture.shape == (400, 600, 3)


def test_a_flat_floor_has_the_height_of_its_base() -> None:
    assert np.all(floor("flat").height_m == np.float32(0.15))


@pytest.mark.parametrize("kind", KINDS)
def test_a_floor_without_relief_is_flat_and_a_floor_can_have_a_single_cell(kind: str) -> None:
    assert np.all(
        terrains.generate(kind, (2.0, 1.0), 0.0, 0.15, 0.1, TextureSource(0.05), 0).height_m == np.float32(0.15)
    )
    assert np.isfinite(terrains.generate(kind, (0.1, 0.1), 0.2, 0.0, 0.1, TextureSource(0.05), 0).height_m).all()


@pytest.mark.parametrize("kind", ("flat", *KINDS))
def test_equal_seeds_give_equal_heights_and_textures(kind: str) -> None:
    one, same, other = floor(kind, 1), floor(kind, 1), floor(kind, 2)
    assert np.array_equal(one.height_m, same.height_m) and np.array_equal(one.texture, same.texture)
    assert not np.array_equal(one.texture, other.texture)


def test_a_texture_painted_later_is_that_painted_at_once_also_before_and_after_the_walls_and_in_a_copy() -> None:
    """The walls take their random numbers from the same generator, after the floor."""
    first, second = (
        terrains.generate("reef", (3.0, 2.0), 0.9, 0.0, 0.05, TextureSource(0.01, walls=True), 1) for _ in range(2)
    )
    copy = pickle.loads(pickle.dumps(first))
    at_once = painted_texture("reef", first.height_m, (200, 300), 0.01, np.random.default_rng(1).spawn(2)[1]).image
    assert first.walls is not None and second.walls is not None
    of_walls = first.walls.texture.image  # before the floor
    assert np.array_equal(first.texture, at_once) and np.array_equal(second.texture, at_once)
    assert np.array_equal(second.walls.texture.image, of_walls)
    assert np.array_equal(copy.texture, at_once) and np.array_equal(copy.walls.texture.image, of_walls)
    assert of_walls.shape == first.walls.texture.shape and at_once.shape == replace(first).colours.shape


def test_a_texture_is_painted_when_it_is_asked_for_and_once_for_all_copies_of_a_floor(monkeypatch) -> None:
    painted = []
    monkeypatch.setattr("twin.terrains.textures.Painting", lambda *given: painted.append(1) or Painting(*given))
    terrain = floor("reef")
    raised = replace(terrain, height_m=terrain.height_m + 1)
    assert not painted
    assert raised.texture is terrain.texture and len(painted) == 1


def test_parts_of_a_texture_are_those_of_the_whole_and_no_part_is_painted_twice(monkeypatch) -> None:
    terrain, whole = floor("reef", size_m=(4.0, 3.0)), floor("reef", size_m=(4.0, 3.0)).texture
    bands = []
    monkeypatch.setattr(
        "twin.terrains.ground_cover.in_row_bands", lambda work, n: bands.append(n) or work(0, n // 2) or work(n // 2, n)
    )
    part = terrain.texture_within(np.array([-1.5, 0.2]), np.array([0.5, 9.0]))  # beyond the north edge
    assert part.shape == whole.shape
    painted = part.any(axis=2)
    rows, cols = np.flatnonzero(painted.any(axis=1)), np.flatnonzero(painted.any(axis=0))
    texel_m = terrain.texture_px_m
    # rows from the north edge down to y = 0.2 m, columns from x = -1.5 to 0.5 m, and four texels more on each side
    assert (rows[0], rows[-1] + 1) == (0, round((1.5 - 0.2) / texel_m) + 4)
    assert (cols[0], cols[-1] + 1) == (round(0.5 / texel_m) - 4, round(2.5 / texel_m) + 4)
    inner = np.ix_(rows, cols)
    assert np.array_equal(part[inner], whole[inner]) and len(rows) * len(cols) < 0.4 * painted.size
    assert terrain.texture_within(np.array([-1.0, 0.3]), np.array([0.0, 1.0])) is part and len(bands) == 1
    assert np.array_equal(terrain.texture, whole) and len(bands) == 2
    assert not terrain.colours.begun._inputs  # of which nothing is left to paint
    assert terrain.texture_within(np.array([-2.0, -1.0]), np.array([2.0, 1.0])) is part and len(bands) == 2


def test_a_reef_is_steep_but_not_beyond_sixty_degrees() -> None:
    terrain = floor("reef", size_m=(9.0, 7.0))
    slope_deg = np.rad2deg(np.arctan(np.hypot(*np.gradient(terrain.height_m, terrain.spacing_m))))
    assert np.percentile(slope_deg, 99.5) <= 60.5
    assert np.percentile(slope_deg, 97) > 35.0


def test_cliffs_are_terraces_with_walls_of_one_cell() -> None:
    terrain = floor("cliffs", size_m=(9.0, 7.0))
    step_m = np.abs(np.diff(terrain.height_m, axis=1))
    walls = step_m > 0.25 * 0.6
    assert 0.005 < walls.mean() < 0.1
    assert np.percentile(step_m[~walls], 90) < 0.05 * 0.6


@pytest.mark.parametrize("kind", ("flat", *KINDS))
def test_a_texture_has_detail_at_every_scale_down_to_the_texel(kind: str) -> None:
    grey = cv2.cvtColor(floor(kind).texture, cv2.COLOR_RGB2GRAY).astype(np.float32)
    for _ in range(6):
        coarser = cv2.pyrDown(grey)
        detail = grey - cv2.pyrUp(coarser, dstsize=grey.shape[::-1])
        assert detail.std() > 4.0  # twice the read noise of the default sensor, 0.008 x 255
        grey = coarser


@pytest.mark.parametrize("cover", COVERS)
def test_a_cover_has_detail_in_the_finest_octave_of_a_wide_image(cover: str) -> None:
    """At least 3 % of the variance of the albedo lies at wavelengths of 2 to 4 pixels of a 1920 x 1080 image."""
    gsd_m = 2 * 2.0 * np.tan(np.deg2rad(30.0)) / 1920  # 2 m above the floor, 60 deg
    texture = TextureSource(gsd_m, cover=cover)
    grey = cv2.cvtColor(terrains.generate("reef", (1.2, 0.8), 0.6, 0.0, 0.05, texture, 1).texture, cv2.COLOR_RGB2GRAY)
    grey = grey.astype(np.float32)
    finest = grey - cv2.pyrUp(cv2.pyrDown(grey), dstsize=grey.shape[::-1])
    assert finest.var() > 0.03 * grey.var()


def test_every_cover_has_its_own_texture_and_the_default_is_that_of_the_kind() -> None:
    floors = {
        c: terrains.generate("reef", (1.0, 0.8), 0.6, 0.0, 0.05, TextureSource(0.005, cover=c), 1) for c in COVERS
    }
    assert len({floor.texture.tobytes() for floor in floors.values()}) == len(COVERS)
    default = terrains.generate("reef", (1.0, 0.8), 0.6, 0.0, 0.05, TextureSource(0.005), 1)
    assert np.array_equal(default.texture, floors["reef"].texture)


def test_the_material_changes_gradually() -> None:
    """Between two materials of one colour each, no step between neighbouring texels is the whole difference."""
    material = np.tile(np.linspace(32, 96, 400).astype(np.uint8), (50, 1))
    plain = [Cover(c, c, c, GRAINS, 1.0, 0.0, 0.0) for c in ((40, 40, 40), (200, 200, 200))]
    COVERS["test"] = (plain[0], plain[1], plain[1], plain[1])
    try:
        painting = Painting(material, np.full_like(material, 128), 0.005, "test", np.random.default_rng(1))
        painted = painting.within((0, *material.shape[:1], 0, material.shape[1]))
    finally:
        del COVERS["test"]
    grey = painted[..., 0].astype(int)
    assert grey[:, 0].max() == 40 and grey[:, -1].min() == 200
    assert np.abs(np.diff(grey, axis=1)).max() < 0.25 * 160


def test_texels_of_a_large_floor_are_coarser_only_by_default() -> None:
    size_m = (100.0, 50.0)
    assert TextureSource(0.001, coarsen=True).texel_m((2.0, 3.0)) == 0.001
    texel_m = TextureSource(0.001, coarsen=True).texel_m(size_m)
    assert size_m[0] * size_m[1] / texel_m**2 == pytest.approx(COARSEN_TEXELS)
    assert TextureSource(0.001).texel_m(size_m) == 0.001


def test_the_extent_is_rounded_up_to_whole_cells() -> None:
    assert terrains.generate("flat", (1.0, 0.52), 0.0, 0.0, 0.3, TextureSource(0.1), 0).size_m == pytest.approx(
        (1.2, 0.6)
    )


def test_height_is_linear_on_the_two_triangles_of_a_cell() -> None:
    terrain = from_heights([[0.0, 1.0], [2.0, 4.0]])
    x, y = -1.0 + 0.5 * np.array([0.75, 0.25, 0.5]), -2.0 + 0.5 * np.array([0.25, 0.75, 0.5])
    # south-east triangle 0 + u (1 - 0) + v (4 - 1), north-west 0 + v (2 - 0) + u (4 - 2); diagonal from 0 to 4
    assert terrain.height_at(x, y) == pytest.approx([1.5, 2.0, 2.0])


def test_height_at_the_nodes_is_the_grid_value_and_outside_it_is_nan() -> None:
    heights = np.random.default_rng(0).normal(size=(4, 5)).astype(np.float32)
    terrain = from_heights(heights)
    x, y = np.meshgrid(-1.0 + 0.5 * np.arange(5), -2.0 + 0.5 * np.arange(4))
    assert np.array_equal(terrain.height_at(x, y), heights)
    assert np.isnan(terrain.height_at([-1.01, 1.01, 0.0, 0.0, np.nan], [-1.0, -1.0, -2.01, -0.49, -1.0])).all()


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"kind": "lunar"}, "terrain.kind"),
        ({"texture": TextureSource(0.01, cover="lunar")}, "terrain.cover"),
        ({"grid_m": 0.0011}, "terrain.grid_m"),
        ({"texture": TextureSource(0.0001)}, "terrain.texture_px_m"),
    ],
)
def test_an_invalid_terrain_is_rejected_with_its_scenario_key(change: dict[str, object], field: str) -> None:
    valid = dict(
        kind="flat", size_m=(6.0, 4.0), relief_m=0.1, base_m=0.0, grid_m=0.1, texture=TextureSource(0.01), seed=0
    )
    with pytest.raises(TwinError) as caught:
        terrains.generate(**(valid | change))  # pyright: ignore[reportArgumentType]
    assert caught.value.field == field and caught.value.allowed
