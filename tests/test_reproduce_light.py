"""The light model compared with the reference: agreement where the model is exact, files, and the command."""

import csv
import json

import cv2
import pytest
from typer.testing import CliRunner

from twin.cli import app
from twin.imaging.reference.pixel_light import Effort
from twin.reproduce.lamp_comparison import (
    LAMP_ARRANGEMENTS,
    PIXELS,
    lamp_cells,
    lamp_table,
    model_light,
    reference_light,
)  # fmt: skip
from twin.reproduce.light import LightComparison
from twin.scenario.file import load_scenario

FEW = ("IB",), ("leds",), (1.0,), PIXELS[:1]


@pytest.mark.parametrize("lamps", LAMP_ARRANGEMENTS)
def test_in_water_that_only_absorbs_model_and_reference_agree(lamps):
    """The model's beam table and its normals are coarse: 0.5 %."""
    scenario = load_scenario("reef", ["water.jerlov=II", "water.turbidity=0", *LAMP_ARRANGEMENTS[lamps]])
    for pixel in ((160, 120), (250, 30)):
        model = model_light(scenario, 1.5, pixel)
        truth = reference_light(scenario, 1.5, pixel, Effort(64, 2))
        assert model["veil"] == 0 and model["sharp_share"] == 1
        assert model["total"] == pytest.approx(truth.total.value, rel=5e-3)


def test_the_light_scattered_once_is_that_of_single_scattering():
    cell = next(iter(lamp_cells(FEW, 640)))
    truth = {name: one.truth.value for name, one in cell.light.items()}
    single = load_scenario("reef", ["water.jerlov=IB", "imaging.scattering=single"])
    model = model_light(single, 1.0, (cell.conditions["column_px"], cell.conditions["row_px"]))
    assert truth["veil_once"] == pytest.approx(model["veil"], rel=0.02)
    assert truth["direct"] == pytest.approx(model["direct"], rel=5e-3)
    assert model["total"] < truth["total"] and truth["sharp_share"] < model["sharp_share"]
    assert model["blurred"] == 0


@pytest.mark.parametrize(("water", "height_m", "fit"), [("IB", 3.0, "spots"), ("II", 2.0, "leds"), ("3C", 1.0, "leds")])
def test_the_light_model_agrees_with_the_reference(water, height_m, fit):
    """At the centre and in the corner: 8 % of all light and 10 % of the veil, plus 3 standard errors of 2000 walks."""
    limits = {
        "total": (0.08, 0),
        "veil": (0.10, 0),
        "sharp_share": (0, 0.04),
        "blur_near": (0.25, 0),
        "blur_far": (0.25, 0),
    }
    for cell in lamp_cells(((water,), (fit,), (height_m,), PIXELS[::2]), 2000):
        for name, (share, more) in limits.items():
            model, truth = cell.light[name][:2]
            assert model == pytest.approx(truth.value, abs=share * truth.value + more + 3 * truth.standard_error), name


@pytest.mark.long
def test_table_and_files_hold_all_cells(tmp_path):
    found = list(lamp_cells((*FEW[:3], PIXELS[:2]), 640, "petzold"))
    summary = LightComparison(found, [], []).write(tmp_path / "light")
    assert json.loads((tmp_path / "light" / "light.json").read_text()) | {"relief": [], "daylight": []} == summary
    with (tmp_path / "light" / "light.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["total_truth_cd_m2"]) for row in rows] == [cell.light["total"].truth.value for cell in found]
    picture = cv2.imread(str(tmp_path / "light" / "light.png"))
    assert picture is not None and picture.shape[1] > 1000
    assert len({len(row) for row in lamp_table(found)}) == 1 and lamp_table(found)[1][0] == "IB 1 m"


def test_the_command_refuses_an_unknown_phase_function():
    result = CliRunner().invoke(app, ["reproduce", "light", "--phase", "mie"])
    assert result.exit_code != 0 and "water.phase_function" in str(result.exception)
