"""Lamps and daylight as an eye finds them: where they are, how bright in each direction, of which colour."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import StereoRig
from twin.errors import TwinError
from twin.imaging.water import Medium, downwelling_per_m
from twin.scenario.model import LampConfig, SunConfig

Array = NDArray[np.float64]

#: Measured beam of an LED lamp: share of the intensity on the axis by angle from it [deg] (Song et al. 2021).
LED_BEAM = (
    (0.0, 1.0), (10.0, 0.96), (20.0, 0.87), (30.0, 0.75), (35.0, 0.63), (40.0, 0.5), (45.0, 0.28), (50.0, 0.2),
    (60.0, 0.12), (90.0, 0.0),
)  # fmt: skip

WHITE_K = 6500.0  # of a black body that counts as white
WAVELENGTHS_M = np.array([650e-9, 550e-9, 450e-9])  # for which the bands stand
LUMINANCE_SHARES = np.array([0.2126, 0.7152, 0.0722])  # of R, G, B in white (ITU-R BT.709)
_HC_PER_K = 0.014387769  # h c / k, second radiation constant [m K]


class Daylight(NamedTuple):
    """Daylight at the height that is flown, for R, G, B.

    Args:
        eye_lx: (3,) illuminance of a level plane there.
        per_m: (3,) by which it falls on its way farther down, Kd; 0 where it is even.
    """

    eye_lx: Array
    per_m: Array


class Lights(NamedTuple):
    """Lamps in the axes of one camera, and daylight along its optical axis.

    Args:
        position_m, axis: (n, 3), axis of unit length.
        intensity_cd: (n,) on the axis.
        colour: (n, 3) by which it is multiplied for R, G, B.
        beam: n tables (m, 2) of angle [deg] and share of the intensity on the axis.
    """

    position_m: Array
    axis: Array
    intensity_cd: Array
    colour: Array
    beam: tuple[Array, ...]
    daylight: Daylight


def daylight_at(sun: SunConfig, water: Medium, altitude_m: float) -> Daylight:
    """Daylight at a height above the reference plane: of `sun`, less what the water took above.

    Raises:
        TwinError: that height is above the surface, or there is no surface to throw caustics.
    """
    if not sun.depth_m:
        if sun.caustics:
            raise TwinError("sun.caustics", f"{sun.caustics:g}: there is no surface", "0, or with sun.depth_m")
        return Daylight(np.full(3, sun.illuminance_lx), np.zeros(3))
    if altitude_m >= sun.depth_m:
        raise TwinError(
            "sun.depth_m", f"{sun.depth_m:g}: the cameras fly above the surface", f"more than {altitude_m:g}"
        )
    per_m = downwelling_per_m(water)
    return Daylight(sun.illuminance_lx * np.exp(-per_m * (sun.depth_m - altitude_m)), per_m)


def lights_of_eye(rig: StereoRig, lamps: Sequence[LampConfig], daylight: Daylight, eye: int) -> Lights:
    """The lamps, which move with the rig, in the axes of one camera.

    Raises:
        TwinError: the table of a beam is none.
    """
    camera_from_body = geometry.inverse(rig.body_from_camera @ (rig.left_from_right if eye else np.eye(4)))
    position = np.array([lamp.position_m for lamp in lamps]).reshape(-1, 3)
    axis = np.array([_beam_axis(lamp) for lamp in lamps]).reshape(-1, 3)
    return Lights(
        geometry.transform(camera_from_body, position),
        axis @ camera_from_body[:3, :3].T,
        np.array([lamp.intensity_cd for lamp in lamps]),
        np.array([colour(lamp.colour_temperature_k) for lamp in lamps]).reshape(-1, 3),
        tuple(_beam(k, lamp) for k, lamp in enumerate(lamps)),
        daylight,
    )


def _beam_axis(lamp: LampConfig) -> Array:
    """Unit vector of a lamp's beam in the body: from straight down, tilted to the bow, panned to port."""
    tilt, pan = np.deg2rad([lamp.tilt_deg, lamp.pan_deg])
    return np.array([np.sin(tilt), np.cos(tilt) * np.sin(pan), -np.cos(tilt) * np.cos(pan)])


def _beam(number: int, lamp: LampConfig) -> Array:
    """The table of a lamp's beam."""
    table = np.array(lamp.beam or LED_BEAM)
    if table[0, 0] != 0 or not (np.diff(table[:, 0]) > 0).all():
        raise TwinError(f"lamps.{number}.beam", "angles do not rise from 0", "as in [[0, 1], [30, 0.7], [60, 0]]")
    return table


def beam_share(cos_angle: Array, table: Array) -> Array:
    """Intensity off the axis of a lamp as a share of that on it; dark beyond the table."""
    return np.interp(np.rad2deg(np.arccos(np.clip(cos_angle, 0.0, 1.0))), *table.T, right=0.0)


def colour(temperature_k: float) -> Array:
    """(3,) factors of a black body's light for R, G, B against the white of 6500 K, at equal luminance.

    Planck (1901): radiance at wavelength l is proportional to 1 / (exp(h c / (l k T)) - 1).
    """
    against_white = np.expm1(_HC_PER_K / (WAVELENGTHS_M * WHITE_K)) / np.expm1(
        _HC_PER_K / (WAVELENGTHS_M * temperature_k)
    )
    return against_white / (against_white @ LUMINANCE_SHARES)
