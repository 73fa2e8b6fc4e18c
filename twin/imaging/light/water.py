"""Optical properties of water: absorption, scattering, phase function, and diffuse attenuation of daylight."""

import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.core.user_files import reading
from twin.errors import TwinError
from twin.imaging.light.phase_function import BandWater, Scatterer, molecular_scattering_per_m
from twin.imaging.light.spectra import CENTRE_NM, NM, Light, band_weights, effective_per_m, spectrum_of, water_spectrum
from twin.scenario.model import ScatteringModel, WaterConfig

MAX_SPECTRUM_BYTES = 10_000_000
_GREEN = 1  # band in which visibility and Secchi depth are given
_SECCHI = 8.0  # Preisendorfer (1986, Limnol. Oceanogr. 31, 909)


class Medium(NamedTuple):
    """Optical properties of the water in the bands R, G, B."""

    absorption_per_m: Array  # (3,) absorption coefficient a [1/m]
    scattering_per_m: Array  # (3,) scattering coefficient b [1/m]
    scatterers: tuple[Scatterer, ...] = (Scatterer(),) * 3
    # whether multiple scattering is modelled; else all light that is scattered from its path is lost
    multiple: bool = True

    @property
    def attenuation_per_m(self) -> Array:
        """Beam attenuation coefficient c = a + b (3,) [1/m], which counts all scattered light as lost."""
        return self.absorption_per_m + self.scattering_per_m

    @property
    def camera_loss_per_m(self) -> Array:
        """Loss of light between floor and camera (3,) [1/m]: a with multiple scattering, else c = a + b."""
        return self.absorption_per_m if self.multiple else self.attenuation_per_m

    @property
    def scatters_repeatedly(self) -> bool:
        return self.multiple and bool(self.scattering_per_m.any())

    @property
    def bands(self) -> tuple[BandWater, ...]:
        rows = zip(self.absorption_per_m.tolist(), self.scattering_per_m.tolist(), self.scatterers, strict=True)
        return tuple(BandWater(*row) for row in rows)


def medium(
    water: WaterConfig, scattering: ScatteringModel = "full", *, path_m: float = 0.0, light: Light = "led"
) -> Medium:
    """Returns the optical properties of a scenario's water, scattering as its turbidity or visibility states.

    `path_m` is the path of the light for the effective absorption; 0: mean absorption of the band. Raises TwinError
    where absorption or scattering is missing or given twice, there is no valid spectrum of water or light, or the water
    cannot have the visibility.
    """
    absorption, per_m = _coefficients(water, path_m, light)
    per_m = per_m * (_turbidity(water) if scattering != "none" else 0.0)
    return Medium(absorption, per_m, scatterers(water, per_m), scattering == "full")


def scatterers(water: WaterConfig, scattering_per_m: Array) -> tuple[Scatterer, ...]:
    """Returns what scatters each band for b (3,) [1/m]; with "sea", molecules scatter as in sea water (Morel 1974)."""
    if water.phase_function == "sea":
        molecules = molecular_scattering_per_m(np.array(CENTRE_NM))
        share = np.minimum(molecules / np.maximum(scattering_per_m, 1e-12), 1.0)
        return tuple(Scatterer("petzold", float(one)) for one in share)
    parameters = {
        "petzold": (),
        "fournier_forand": (water.particle_index, water.particle_slope),
        "henyey_greenstein": (water.mean_cosine,),
    }[water.phase_function]
    return (Scatterer(water.phase_function, 0.0, parameters),) * 3


def _turbidity(water: WaterConfig) -> float:
    """Returns the factor on the scattering of a water with which it has its `visibility_m`, if that is given."""
    if water.visibility_m is None:
        return water.turbidity
    if water.turbidity != 1:
        problem = f"{water.visibility_m:g}, and water.turbidity is {water.turbidity:g}: the scattering is given twice"
        raise TwinError("water.visibility_m", problem, "one of them")
    absorption, scattering = (float(per_m[_GREEN]) for per_m in _coefficients(water, 0.0, "daylight"))
    per_m = water.visibility_constant / water.visibility_m - absorption
    if scattering == 0:
        raise TwinError("water.visibility_m", f"{water.visibility_m:g} m of a water that does not scatter", "no value")
    if per_m < 0:
        problem = f"{water.visibility_m:g} m, but absorption alone leaves less"
        raise TwinError("water.visibility_m", problem, f"at most {water.visibility_constant / absorption:.3g} m")
    return per_m / scattering


class Clarity(NamedTuple):
    """What a diver sees in daylight, by the coefficients in green."""

    visibility_m: float  #: horizontal visibility of a black object [m], `visibility_constant` / c
    secchi_m: float  #: depth at which a white disk disappears [m], 8 / (c + Kd) (Preisendorfer 1986)

    def __str__(self) -> str:
        if np.isinf(self.visibility_m):
            return "unlimited visibility"
        return f"visibility {self.visibility_m:.2g} m, Secchi depth {self.secchi_m:.2g} m"


def clarity(water: WaterConfig) -> Clarity:
    """Returns the visibility and the Secchi depth of a water, infinite without attenuation; TwinError as `medium`."""
    found = medium(water, light="daylight")
    c, kd = float(found.attenuation_per_m[_GREEN]), float(downwelling_per_m(found)[_GREEN])
    if c == 0:
        return Clarity(np.inf, np.inf)
    return Clarity(water.visibility_constant / c, _SECCHI / (c + kd))


def _coefficients(water: WaterConfig, path_m: float, light: Light) -> tuple[Array, Array]:
    own = {"absorption_per_m": water.absorption_per_m, "scattering_per_m": water.scattering_per_m}
    given = [key for key, value in own.items() if value is not None]
    if given and water.spectrum_file is not None:
        raise TwinError(f"water.{given[0]}", "given twice, as there is a water.spectrum_file", "one of them")
    if len(given) == 1:
        missing = next(key for key in own if key not in given)
        raise TwinError(f"water.{missing}", f"missing, as there is a water.{given[0]}", "both or none")
    if given:
        return np.array(water.absorption_per_m), np.array(water.scattering_per_m)
    if water.spectrum_file is not None:
        absorption, scattering = read_spectrum(Path(water.spectrum_file))
    elif water.jerlov == "clear":
        return np.zeros(3), np.zeros(3)
    else:
        absorption, scattering = water_spectrum(water.jerlov, water.source)
    weights = band_weights(spectrum_of(light))
    return effective_per_m(absorption, weights, path_m), effective_per_m(scattering, weights)


def read_spectrum(file: Path) -> tuple[Array, Array]:
    """Returns absorption and scattering (n,) [1/m] at `NM` from comma-separated rows of nm, a, b; # is a comment.

    Raises TwinError where the file cannot be read, is larger than `MAX_SPECTRUM_BYTES` or has another form, its
    wavelengths do not increase or do not cover 400 to 700 nm, or a value is negative or not finite.
    """
    key = "water.spectrum_file"
    wanted = "rows of wavelength [nm], absorption, scattering [1/m]"
    with reading(file, key, wanted, MAX_SPECTRUM_BYTES), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # an empty file
        table = np.loadtxt(file, delimiter=",", comments="#", ndmin=2, encoding="utf-8-sig")
    if table.shape[1] != 3 or len(table) < 2:
        raise TwinError(key, f"{file} has {table.shape[1]} columns and {len(table)} rows", "3 columns, 2 rows or more")
    nm = table[:, 0]
    if not (np.diff(nm) > 0).all():
        raise TwinError(key, f"{file}: wavelengths do not increase", "strictly increasing [nm]")
    low, high = NM[0], NM[-1]
    if nm[0] > low or nm[-1] < high:
        raise TwinError(key, f"{file} covers {nm[0]:g} to {nm[-1]:g} nm", f"{low:g} to {high:g} or more")
    if not (np.isfinite(table).all() and (table[:, 1:] >= 0).all()):
        row = int(np.argmin((np.isfinite(table) & (table >= 0)).all(axis=1)))
        raise TwinError(key, f"{file}: negative or not finite at {nm[row]:g} nm", "0 or more [1/m]")
    absorption, scattering = (np.interp(NM, nm, values) for values in table[:, 1:].T)
    return absorption, scattering


def downwelling_per_m(water: Medium, mean_cosine: float = 1.0) -> Array:
    """Returns the diffuse attenuation of daylight with depth, Kd (3,) [1/m], for a mean cosine mu0 below the surface.

    Kirk (1984, Limnol. Oceanogr. 29, 350): Kd = sqrt(a^2 + G a b) / mu0, G = 0.425 mu0 - 0.19, a fit to Monte Carlo
    down to the depth that 1 % of the light reaches. `light_field` agrees within 4 % for Petzold, b / a of 2 to 6.
    """
    a, b = water.absorption_per_m, water.scattering_per_m
    return np.sqrt(a**2 + (0.425 * mean_cosine - 0.19) * a * b) / mean_cosine
