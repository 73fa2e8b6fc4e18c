"""Features and contrast: counted as found, blind stereo_observations too, and shown over time; no images, no contrast."""

import dataclasses
import json

import numpy as np
import pytest
from judge_synthetic import survey, write_folder

from twin.core.records import StereoObservation
from twin.estimate.vision.matching import contrast, gray
from twin.judge.stereo_quality import stereo_quality
from twin.report.figures import look_curves
from twin.report.run_folder import load_run

RESULT = survey()[0]
CHECKS = np.tile(np.kron([[1.0, -1.0], [-1.0, 1.0]], np.ones((5, 5))), (24, 32))


def seen(reflected: float, veil: float, ripple: float = 0.5) -> np.ndarray:
    """Grey levels (240, 320) of an image of a chequered floor behind a veil, both in grey levels."""
    return gray(np.repeat((reflected * (1 + ripple * CHECKS) + veil)[..., None], 3, axis=2).astype(np.uint8))


def test_contrast_does_not_depend_on_exposure_and_falls_by_the_veils_share():
    """A veil adds to the mean alone: contrast is that of the floor times floor / (floor + veil)."""
    clear = contrast(seen(100, 0))
    assert 0.4 < clear < 0.5  # a bit less than the floor's own, as levels are smoothed a little
    assert contrast(seen(50, 0)) == pytest.approx(clear, rel=0.01)
    for veil in (25, 50, 100):
        assert contrast(seen(50, veil)) == pytest.approx(clear * 50 / (50 + veil), rel=0.01)
    assert contrast(np.full((240, 320), 90, np.float32)) == contrast(np.zeros((240, 320), np.float32)) == 0


def test_looks_that_made_no_keyframe_count_and_are_counted():
    stereo_observations = [StereoObservation(int(row), 100 + k, 0.2) for k, row in enumerate(RESULT.keyframe_rows)] + [
        StereoObservation(9999, 3, 0.05)
    ]
    found = stereo_quality(dataclasses.replace(RESULT, stereo_observations=stereo_observations))
    assert found["blind_looks"] == 1
    assert found["points_median"] == np.median([look.n_points for look in stereo_observations])
    assert found["points_p10"] == np.percentile([look.n_points for look in stereo_observations], 10)
    assert found["contrast_median"] == 0.2


def test_without_images_there_are_points_and_no_contrast():
    found = stereo_quality(dataclasses.replace(RESULT, stereo_observations=[StereoObservation(0, 7, None)]))
    assert found["points_median"] == 7 and found["contrast_median"] is None
    mixed = [StereoObservation(0, 7, None), StereoObservation(1, 7, 0.3)]
    assert stereo_quality(dataclasses.replace(RESULT, stereo_observations=mixed))["contrast_median"] == 0.3
    assert stereo_quality(RESULT) == {"points_median": None, "points_p10": None, "contrast_median": None} | {
        "blind_looks": 0
    }


@pytest.mark.parametrize(("value", "n_panels"), [(0.2, 2), (None, 1)])
def test_the_picture_shows_what_there_is_by_time_and_marks_blind_looks(tmp_path, value, n_panels):
    folder = write_folder(tmp_path / "run", finished=False)
    assert look_curves(load_run(folder)) is None
    index = folder / "keyframes" / "index.json"
    keys = RESULT.keyframe_rows[:10].tolist()
    stereo_observations = [StereoObservation(row, 100 + row, value)._asdict() for row in [*keys, keys[-1] + 1]]
    index.write_text(json.dumps(json.loads(index.read_text()) | {"stereo_observations": stereo_observations}))
    figure = look_curves(load_run(folder))
    assert len(figure.axes) == n_panels
    points, blind = figure.axes[0].lines
    np.testing.assert_allclose(points.get_xdata(), np.array([*keys, keys[-1] + 1]) / 10.0)
    np.testing.assert_array_equal(points.get_ydata(), [look["n_points"] for look in stereo_observations])
    assert blind.get_ydata().tolist() == [101 + keys[-1]]
