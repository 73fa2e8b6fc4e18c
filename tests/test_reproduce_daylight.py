"""The daylight of the light model beside the reference: cells agree, table and file hold them."""

import csv

import pytest

from twin.reproduce.daylight_comparison import daylight_cells, daylight_table
from twin.reproduce.light_cell import write_csv

FEW = ("IB",), (45.0,), (4.0,), (2.0,)


def test_a_cell_agrees_with_the_reference():
    """Slopes by a quadratic form: 3 %; level illuminance and Lu/Ed: 2 % and 3 standard errors."""
    (cell,) = daylight_cells(FEW, 4000)
    level, to_sun, from_sun, veil, lu = cell.light.values()
    for compared, error, limit in (
        (level, 0.03, 0.02),
        (to_sun, 0.03, 0.03),
        (from_sun, 0.03, 0.03),
        (veil.over(level), 0.06, 0.02),
        (lu.over(level), 0.04, 0.03),
    ):
        model, truth = compared[:2]
        assert truth.standard_error < error * truth.value
        assert abs(model - truth.value) < 3 * truth.standard_error + limit * truth.value
    assert to_sun.model > 1.2 * from_sun.model > 0


def test_table_and_file_hold_all_cells(tmp_path):
    found = list(daylight_cells((FEW[0], (90.0, 45.0), *FEW[2:]), 640))
    rows = write_csv(found, tmp_path / "light" / "daylight.csv")
    with (tmp_path / "light" / "daylight.csv").open() as file:
        read = list(csv.DictReader(file))
    assert [float(row["veil_model_cd_m2"]) for row in read] == [cell.light["veil"].model for cell in found]
    assert [row["elevation_deg"] for row in rows] == [90.0, 45.0]
    assert daylight_table(found)[1][0] == "IB 90 deg" and len({len(row) for row in daylight_table(found)}) == 1
    with pytest.raises(OSError):
        write_csv(found, tmp_path / "light" / "daylight.csv" / "below.csv")
