"""The light model beside the reference: agreement where the model is exact, files, and the command."""

import csv
import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from twin.cli import app
from twin.imaging.illumination import illumination_of
from twin.imaging.phase_function import henyey_greenstein
from twin.imaging.reference.pixel_light import Effort
from twin.reproduce.light import (
    LAMP_FITS,
    PIXELS,
    Selection,
    blur_share,
    cells,
    model_light,
    reference_light,
    table,
    write,
)
from twin.scenario.file import load_scenario

FEW = Selection(("IB",), (1.0,), ("leds",), PIXELS[:1])


@pytest.mark.parametrize("fit", LAMP_FITS)
def test_in_water_that_only_absorbs_model_and_reference_agree(fit):
    """The model's beam table and its normals are coarse: 0.5 %."""
    scenario = load_scenario("quickstart", ["water.jerlov=II", "water.turbidity=0", *LAMP_FITS[fit]])
    for pixel in ((160, 120), (250, 30)):
        model = model_light(scenario, 1.5, pixel)
        truth = reference_light(scenario, 1.5, pixel, Effort(64, 2), henyey_greenstein(0.9))
        assert model.veil == 0 and model.sharp_share == 1
        assert model.total == pytest.approx(truth.total.value, rel=5e-3)


def test_the_light_scattered_once_is_the_veil_of_the_model():
    cell = next(iter(cells(FEW, 640)))
    assert cell.veil_once.value == pytest.approx(cell.model.veil, rel=0.02)
    assert cell.direct.value == pytest.approx(cell.model.direct, rel=5e-3)
    assert cell.model.total < cell.total.value and cell.sharp_share.value < cell.model.sharp_share


def test_the_kernel_of_the_model_is_a_gaussian_of_unit_weight():
    scenario = load_scenario("quickstart", ["water.jerlov=II"])
    water, rig = illumination_of(scenario).water, scenario.believed_rig()
    shares = [blur_share(rig, water, 2.0, radius) for radius in (0.0, 5.0, 20.0, 1e4)]
    assert shares[0] == 0 and shares[-1] == 1 and (np.diff(shares) > 0).all()
    inner = blur_share(rig, water, 2.0, 1e-3) / 1e-6
    assert 1 - shares[2] == pytest.approx(np.exp(-inner * 20.0**2), rel=1e-6)


def test_table_and_files_hold_all_cells(tmp_path):
    found = list(cells(FEW._replace(pixels=PIXELS[:2]), 640, "sea"))
    summary = write(found, tmp_path / "light")
    assert json.loads((tmp_path / "light" / "light.json").read_text()) == summary
    with (tmp_path / "light" / "light.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["total_truth_cd_m2"]) for row in rows] == [cell.total.value for cell in found]
    picture = cv2.imread(str(tmp_path / "light" / "light.png"))
    assert picture is not None and picture.shape[1] > 1000
    assert len({len(row) for row in table(found)}) == 1 and table(found)[1][0] == "IB 1 m"


def test_the_command_refuses_an_unknown_phase_function():
    result = CliRunner().invoke(app, ["reproduce", "light", "--phase", "mie"])
    assert result.exit_code != 0 and "--phase" in str(result.exception)
