"""The light model over relief compared with the reference: a shadow, the far side of a cliff, and the table."""

import pytest

from twin.reproduce.relief_comparison import RELIEFS, relief_cells, relief_table


@pytest.mark.parametrize(
    ("water", "name"),
    [
        ("IB", "box, shadow"),
        pytest.param("II", "box, shadow", marks=pytest.mark.long),
        pytest.param("II", "cliff, far side", marks=pytest.mark.long),
    ],
)
def test_light_in_a_shadow_and_beyond_an_edge_agrees_with_the_reference(water, name):
    """15 % of all light and 0.1 of the sharp share, which is the contrast of a texture, plus 2 standard errors."""
    total, sharp = (next(iter(relief_cells(((water,), (name,)), 8000))).light[key] for key in ("total", "sharp_share"))
    assert abs(total.ratio.value - 1) < 0.15 + 2 * total.ratio.standard_error
    assert abs(sharp.model - sharp.truth.value) < 0.1 + 2 * sharp.truth.standard_error


@pytest.mark.long
def test_all_reliefs_agree_with_the_reference():
    """In water of type II; behind the wall the blur is too bright, as it hides light from the rays of the camera."""
    cells = list(relief_cells((("II",), tuple(RELIEFS)), 16000))
    for cell in cells:
        total, sharp = cell.light["total"], cell.light["sharp_share"]
        assert abs(total.ratio.value - 1) < 0.15 + 2 * total.ratio.standard_error, cell.conditions
        assert abs(sharp.model - sharp.truth.value) < 0.1, cell.conditions
    rows = relief_table(cells)
    assert {len(row) for row in rows} == {6} and rows[1][:2] == ("II", "slope")
