"""Results for one turbidity level: the image of the object, its quality, and the contrast as a function of range."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Image
from twin.imaging.light.water import Medium
from twin.scenario.model import Scenario

Array = NDArray[np.float64]

#: Contrast relative to clear water below which fine detail counts as invisible.
MIN_VISIBLE_CONTRAST = 0.05


class TurbidityLevel(NamedTuple):
    """Results for one turbidity level.

    Args:
        scenario: scenario with this turbidity.
        water: optical properties of the water.
        image: (H, W, 3) image of the left camera.
        quality: measures of the quality of `image`, see `twin.app.look.image_quality`.
        ranges_m: (n,) ranges at which `contrast` is given [m].
        contrast: (n, 3) contrast of fine detail relative to clear water for R, G, B.
    """

    scenario: Scenario
    water: Medium
    image: Image
    quality: dict[str, Any]
    ranges_m: Array
    contrast: Array

    @property
    def visibility_m(self) -> float | None:
        """Returns the shortest range [m] with a green contrast below `MIN_VISIBLE_CONTRAST`; None if there is none."""
        invisible = np.flatnonzero(self.contrast[:, 1] < MIN_VISIBLE_CONTRAST)
        return float(self.ranges_m[invisible[0]]) if invisible.size else None
