"""The turbidity ladder: contrast by its formula, a sheet that can be read, a block that stands where it should."""

import json

import cv2
import numpy as np
import pytest

from twin.reproduce import turbidity, turbidity_sheet
from twin.reproduce.block import BLOCK_M, CORE_M, HEIGHT_M, block_on_sand
from twin.reproduce.turbidity import SETTINGS, climb, contrast_left, table, write
from twin.scenario.file import load_scenario

SMALL = ("rig.image_width_px=160", "rig.image_height_px=120")
RANGES_M = np.array([0.5, 1.0, 2.0, 4.0])


def left_in(level, *settings):
    scenario = load_scenario("quickstart", [*SETTINGS, f"water.turbidity={level}", *settings])
    return contrast_left(scenario, RANGES_M)


def test_contrast_is_whole_in_clear_water_and_falls_with_range_and_turbidity():
    np.testing.assert_array_equal(left_in(0.0), 1.0)
    thin, thick = left_in(1.0), left_in(4.0)
    assert (np.diff(thin, axis=0) < 0).all() and (thick < thin).all()


def test_without_backscatter_contrast_is_what_was_never_scattered_forward():
    """A g near one scatters everything forward: C / C0 = exp(-b_f r), with b_f all of b."""
    got = left_in(1.0, "water.mean_cosine=0.99")[:3]  # farther off, red is so dark that the little veil counts
    scattering = np.array([0.2498, 0.3580, 0.5236])
    # a little goes beyond 15 deg, and the little that comes back is veil: both within 3 %
    np.testing.assert_allclose(got, np.exp(-scattering * RANGES_M[:3, None]), rtol=0.03)


def test_the_ladder_is_climbed_and_drawn(tmp_path, monkeypatch):
    for module in (turbidity, turbidity_sheet):
        monkeypatch.setattr(module, "RANGES_M", np.array([0.5, 1.0, 3.0, 8.0]))
    levels = climb((0.0, 4.0), SMALL)
    told = write(levels, tmp_path / "below")
    picture = cv2.imread(str(tmp_path / "below" / "turbidity.png"))
    assert picture is not None and picture.shape[1] > 500
    assert json.loads((tmp_path / "below" / "turbidity.json").read_text()) == told
    clear, murky = told["levels"]
    assert clear["veil_share"] == [0, 0, 0] and min(murky["veil_share"]) > 0.03
    assert murky["contrast"][1] < 0.6 * clear["contrast"][1] and murky["texture_snr"][1] < clear["texture_snr"][1]
    assert clear["sight_m"] is None and 0.5 < murky["sight_m"] < 8.0
    assert [row[0] for row in table(told)] == ["turbidity", "0", "4"]


def test_the_block_has_its_size_and_its_cores():
    floor = block_on_sand(1)
    top = (floor.height_m > HEIGHT_M - 0.02).sum() * floor.spacing_m**2
    assert top == pytest.approx(BLOCK_M[0] * BLOCK_M[1] - 2 * CORE_M[0] * CORE_M[1], rel=0.03)
    assert abs(floor.height_m[floor.height_m < HEIGHT_M / 2]).max() < 0.05
    rows, cols = np.nonzero(floor.height_m > HEIGHT_M - 0.02)
    centre = floor.west_m + cols.mean() * floor.spacing_m, floor.south_m + rows.mean() * floor.spacing_m
    assert centre == pytest.approx((0, 0), abs=0.005)
