"""Optical properties of water: absorption, scattering, phase function, and diffuse attenuation of daylight."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.paths import is_file
from twin.errors import TwinError
from twin.scenario.model import WaterConfig

Array = NDArray[np.float64]

#: Absorption a and scattering b of Jerlov's water types for R, G, B [1/m] (table of the Stonefish simulator).
JERLOV_PER_M: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "clear": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "I": ((0.4601, 0.0620, 0.0176), (0.0008, 0.0017, 0.0042)),
    "IA": ((0.4612, 0.0622, 0.0223), (0.0021, 0.0035, 0.0068)),
    "IB": ((0.4612, 0.0623, 0.0239), (0.0431, 0.0536, 0.0700)),
    "II": ((0.4622, 0.0622, 0.0247), (0.2498, 0.3580, 0.5236)),
    "III": ((0.4651, 0.0646, 0.0411), (0.6834, 0.9800, 1.4325)),
    "1C": ((0.4803, 0.0760, 0.1198), (0.2538, 0.3650, 0.5340)),
    "3C": ((0.4840, 0.0820, 0.1821), (0.7406, 1.0600, 1.5586)),
    "5C": ((0.5204, 0.1170, 0.3467), (0.9285, 1.3300, 1.9417)),
    "7C": ((0.5782, 0.1950, 0.6202), (1.6392, 2.3500, 3.4266)),
    "9C": ((0.6207, 0.3480, 1.0553), (2.1720, 3.1200, 4.5610)),
}

#: Largest size of a spectrum file.
MAX_SPECTRUM_BYTES = 10_000_000
#: Bands R, G, B [nm] over which a spectrum is averaged.
BANDS_NM = ((600.0, 700.0), (500.0, 600.0), (400.0, 500.0))
#: Mean cosine of the scattering angle in sea water, g of the Henyey-Greenstein phase function.
SEA_WATER_MEAN_COSINE = 0.924


class Medium(NamedTuple):
    """Optical properties of the water in the bands R, G, B.

    Args:
        absorption_per_m: (3,) absorption coefficient a [1/m].
        scattering_per_m: (3,) scattering coefficient b [1/m].
        mean_cosine: mean cosine g of the scattering angle.
        kept_share: fraction k of the scattered light that stays in the beam, i.e. does not count as attenuated.
    """

    absorption_per_m: Array
    scattering_per_m: Array
    mean_cosine: float = SEA_WATER_MEAN_COSINE
    kept_share: float = 0.0

    @property
    def attenuation_per_m(self) -> Array:
        """Effective attenuation coefficient (3,) [1/m]: a + (1 - k) b.

        With k = 0 this is the beam attenuation coefficient c = a + b, which counts all scattered light as lost. Most
        light is scattered by small angles, however, so c overestimates the attenuation of the image signal in turbid
        water. With k = 0.74, the fraction scattered by less than 15 deg, the coefficient is a + 0.26 b, close to the
        a + 0.3 b that was measured in range-gated imaging.
        """
        return self.absorption_per_m + (1 - self.kept_share) * self.scattering_per_m


def medium(water: WaterConfig) -> Medium:
    """Returns the optical properties of a scenario's water, with the scattering multiplied by `turbidity`.

    Raises:
        TwinError: absorption or scattering is missing or given twice, or the spectrum cannot be read.
    """
    absorption, scattering = _spectrum(water)
    return Medium(absorption, scattering * water.turbidity, water.mean_cosine, water.kept_share)


def _spectrum(water: WaterConfig) -> tuple[Array, Array]:
    """Returns absorption and scattering (3,) [1/m], from given values, a spectrum file or the Jerlov type."""
    own = {"absorption_per_m": water.absorption_per_m, "scattering_per_m": water.scattering_per_m}
    given = [key for key, value in own.items() if value is not None]
    if water.spectrum_file is not None:
        if given:
            raise TwinError(f"water.{given[0]}", "given twice, as there is a water.spectrum_file", "one of them")
        return read_spectrum(Path(water.spectrum_file))
    if len(given) == 1:
        missing = next(key for key in own if key not in given)
        raise TwinError(f"water.{missing}", f"missing, as there is a water.{given[0]}", "both or none")
    absorption, scattering = own.values() if given else JERLOV_PER_M[water.jerlov]
    return np.array(absorption), np.array(scattering)


def read_spectrum(file: Path) -> tuple[Array, Array]:
    """Returns absorption and scattering (3,) [1/m], averaged over `BANDS_NM` with linear interpolation between rows.

    Args:
        file: comma-separated rows of wavelength [nm], absorption, scattering [1/m]; # starts a comment.
    Raises:
        TwinError: the file cannot be read, its wavelengths do not increase or do not cover all bands, or a value is
            negative.
    """
    key = "water.spectrum_file"
    wanted = "rows of wavelength [nm], absorption, scattering [1/m]"
    if file.exists() and not (is_file(file) and file.stat().st_size <= MAX_SPECTRUM_BYTES):
        problem = "it is not a regular file" if not is_file(file) else f"it has {file.stat().st_size} bytes"
        raise TwinError(key, f"{file} cannot be read: {problem}", f"up to {MAX_SPECTRUM_BYTES} bytes, {wanted}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # an empty file
            table = np.loadtxt(file, delimiter=",", comments="#", ndmin=2)
    except (OSError, ValueError) as error:
        raise TwinError(key, f"{file} cannot be read: {error}", wanted) from None
    if table.shape[1] != 3 or len(table) < 2:
        raise TwinError(key, f"{file} has {table.shape[1]} columns and {len(table)} rows", "3 columns, 2 rows or more")
    nm = table[:, 0]
    if not (np.diff(nm) > 0).all():
        raise TwinError(key, f"{file}: wavelengths do not increase", "strictly increasing [nm]")
    low, high = min(BANDS_NM)[0], max(BANDS_NM)[1]
    if nm[0] > low or nm[-1] < high:
        raise TwinError(key, f"{file} covers {nm[0]:g} to {nm[-1]:g} nm", f"{low:g} to {high:g} or more")
    if not (np.isfinite(table).all() and (table[:, 1:] >= 0).all()):
        row = int(np.argmin((np.isfinite(table) & (table >= 0)).all(axis=1)))
        raise TwinError(key, f"{file}: negative or not finite at {nm[row]:g} nm", "0 or more [1/m]")
    absorption, scattering = (np.array([_mean(nm, value, *band) for band in BANDS_NM]) for value in table[:, 1:].T)
    return absorption, scattering


def _mean(nm: Array, value: Array, low: float, high: float) -> float:
    """Returns the mean of a piecewise linear function between two wavelengths."""
    nodes = np.concatenate([[low], nm[(nm > low) & (nm < high)], [high]])
    return float(np.trapezoid(np.interp(nodes, nm, value), nodes) / (high - low))


def downwelling_per_m(water: Medium) -> Array:
    """Returns the diffuse attenuation of daylight with depth, Kd (3,) [1/m], for a sun at the zenith.

    Kirk (1984, Limnol. Oceanogr. 29, 350): Kd = sqrt(a^2 + G a b) / mu, G = 0.425 mu - 0.19, mu = 1; a fit to
    Monte Carlo simulations of multiple scattering. Kd lies between a and c.
    """
    a, b = water.absorption_per_m, water.scattering_per_m
    return np.sqrt(a**2 + 0.235 * a * b)


def phase_function(cos_angle: Array, mean_cosine: float = SEA_WATER_MEAN_COSINE) -> Array:
    """Returns the Henyey-Greenstein (1941) phase function [1/sr]; it integrates to 1 over the sphere.

    Args:
        cos_angle: cosine of the scattering angle; 1 is straight ahead.
        mean_cosine: mean cosine g of the scattering angle.
    """
    g = mean_cosine
    return (1 - g**2) / (4 * np.pi * (1 + g**2 - 2 * g * cos_angle) ** 1.5)
