"""Light sources of a camera: the lamps in its axes, with beam, intensity and colour, and the daylight."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from twin.core import geometry
from twin.core.records import Array, StereoRig
from twin.errors import TwinError
from twin.imaging.light.illumination import Daylight
from twin.imaging.light.spectra import NM, band_weights
from twin.scenario.model import LampConfig

#: Measured beam of an LED lamp: angle from the axis [deg], intensity relative to the axis (Song et al. 2021).
LED_BEAM = (
    (0.0, 1.0), (10.0, 0.96), (20.0, 0.87), (30.0, 0.75), (35.0, 0.63), (40.0, 0.5), (45.0, 0.28), (50.0, 0.2),
    (60.0, 0.12), (90.0, 0.0),
)  # fmt: skip

WHITE_K = 6500.0  # colour temperature of white light
LUMINANCE_SHARES = np.array([0.2126, 0.7152, 0.0722])  # fractions of R, G, B in the luminance of white (ITU-R BT.709)
_HC_PER_K = 0.014387769  # h c / k, second radiation constant [m K]


class LightSources(NamedTuple):
    """Light sources of one camera: the lamps in the axes of the camera, and the daylight."""

    position_m: Array  # (n, 3) positions of the lamps [m]
    axis: Array  # (n, 3) unit vectors of the beam axes of the lamps
    intensity_cd: Array  # (n,) luminous intensity of each lamp on its beam axis
    colour: Array  # (n, 3) factors of the intensity for R, G, B
    # for each lamp, (m, 2) angle from the beam axis [deg] and intensity relative to `intensity_cd`
    beam: tuple[Array, ...]
    daylight: Daylight  # daylight in the water


def light_sources_in_camera(
    rig: StereoRig, lamps: Sequence[LampConfig], daylight: Daylight, camera: int
) -> LightSources:
    """Returns lamps in axes of a camera (0 left, 1 right) and daylight; TwinError unless beam angles rise from 0."""
    camera_from_body = geometry.inverse(rig.body_from_camera @ (rig.left_from_right if camera else np.eye(4)))
    position = np.array([lamp.position_m for lamp in lamps]).reshape(-1, 3)
    axis = np.array([_beam_axis(lamp) for lamp in lamps]).reshape(-1, 3) @ camera_from_body[:3, :3].T
    intensity = np.array([lamp.intensity_cd for lamp in lamps])
    colours = np.array([colour(lamp.colour_temperature_k) for lamp in lamps]).reshape(-1, 3)
    beams = tuple(_beam(k, lamp) for k, lamp in enumerate(lamps))
    return LightSources(geometry.transform(camera_from_body, position), axis, intensity, colours, beams, daylight)


def _beam_axis(lamp: LampConfig) -> Array:
    """Returns the unit vector (3,) of the beam in body axes: down, tilted towards the bow and panned towards port."""
    tilt, pan = np.deg2rad([lamp.tilt_deg, lamp.pan_deg])
    return np.array([np.sin(tilt), np.cos(tilt) * np.sin(pan), -np.cos(tilt) * np.cos(pan)])


def _beam(number: int, lamp: LampConfig) -> Array:
    table = np.array(lamp.beam or LED_BEAM)
    if table[0, 0] != 0 or not (np.diff(table[:, 0]) > 0).all():
        raise TwinError(f"lamps.{number}.beam", "angles do not increase from 0", "as in [[0, 1], [30, 0.7], [60, 0]]")
    return table


def beam_share(cos_angle: Array, table: Array) -> Array:
    """Returns the relative intensity by a beam table (m, 2) of angle [deg] and share; 0 behind it and above 90 deg."""
    angle_deg = np.rad2deg(np.arccos(np.clip(cos_angle, -1.0, 1.0)))
    return np.where(np.asarray(cos_angle) < 0, 0.0, np.interp(angle_deg, *table.T, right=0.0))


def colour(temperature_k: float) -> Array:
    """Returns the intensities (3,) of a black body in R, G, B, relative to one at 6500 K with equal luminance."""
    power, white = _black_body(temperature_k), _black_body(WHITE_K)
    against_white = band_weights(white) @ (power / white)
    return against_white / (against_white @ LUMINANCE_SHARES)


def _black_body(temperature_k: float) -> Array:
    """Returns the power (n,) of a black body per wavelength at `NM`, up to a factor (Planck 1901)."""
    metres = NM * 1e-9
    return metres**-5 / np.expm1(_HC_PER_K / (metres * temperature_k))
