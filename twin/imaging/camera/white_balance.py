"""White balance: factors of R, G, B that make an expected or measured light appear grey.

The factors of a preset are inversely proportional to the electrons that a white surface yields in the expected light:
white light, a black body of a colour temperature, or white light after the path from the planned altitude to the floor
and back, exp(-2 Kd altitude), with Kd the diffuse attenuation of the water. With "gains", the scenario gives the
factors. Grey world makes the means of the three bands equal (Buchsbaum 1980, A spatial processor model for object
colour perception); the factors of a frame are computed from the previous frames with the lag of the auto-exposure.
Factors are at least 1, so that a saturated pixel is white, and at most `MOST` except those for white light, as
amplified bands are noisy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.imaging.light.illumination import water_to_floor_and_back
from twin.imaging.light.lamps import colour
from twin.imaging.light.water import downwelling_per_m
from twin.scenario.model import Scenario

Array = NDArray[np.float64]

MOST = 16.0  # largest factor


class WhiteBalance:
    """White balance of both cameras.

    Args:
        scenario: survey scenario with a section [sensor].
        electrons_per_cd: (3,) electrons in a pixel at 1 cd/m2, for R, G, B, on any scale.

    Attributes:
        is_of_white_light: whether the white balance is that for white light.
        of_white_light: (3,) factors for white light.
    """

    def __init__(self, scenario: Scenario, electrons_per_cd: Array):
        assert scenario.sensor is not None
        self._mode, self._electrons = scenario.sensor.white_balance, electrons_per_cd
        self.is_of_white_light = self._mode == "white_light"
        self.of_white_light = electrons_per_cd.max() / electrons_per_cd
        self._log_grey: Array | None = None
        self._fixed = self.of_white_light if self.is_of_white_light else self._preset(scenario)

    def factors(self, mean: Array, share: float) -> Array:
        """Returns the factors (3,) of this frame.

        With grey world, the factors are measured on the previous frames, or on this frame if it is the first one; this
        frame affects the factors of later frames.

        Args:
            mean: (3,) mean radiance of this frame in photometric units.
        """
        if self._mode != "grey_world":
            return self._fixed
        measured = np.log(_limited(np.maximum(self._electrons * mean, 1e-12 * self._electrons)))
        log_grey = measured if self._log_grey is None else self._log_grey
        self._log_grey = log_grey + share * (measured - log_grey)
        return np.exp(log_grey)

    @property
    def next_factors(self) -> Array:
        """Returns the factors (3,) of the next frame; with grey world, a frame must have been measured."""
        return self._fixed if self._log_grey is None else np.exp(self._log_grey)

    def relative(self, factors: Array) -> Array | float:
        """Returns the factors (3,) relative to those for white light; 1 if they are equal."""
        return 1.0 if self.is_of_white_light else factors / self.of_white_light

    def _preset(self, scenario: Scenario) -> Array:
        """Returns the constant factors (3,) of a scenario; with grey world, they are not used."""
        sensor = scenario.sensor
        assert sensor is not None
        if sensor.white_balance == "gains":
            return np.array(sensor.white_gains)
        light = np.ones(3)
        if sensor.white_balance == "temperature":
            light = colour(sensor.white_temperature_k)
        if sensor.white_balance == "water":
            light = np.exp(-2 * scenario.plan.altitude_m * downwelling_per_m(water_to_floor_and_back(scenario)))
        return _limited(self._electrons * np.maximum(light, 1e-12))


def _limited(electrons: Array) -> Array:
    """Returns the factors (3,) that make electrons (3,) equal; they are 1 or more, and at most `MOST`."""
    return np.minimum(electrons.max() / electrons, MOST)
