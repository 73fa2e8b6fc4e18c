"""Textures from photos: no repetition, no seams, even lighting; orthophotos in the right place."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import rasterio.shutil
from rasterio.enums import ColorInterp
from rasterio.transform import Affine
from rasterio.warp import transform

from twin import terrains
from twin.errors import TwinError
from twin.terrains.quilting import even_lighting, quilt
from twin.terrains.textures import texture_from_photo, tile_image

CRS = "EPSG:32755"
WEST, NORTH = 330_000.0, 8_370_000.0


@pytest.fixture(scope="module")
def pebbles() -> np.ndarray:
    """Photo (200, 200, 3) of blobs about 6 px wide with a gradient of brightness from left to right."""
    rng = np.random.default_rng(3)
    spectrum = np.fft.rfft2(rng.standard_normal((200, 200)))
    frequency = np.hypot(np.fft.fftfreq(200)[:, None], np.fft.rfftfreq(200)[None])
    blobs = np.fft.irfft2(spectrum * np.exp(-((frequency / 0.08) ** 2)), (200, 200))
    grey = (120 + 40 * blobs / blobs.std()) * np.linspace(0.7, 1.3, 200)
    return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def largest_correlation(texture: np.ndarray, beyond_px: int) -> float:
    """Returns the largest autocorrelation of the first band at any shift beyond `beyond_px` along both axes."""
    grey = texture[..., 0] - texture[..., 0].mean()
    power = np.abs(np.fft.rfft2(grey)) ** 2
    correlation = np.fft.irfft2(power, grey.shape)
    shift = [np.minimum(np.arange(n), n - np.arange(n)) for n in grey.shape]
    far = np.maximum(shift[0][:, None], shift[1][None]) > beyond_px
    return float(correlation[far].max() / correlation[0, 0])


def test_a_quilted_texture_does_not_repeat(pebbles: np.ndarray) -> None:
    even = even_lighting(pebbles)
    quilted = quilt(even, (1000, 1200), np.random.default_rng(1))
    assert largest_correlation(quilted, 40) < 0.1
    assert largest_correlation(tile_image(even, 1.0, (1000, 1200), (1200.0, 1000.0)), 40) > 0.9


def test_a_quilted_texture_has_the_grey_levels_and_steps_of_the_photo(pebbles: np.ndarray) -> None:
    even = even_lighting(pebbles)
    quilted = quilt(even, (800, 800), np.random.default_rng(1)).astype(float)
    assert np.mean(quilted) == pytest.approx(even.mean(), rel=0.03)
    assert np.std(quilted) == pytest.approx(even.std(), rel=0.1)
    for axis in (0, 1):  # seams would be larger steps between neighbouring pixels
        steps, expected = np.abs(np.diff(quilted, axis=axis)), np.abs(np.diff(even.astype(float), axis=axis))
        assert np.percentile(steps, 99.9) < 1.25 * np.percentile(expected, 99.9)


def test_even_lighting_removes_a_gradient(pebbles: np.ndarray) -> None:
    def sides(image: np.ndarray) -> float:
        return float(image[:, :100].mean() / image[:, 100:].mean())

    assert sides(pebbles) < 0.8 and 0.95 < sides(even_lighting(pebbles)) < 1.05
    black = np.zeros((50, 50, 3), np.uint8)
    assert np.array_equal(even_lighting(black), black)


def test_even_lighting_of_a_large_photo_takes_little_memory_and_removes_its_gradient() -> None:
    grains = np.random.default_rng(4).integers(0, 40, (1500, 2000, 1), np.uint8)
    photo = np.repeat(np.linspace(60, 180, 2000).astype(np.uint8)[None, :, None] + grains, 3, axis=2)
    tracemalloc.start()
    even = even_lighting(photo)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5 * photo.nbytes  # the result takes once that of the photo; a fit to all pixels takes 31 times
    assert np.ptp(even.reshape(1500, 8, 250, 3).mean(axis=(0, 2, 3))) < 2.0


@pytest.mark.parametrize("size_m", ((2.0, 2.0), (4.0, 4.0)))
def test_pebbles_of_a_photo_have_the_same_size_on_a_floor_with_coarser_texels(
    pebbles: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size_m: tuple[float, float]
) -> None:
    """The distance at which the autocorrelation falls to one half is that of the photo: 4 mm per pixel."""
    monkeypatch.setattr("twin.terrains.textures.COARSEN_TEXELS", 250_000)
    photo = tmp_path / "photo.png"
    cv2.imwrite(str(photo), pebbles)
    source = terrains.TextureSource(0.004, photo, coarsen=True)
    texel_m = source.texel_m(size_m)
    assert texel_m == (0.004 if size_m[0] == 2.0 else 0.008)
    texture = texture_from_photo(source, (round(size_m[1] / texel_m), round(size_m[0] / texel_m)), size_m)
    expected_m = 0.004 * half_width_px(even_lighting(pebbles))
    assert texel_m * half_width_px(texture) == pytest.approx(expected_m, rel=0.15)  # averaging over 8 mm adds 10 %


def half_width_px(texture: np.ndarray) -> float:
    """Returns the shift along the rows at which the autocorrelation of the first band falls to one half [px]."""
    grey = texture[..., 0] - texture[..., 0].mean()
    correlation = np.fft.irfft2(np.abs(np.fft.rfft2(grey)) ** 2, grey.shape)[0]
    correlation = correlation / correlation[0]
    k = int(np.argmax(correlation < 0.5))
    return k - (0.5 - correlation[k]) / (correlation[k - 1] - correlation[k])


def test_the_texture_of_a_photo_is_the_same_for_every_seed(pebbles: np.ndarray, tmp_path: Path) -> None:
    photo, dem = tmp_path / "photo.png", tmp_path / "dem.npy"
    with rasterio.open(photo, "w", driver="PNG", count=3, height=200, width=200, dtype="uint8") as target:
        target.write(np.moveaxis(pebbles, 2, 0))
    np.save(dem, np.zeros((9, 9)))
    first, second = (terrains.load(dem, terrains.TextureSource(0.01, photo), 0.5, 1.0, seed) for seed in (1, 2))
    assert np.array_equal(first.texture, second.texture)
    repeated = terrains.load(dem, terrains.TextureSource(0.01, photo, "repeat"), 0.5, 1.0, 1)
    assert np.array_equal(repeated.texture[:200, :200], repeated.texture[200:, 200:])


def write(
    file: Path, bands: np.ndarray, west: float, north: float, pixel: float, crs: str | None, **options: int
) -> Path:
    with rasterio.open(
        file, "w", driver="GTiff", count=bands.shape[0], height=bands.shape[1], width=bands.shape[2],
        dtype=bands.dtype, crs=crs, transform=Affine(pixel, 0.0, west, 0.0, -pixel, north), **options,
    ) as target:  # fmt: skip
        target.write(bands)
    return file


@pytest.fixture
def dem(tmp_path: Path) -> Path:
    """A level DEM: 41 x 31 heights, 0.25 m apart; its outermost nodes span 10 m x 7.5 m."""
    return write(tmp_path / "dem.tif", np.zeros((1, 31, 41), np.float32), WEST, NORTH, 0.25, CRS)


def target_position(terrain: terrains.Terrain) -> tuple[float, float]:
    """Returns easting and northing of the centre of the bright texels."""
    rows, cols = np.nonzero(terrain.texture[..., 0] > 200)
    assert terrain.georeference is not None
    x = terrain.west_m + (cols.mean() + 0.5) * terrain.texture_px_m
    y = terrain.north_m - (rows.mean() + 0.5) * terrain.texture_px_m
    easting, northing = terrain.georeference.from_scene(x, y)
    return float(easting), float(northing)


@pytest.mark.parametrize("crs", (CRS, "EPSG:32756", None))
def test_an_orthophoto_lies_where_its_coordinates_say(dem: Path, tmp_path: Path, crs: str | None) -> None:
    mark = (WEST + 3.0, NORTH - 2.0)  # a bright disc on a dark orthophoto
    east, north = (float(v[0]) for v in transform(CRS, crs or CRS, [mark[0]], [mark[1]]))
    pixel, half = 0.02, 600
    row, col = np.indices((2 * half, 2 * half)) + 0.5
    disc = np.hypot(row - half, col - half) * pixel < 0.3
    bands = np.where(disc, 250, 20).astype(np.uint8)[None].repeat(3, axis=0)
    file = write(tmp_path / "ortho.tif", bands, east - half * pixel, north + half * pixel, pixel, crs)
    terrain = terrains.load(dem, terrains.TextureSource(0.02, orthophoto_file=file), 1.0, 1.0, 0)
    assert terrain.orthophoto_share == 1.0
    assert target_position(terrain) == pytest.approx(mark, abs=0.01)


def coloured_photo() -> np.ndarray:
    """Returns bands R, G, B (3, 375, 500) that cover the DEM: each is a ramp or a step of its own."""
    row, col = np.indices((375, 500))
    return np.stack([col // 2, row // 2, np.where(row < 100, 250, 10)]).astype(np.uint8)


@pytest.mark.parametrize("form", ("rgba", "bgr", "south_up", "east_to_west"))
def test_alpha_order_of_the_bands_and_direction_of_the_rows_of_an_orthophoto_are_respected(
    dem: Path, tmp_path: Path, form: str
) -> None:
    bands = coloured_photo()
    plain = write(tmp_path / "plain.tif", bands, WEST, NORTH, 0.02, CRS)
    grid = Affine(0.02, 0.0, WEST, 0.0, -0.02, NORTH)
    marks = [ColorInterp.red, ColorInterp.green, ColorInterp.blue]
    if form == "rgba":
        bands, marks = np.concatenate([bands, np.full_like(bands[:1], 255)]), [*marks, ColorInterp.alpha]
        bands[3, :, 250:] = 0
    if form == "bgr":
        bands, marks = bands[::-1], marks[::-1]
    if form == "south_up":
        bands, grid = bands[:, ::-1], Affine(0.02, 0.0, WEST, 0.0, 0.02, NORTH - 375 * 0.02)
    if form == "east_to_west":
        bands, grid = bands[:, :, ::-1], Affine(-0.02, 0.0, WEST + 10.0, 0.0, -0.02, NORTH)
    file = tmp_path / "ortho.tif"
    with rasterio.open(
        file, "w", driver="GTiff", count=len(bands), height=375, width=500, dtype="uint8", crs=CRS, transform=grid
    ) as target:
        target.write(bands)
        target.colorinterp = marks
    found, expected, bare = (
        terrains.load(dem, terrains.TextureSource(0.02, orthophoto_file=photo), 1.0, 1.0, 0)
        for photo in (file, plain, None)
    )
    if form == "rgba":  # the eastern half of the photo is transparent; its first column lies at the edge
        west, east = slice(0, 240), slice(260, None)
        assert np.array_equal(found.texture[:, east], bare.texture[:, east])
        assert np.array_equal(found.texture[:, west], expected.texture[:, west])
        assert found.orthophoto_share == pytest.approx(0.5, abs=0.02)
    else:
        assert np.array_equal(found.texture, expected.texture)


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_a_photo_of_fewer_bits_in_16_keeps_its_brightness(dem: Path, tmp_path: Path, bits: int) -> None:
    eight = coloured_photo()
    bands = np.rint(eight * ((2**bits - 1) / 255)).astype(np.uint16)
    for name, option in (("plain", {}), ("stated", {"NBITS": bits})):
        file = write(tmp_path / f"{name}.tif", bands, WEST, NORTH, 0.02, CRS, **option)
        terrain = terrains.load(dem, terrains.TextureSource(0.02, orthophoto_file=file), 1.0, 1.0, 0)
        plain = write(tmp_path / "8.tif", eight, WEST, NORTH, 0.02, CRS)
        expected = terrains.load(dem, terrains.TextureSource(0.02, orthophoto_file=plain), 1.0, 1.0, 0)
        np.testing.assert_allclose(terrain.texture, expected.texture, atol=1)
    textures = []
    for values in (bands, eight):
        cv2.imwrite(str(tmp_path / "photo.png"), np.moveaxis(values, 0, 2))
        textures.append(texture_from_photo(terrains.TextureSource(0.02, tmp_path / "photo.png"), (50, 60), (1.2, 1.0)))
    np.testing.assert_array_equal(*textures)


def test_an_orthophoto_with_a_palette_is_rejected(dem: Path, tmp_path: Path) -> None:
    file = write(tmp_path / "ortho.tif", np.zeros((1, 9, 9), np.uint8), WEST, NORTH, 0.1, CRS)
    with rasterio.open(file, "r+") as target:
        target.colorinterp = [ColorInterp.palette]
        target.write_colormap(1, {0: (200, 100, 50, 255)})
    with pytest.raises(TwinError, match="palette") as caught:
        terrains.load(dem, terrains.TextureSource(0.02, orthophoto_file=file), 1.0, 1.0, 0)
    assert caught.value.field == "terrain.orthophoto_file"


def test_texels_beyond_an_orthophoto_keep_the_other_texture(dem: Path, tmp_path: Path) -> None:
    white = np.full((3, 100, 100), 255, np.uint8)
    file = write(tmp_path / "ortho.tif", white, WEST, NORTH, 0.02, CRS)
    with_photo = terrains.load(dem, terrains.TextureSource(0.02, orthophoto_file=file), 1.0, 1.0, 0)
    without = terrains.load(dem, terrains.TextureSource(0.02), 1.0, 1.0, 0)
    covered = (with_photo.texture == 255).all(axis=2)
    assert with_photo.orthophoto_share == pytest.approx(covered.mean(), abs=1e-3)
    assert 0.03 < covered.mean() < 0.06 and covered[:50, :50].all()
    assert np.array_equal(with_photo.texture[~covered], without.texture[~covered])


@pytest.mark.parametrize(
    ("bands", "west", "crs", "problem"),
    (
        (np.zeros((3, 9, 9), np.uint8), WEST + 50, CRS, "does not overlap the DEM"),
        (np.zeros((3, 9, 9), np.float32), WEST, CRS, "is not an orthophoto: 3 band(s) of float32"),
        (np.zeros((2, 9, 9), np.uint8), WEST, CRS, "is not an orthophoto: 2 band(s) of uint8"),
    ),
)
def test_an_unusable_orthophoto_is_rejected(
    dem: Path, tmp_path: Path, bands: np.ndarray, west: float, crs: str, problem: str
) -> None:
    file = write(tmp_path / "ortho.tif", bands, west, NORTH, 0.1, crs)
    with pytest.raises(TwinError) as caught:
        terrains.load(dem, terrains.TextureSource(0.02, orthophoto_file=file), 1.0, 1.0, 0)
    assert caught.value.field == "terrain.orthophoto_file" and problem in str(caught.value)


def test_an_orthophoto_without_coordinates_or_on_a_floor_without_them_is_rejected(dem: Path, tmp_path: Path) -> None:
    plain = tmp_path / "plain.png"
    with rasterio.open(plain, "w", driver="PNG", count=3, height=9, width=9, dtype="uint8") as target:
        target.write(np.zeros((3, 9, 9), np.uint8))
    unplaced = tmp_path / "plain.tif"
    rasterio.shutil.copy(plain, unplaced, driver="GTiff")
    heights = tmp_path / "dem.npy"
    np.save(heights, np.zeros((9, 9)))
    missing = tmp_path / "none.tif"
    for floor, photo, problem in (
        (dem, plain, "is not a file of the format GTiff"),
        (dem, unplaced, "has no coordinates"),
        (heights, plain, "the DEM has no coordinates"),
        (dem, missing, "no such file"),
    ):
        with pytest.raises(TwinError, match="orthophoto_file") as caught:
            terrains.load(floor, terrains.TextureSource(0.02, orthophoto_file=photo), 0.5, 1.0, 0)
        assert problem in str(caught.value)
