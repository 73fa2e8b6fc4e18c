"""Image quality of stereo observations: matched points and contrast, as metrics and as a figure."""

import dataclasses
import json

import numpy as np
import pytest
from judge_synthetic import survey, write_folder

from twin.core.records import StereoObservation
from twin.estimate.vision.image_quality import contrast, saturated_fraction
from twin.estimate.vision.matching import gray
from twin.judge.survey_quality import stereo_quality
from twin.report.run_folder import load_run
from twin.report.survey_figures import stereo_quality_curves

RESULT = survey()[0]
CHECKS = np.tile(np.kron([[1.0, -1.0], [-1.0, 1.0]], np.ones((5, 5))), (24, 32))


def view(reflected: float, backscatter: float, modulation: float = 0.5) -> np.ndarray:
    """Returns an image (240, 320) of a chequered floor with added backscatter; all in grey levels."""
    return gray(np.repeat((reflected * (1 + modulation * CHECKS) + backscatter)[..., None], 3, axis=2).astype(np.uint8))


def test_contrast_does_not_depend_on_exposure_and_decreases_with_backscatter():
    """Backscatter adds to the mean only: the contrast of the floor is multiplied by floor / (floor + backscatter)."""
    clear = contrast(view(100, 0))
    assert 0.4 < clear < 0.5  # slightly below the modulation of the floor because of smoothing
    assert contrast(view(50, 0)) == pytest.approx(clear, rel=0.01)
    for backscatter in (25, 50, 100):
        assert contrast(view(50, backscatter)) == pytest.approx(clear * 50 / (50 + backscatter), rel=0.01)
    assert contrast(np.full((240, 320), 90, np.float32)) == contrast(np.zeros((240, 320), np.float32)) == 0


def test_observations_without_a_keyframe_are_included_and_counted():
    observations = [StereoObservation(int(row), 100 + k, 0.2) for k, row in enumerate(RESULT.keyframe_rows)]
    observations += [StereoObservation(9999, 3, 0.05)]
    quality = stereo_quality(dataclasses.replace(RESULT, stereo_observations=observations))
    assert quality["blind_looks"] == 1
    assert quality["points_median"] == np.median([observation.n_points for observation in observations])
    assert quality["points_p10"] == np.percentile([observation.n_points for observation in observations], 10)
    assert quality["contrast_median"] == 0.2


def test_observations_without_images_have_points_but_no_contrast():
    quality = stereo_quality(dataclasses.replace(RESULT, stereo_observations=[StereoObservation(0, 7, None)]))
    assert quality["points_median"] == 7 and quality["contrast_median"] is None
    mixed = [StereoObservation(0, 7, None), StereoObservation(1, 7, 0.3)]
    assert stereo_quality(dataclasses.replace(RESULT, stereo_observations=mixed))["contrast_median"] == 0.3
    none = dict.fromkeys(("points_median", "points_p10", "contrast_median", "saturated_median")) | {"blind_looks": 0}
    assert stereo_quality(RESULT) == none


def test_the_saturated_fraction_counts_pixel_values_at_full_scale():
    image = np.full((20, 30, 3), 254, np.uint8)
    assert saturated_fraction(image) == 0
    image[:5, :, 0] = 255
    assert saturated_fraction(image) == pytest.approx(5 / 20 / 3)
    observations = [StereoObservation(k, 100, 0.2, saturated) for k, saturated in enumerate((0.0, 0.01, 0.5, None))]
    quality = stereo_quality(dataclasses.replace(RESULT, stereo_observations=observations))
    assert quality["saturated_median"] == 0.01


@pytest.mark.parametrize(("value", "n_panels"), [(0.2, 2), (None, 1)])
def test_the_figure_shows_observations_over_time_and_marks_those_with_too_few_points(tmp_path, value, n_panels):
    folder = write_folder(tmp_path / "run", finished=False)
    assert stereo_quality_curves(load_run(folder)) is None
    index = folder / "keyframes" / "index.json"
    rows = RESULT.keyframe_rows[:10].tolist()
    observations = [StereoObservation(row, 100 + row, value)._asdict() for row in [*rows, rows[-1] + 1]]
    index.write_text(json.dumps(json.loads(index.read_text()) | {"stereo_observations": observations}))
    figure = stereo_quality_curves(load_run(folder))
    assert len(figure.axes) == n_panels
    points, too_few = figure.axes[0].lines
    np.testing.assert_allclose(points.get_xdata(), np.array([*rows, rows[-1] + 1]) / 10.0)
    np.testing.assert_array_equal(points.get_ydata(), [observation["n_points"] for observation in observations])
    assert too_few.get_ydata().tolist() == [101 + rows[-1]]
