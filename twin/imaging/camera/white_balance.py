"""White balance: factors of R, G, B that make an expected or measured light appear grey.

The factors of a preset are inverse to the electrons of a white surface in white light, a black body, or white light
after the path exp(-2 Kd altitude) to the floor and back. Grey world makes the means of the bands equal (Buchsbaum
1980), with the lag of the auto-exposure. Factors are at least 1, so that a saturated pixel is white.
"""

import numpy as np

from twin.core.geometry import Array
from twin.imaging.light.illumination import water_to_floor_and_back
from twin.imaging.light.lamps import colour
from twin.imaging.light.water import downwelling_per_m
from twin.scenario.model import Scenario

MOST = 16.0  # largest factor


class WhiteBalance:
    """White balance of both cameras, from electrons (3,) in a pixel at 1 cd/m2 on any scale."""

    def __init__(self, scenario: Scenario, electrons_per_cd: Array):
        assert scenario.sensor is not None
        self._mode, self._electrons = scenario.sensor.white_balance, electrons_per_cd
        self.of_white_light = electrons_per_cd.max() / electrons_per_cd
        self._log_grey: Array | None = None
        self._fixed = self.of_white_light if self._mode == "white_light" else self._preset(scenario)

    def factors(self, mean: Array, share: float) -> Array:
        """Returns the factors (3,) of this frame; its `mean` radiance (3,) affects later frames (grey world)."""
        if self._mode != "grey_world":
            return self._fixed
        measured = np.log(_limited(np.maximum(self._electrons * mean, 1e-12 * self._electrons)))
        log_grey = measured if self._log_grey is None else self._log_grey
        self._log_grey = log_grey + share * (measured - log_grey)
        return np.exp(log_grey)

    @property
    def next_factors(self) -> Array:
        """Factors (3,) of the next frame; with grey world, a frame must have been measured."""
        return self._fixed if self._log_grey is None else np.exp(self._log_grey)

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
    """Returns the factors (3,), from 1 to `MOST`, that make electrons (3,) equal."""
    return np.minimum(electrons.max() / electrons, MOST)
