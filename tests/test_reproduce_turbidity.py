"""Turbidity experiment: relative contrast, results and figure, geometry of the block."""

import json

import cv2
import numpy as np
import pytest

from twin.imaging.light.illumination import illumination_of
from twin.reproduce.experiment_floors import BLOCK_M, CORE_M, HEIGHT_M, block_on_sand
from twin.reproduce.turbidity import SETTINGS, relative_contrast, render_levels, table, write
from twin.scenario.file import load_scenario

pytestmark = pytest.mark.long

SMALL = ("rig.image_width_px=160", "rig.image_height_px=120")
RANGES_M = np.array([0.5, 1.0, 2.0, 4.0])


def contrast_at(turbidity, *settings):
    scenario = load_scenario("reef", [*SETTINGS, f"water.turbidity={turbidity}", *settings])
    return relative_contrast(scenario, illumination_of(scenario), RANGES_M)


def test_relative_contrast_is_one_in_clear_water_and_decreases_with_range_and_turbidity():
    np.testing.assert_array_equal(contrast_at(0.0), 1.0)
    thin, thick = contrast_at(1.0), contrast_at(4.0)
    assert (np.diff(thin, axis=0) < 0).all() and (thick < thin).all()


def test_without_backscatter_relative_contrast_is_the_fraction_of_unscattered_light():
    """With a mean cosine near one all scattering is forward: C / C0 = exp(-b r)."""
    forward = "water.phase_function=henyey_greenstein", "water.mean_cosine=0.99"
    contrast = contrast_at(1.0, *forward)[:3]  # beyond, red is so dark that the little backscatter matters
    scattering = illumination_of(load_scenario("reef", SETTINGS)).water.scattering_per_m
    # some light is scattered by more than 15 deg, and some is backscatter: both within 3 %
    np.testing.assert_allclose(contrast, np.exp(-scattering * RANGES_M[:3, None]), rtol=0.03)


def test_results_and_figure_of_all_levels_are_written(tmp_path):
    levels = render_levels((0.0, 4.0), SMALL, ranges_m=np.array([0.5, 1.0, 3.0, 8.0]))
    results = write(levels, tmp_path / "below")
    figure = cv2.imread(str(tmp_path / "below" / "turbidity.png"))
    assert figure is not None and figure.shape[1] > 500
    assert json.loads((tmp_path / "below" / "turbidity.json").read_text()) == results
    clear, murky = results["levels"]
    assert clear["veil_share"] == [0, 0, 0] and min(murky["veil_share"]) > 0.03
    assert murky["contrast"][1] < 0.6 * clear["contrast"][1] and murky["texture_snr"][1] < clear["texture_snr"][1]
    assert clear["visibility_m"] is None and 0.5 < murky["visibility_m"] < 8.0
    assert [row[0] for row in table(results)] == ["turbidity", "0", "4"]


def test_block_and_cores_have_their_nominal_size_and_centre():
    floor = block_on_sand(1)
    top = (floor.height_m > HEIGHT_M - 0.02).sum() * floor.spacing_m**2
    assert top == pytest.approx(BLOCK_M[0] * BLOCK_M[1] - 2 * CORE_M[0] * CORE_M[1], rel=0.03)
    assert abs(floor.height_m[floor.height_m < HEIGHT_M / 2]).max() < 0.05
    rows, cols = np.nonzero(floor.height_m > HEIGHT_M - 0.02)
    centre = floor.west_m + cols.mean() * floor.spacing_m, floor.south_m + rows.mean() * floor.spacing_m
    assert centre == pytest.approx((0, 0), abs=0.005)
