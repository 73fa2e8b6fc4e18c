"""Figures and numbers of the pages: which bar is which, labels of logarithmic axes, units of limits."""

import base64

import cv2
import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from twin.core.georeference import Georeference
from twin.report import plotting
from twin.report.number_formats import DASH, angle, length, milliradians, percent, with_unit
from twin.report.style import FIGURE_STYLE
from twin.studies.answers import rounded


@pytest.mark.parametrize("low", [0.0007, 0.03, 4.0])
@pytest.mark.parametrize("ratio", [3, 20, 300, 1e5])
def test_labels_of_a_logarithmic_axis_are_numbers_that_do_not_touch(low, ratio):
    with matplotlib.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(2.6, 2.0))
        canvas, axes = FigureCanvasAgg(figure), figure.add_subplot()
        plotting.log_axis(axes.xaxis, length)
        axes.set_xlim(low, low * ratio)
        canvas.draw()
    places = [place for place in axes.xaxis.get_majorticklocs() if low <= place <= low * ratio]
    labels = axes.xaxis.get_majorticklabels()
    boxes = [label.get_window_extent(canvas.get_renderer()) for label in labels]
    assert [label.get_text() for label in labels] == [length(place) for place in places] != []
    assert all(one.x1 < other.x0 for one, other in zip(boxes, boxes[1:], strict=False))
    assert not any(label.get_text() for label in axes.xaxis.get_minorticklabels())


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("map.le90_m", 0.02, "0.02 m"), ("timing.ga_ms", 3.0, "3 ms"), ("timing.wall_s", 3.0, "3 s"),
        ("trajectory.final.heading_rmse_deg", 0.1, "0.1 deg"), ("orthomosaic.ce90_px", 1.5, "1.5 px"),
        ("trajectory.final.drift_percent", 0.2, "0.2 %"), ("map.completeness", 0.95, "95 %"),
        ("plan.speed_mps", 0.35, "0.35 m/s"), ("plan.overlap_across", 0.7352, "73.5 %"), ("map.le90_m", None, "–"),  # noqa: RUF001
    ],
)  # fmt: skip
def test_a_limit_has_the_unit_of_its_metric(name, value, text):
    assert with_unit(name, value) == text


def test_bounds_of_a_range_have_no_exponent():
    assert [rounded(value) for value in (0.01234, 1.896, 999.4, 1997.3, 2e6)] == [
        "0.0123",
        "1.9",
        "999",
        "1997",
        "2000000",
    ]
    assert np.isfinite(float(rounded(-12345.6)))


@pytest.mark.parametrize(
    ("function", "value", "text"),
    [
        (length, 0.00043, "0.43 mm"), (length, 0.0064, "6.4 mm"), (length, -0.083, "-8.3 cm"),
        (length, 1.0, "1.00 m"), (milliradians, 0.1, "1.7 mrad"), (angle, 0.1, "0.10°"),
        (percent, 0.9996, "> 99.9 %"), (percent, 0.0004, "< 0.1 %"), (percent, 0.5, "50 %"),
    ],
)  # fmt: skip
def test_numbers_are_written_in_their_unit(function, value, text):
    assert function(value) == text
    assert function(None) == DASH


@pytest.mark.parametrize("metres_per_unit", [1.0, 0.3048])
def test_a_map_of_a_floor_in_a_crs_has_axes_of_easting_and_northing(metres_per_unit):
    with matplotlib.rc_context(FIGURE_STYLE):
        figure, axes = plotting.one_panel(4.0)
        axes.set(xlim=(-2.0, 3.0), ylim=(-1.0, 1.5))
        plotting.add_coordinates(axes, Georeference(412_349.25, 8_345_674.5, metres_per_unit=metres_per_unit))
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
    east, north = axes.child_axes
    k = metres_per_unit
    np.testing.assert_allclose(east.get_xlim(), [412_349.25 - 2 / k, 412_349.25 + 3 / k])
    np.testing.assert_allclose(north.get_ylim(), [8_345_674.5 - 1 / k, 8_345_674.5 + 1.5 / k])
    shown = [label.get_text() for label in north.get_yticklabels() if label.get_text()]
    assert all(text.startswith("83456") for text in shown) and len(shown) > 2
    assert north.get_ylabel() == f"northing [{'m' if k == 1 else '0.3048 m'}]"


def test_a_map_of_a_scene_without_coordinates_has_no_other_axes():
    _, axes = plotting.one_panel(4.0)
    plotting.add_coordinates(axes, None)
    assert not axes.child_axes


def test_a_figure_has_no_margins_but_the_padding():
    """Size against the tight bounding box of matplotlib, to 3 px of anti-aliased lines."""
    with matplotlib.rc_context(FIGURE_STYLE):
        figure, axes = plotting.one_panel(4.0)
        axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", xlabel="east [m]")
        data = base64.b64decode(plotting.to_data_uri(figure).partition(",")[2])
        padded = (figure.get_tightbbox().size + 2 * plotting.PAD_IN) * figure.dpi
    rows, cols, _ = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape
    np.testing.assert_allclose([cols, rows], np.minimum(padded, figure.get_size_inches() * figure.dpi), atol=3)
    assert cols < plotting.WIDTH_IN * figure.dpi / 2
