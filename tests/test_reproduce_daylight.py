"""The daylight of the light model beside the reference: cells agree, table and file hold them."""

import csv

import pytest

from twin.reproduce.daylight import DaylightSelection, daylight_cells, daylight_table, write_daylight

FEW = DaylightSelection(("IB",), (4.0,), (2.0,), (45.0,))


def test_a_cell_agrees_with_the_reference():
    """Slopes by a quadratic form: 3 %; level illuminance and Lu/Ed: 2 % and 3 standard errors."""
    (cell,) = daylight_cells(FEW, 4000)
    limits = (0.02, 0.03, 0.03)
    for model, truth, limit in zip(cell.model_lx, cell.truth_lx, limits, strict=True):
        assert truth.standard_error < 0.03 * truth.value
        assert abs(model - truth.value) < 3 * truth.standard_error + limit * truth.value
    model, truth = cell.reflectance
    assert truth.standard_error < 0.06 * truth.value
    assert abs(model - truth.value) < 3 * truth.standard_error + 0.02 * truth.value
    model, truth = cell.bright_reflectance
    assert truth.standard_error < 0.04 * truth.value
    assert abs(model - truth.value) < 3 * truth.standard_error + 0.03 * truth.value
    assert cell.model_lx[1] > 1.2 * cell.model_lx[2] > 0  # towards the sun and away from it


def test_table_and_file_hold_all_cells(tmp_path):
    found = list(daylight_cells(FEW._replace(elevations_deg=(90.0, 45.0)), 640))
    rows = write_daylight(found, tmp_path / "light")
    with (tmp_path / "light" / "daylight.csv").open() as file:
        read = list(csv.DictReader(file))
    assert [float(row["veil_model_cd_m2"]) for row in read] == [cell.model_veil for cell in found]
    assert [row["elevation_deg"] for row in rows] == [90.0, 45.0]
    assert daylight_table(found)[1][0] == "IB 90 deg" and len({len(row) for row in daylight_table(found)}) == 1
    with pytest.raises(OSError):
        write_daylight(found, tmp_path / "light" / "daylight.csv")
