"""Images of another size than the calibration are refused."""

import numpy as np
import pytest

from twin.core.records import Frame, SensorNoise, StereoRig
from twin.estimate import EstimatorSettings, Navigator
from twin.estimate.stereo_vision import StereoVision
from twin.plugin.navigator import PluginNavigator
from twin.plugin.protocols import EstimatorSetup

RIG = StereoRig(160, 120, 140.0, 0.1, focal_y_px=130.0)
GOOD, SMALL = np.zeros((120, 160, 3), np.uint8), np.zeros((100, 160, 3), np.uint8)


@pytest.mark.parametrize(
    ("left", "right", "side"), [(SMALL, GOOD, "left"), (GOOD, SMALL, "right"), (SMALL, None, "left")]
)
def test_an_image_of_another_size_is_refused_and_the_next_frame_is_used(left, right, side):
    with Navigator(RIG, EstimatorSettings(), np.eye(4)) as navigator:
        navigator.update(Frame(0, 0.0, GOOD, None))
        with pytest.raises(ValueError, match=f"{side}: the image has 160 x 100 px, but .* 160 x 120 px"):
            navigator.update(Frame(1, 0.1, left, right))
        navigator.update(Frame(1, 0.1, GOOD, None))


class CountsFrames:
    """Estimator that counts the frames of the last one created."""

    n_frames = 0

    def __init__(self, setup):
        CountsFrames.n_frames = 0

    def update(self, frame):
        CountsFrames.n_frames += 1
        return np.eye(4)

    def covariance(self):
        return None

    def finish(self):
        return None


def test_a_plug_in_does_not_get_a_frame_of_another_size(tmp_path):
    setup, settings = EstimatorSetup(RIG, np.eye(4), SensorNoise()), EstimatorSettings()
    with (
        StereoVision(RIG, settings, tmp_path) as vision,
        PluginNavigator(f"{__name__}:CountsFrames", setup, settings, vision) as navigator,
    ):
        for left, right in ((SMALL, None), (GOOD, SMALL)):
            with pytest.raises(ValueError, match="the image has 160 x 100 px"):
                navigator.update(Frame(0, 0.0, left, right))
        navigator.update(Frame(0, 0.0, GOOD, None))
    assert CountsFrames.n_frames == 1
