"""Images of another size than the calibration are refused."""

import numpy as np
import pytest

from twin.core.records import Frame, StereoRig
from twin.estimate import EstimatorSettings, Navigator

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
