"""Spectra and what a camera makes of them: sunlight, Planck's law, linear camera RGB, albedo.

Camera RGB is in linear sRGB primaries (IEC 61966-2-1) for the CIE 1931 2 degree observer. Under the white balance
"sun", each channel is divided by its value for sunlight and multiplied by the sunlight's total irradiance, so
that sunlight of E W m^-2 has the value E in R, G and B. Under "d65" only one factor is common to all: sunlight of
E W m^-2 has the luminance E, and is a little yellower than D65.

The observer's tables are those of colour-science, colorimetry's reference implementation in Python: typed by hand
they could not be trusted. Its import takes half a second to a second, so it happens on first use; presets of
materials carry their albedo and need none of it (a test computes them again).
"""

import sys
import warnings
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike

from spacesim.data.earth import ASTRONOMICAL_UNIT_KM, SOLAR_RADIUS_KM
from spacesim.data.errors import InputError
from spacesim.data.geometry import Array
from spacesim.scenes.lights.sun import SOLAR_IRRADIANCE

TABLE = Path(__file__).parents[2] / "assets" / "solar_spectrum.csv"

TABLE_IRRADIANCE = 1366.1  #: total irradiance of the table's spectrum over all wavelengths, W m^-2 (ASTM E490-00a)

SOLAR_TEMPERATURE = 5772.0  #: kelvin, nominal effective temperature (IAU 2015 Resolution B3)

PLANCK, LIGHT_SPEED, BOLTZMANN = 6.62607015e-34, 2.99792458e8, 1.380649e-23  #: SI, exact since 2019

VISIBLE = (380.0, 780.0)  #: nm
WHITE_BALANCES = ("sun", "d65")

Spectrum = Sequence[tuple[float, float]]  #: (wavelength nm, value), wavelengths ascending


@cache
def solar_spectrum() -> tuple[Array, Array]:
    """(wavelengths [N] nm, spectral irradiance [N] W m^-2 nm^-1) at 1 AU, from 280 to 4000 nm, in total that of the
    nominal Sun."""
    wavelength, irradiance = np.loadtxt(TABLE, delimiter=",", unpack=True)
    irradiance *= SOLAR_IRRADIANCE / TABLE_IRRADIANCE
    wavelength.setflags(write=False)
    irradiance.setflags(write=False)
    return wavelength, irradiance


def band_irradiance(low: float = VISIBLE[0], high: float = VISIBLE[1], total: float = SOLAR_IRRADIANCE) -> float:
    """W m^-2 of sunlight between the wavelengths `low` and `high` (nm, within 280 to 4000), where `total` is its
    irradiance over all wavelengths. Raises InputError for another range."""
    wavelength, _ = solar_spectrum()
    if not wavelength[0] <= low < high <= wavelength[-1]:
        raise InputError(f"band: expected wavelengths from 280 to 4000 nm, the lower first, found {low:g} to {high:g}")
    band, values = _sunlight(low, high)
    return float(np.trapezoid(values, band)) * total / SOLAR_IRRADIANCE


def planck(wavelength_nm: ArrayLike, kelvin: float = SOLAR_TEMPERATURE) -> Array:
    """Spectral irradiance [N] W m^-2 nm^-1 at 1 AU of a black Sun: Planck's law times its solid angle's cosine
    integral, pi (R / d)^2."""
    wavelength = np.asarray(wavelength_nm, dtype=np.float64) * 1e-9
    exponent = PLANCK * LIGHT_SPEED / (wavelength * BOLTZMANN * kelvin)
    radiance = 2.0 * PLANCK * LIGHT_SPEED**2 / wavelength**5 / np.expm1(exponent)  # W m^-3 sr^-1
    return 1e-9 * np.pi * (SOLAR_RADIUS_KM / ASTRONOMICAL_UNIT_KM) ** 2 * radiance


@cache
def response(white_balance: str = "sun") -> tuple[Array, Array]:
    """(wavelengths [N] nm, response [N, 3]) of the camera: a spectrum S has the camera RGB sum of S(w) response(w),
    S in W nm^-1 per whatever unit the RGB shall have. Raises InputError for an unknown white balance."""
    if white_balance not in WHITE_BALANCES:
        raise InputError(f"white_balance: expected one of {', '.join(WHITE_BALANCES)}, found {white_balance!r}")
    colour = _colour_science()
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    matrix = np.asarray(colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB)
    step = np.gradient(observer.wavelengths)
    wavelength, xyz = np.array(observer.wavelengths), np.array(observer.values) * step[:, None]
    rgb = xyz @ matrix.T
    sunlight = np.interp(wavelength, *solar_spectrum())
    scale = SOLAR_IRRADIANCE / (sunlight @ rgb if white_balance == "sun" else sunlight @ xyz[:, 1])
    weights = rgb * scale
    wavelength.setflags(write=False)
    weights.setflags(write=False)
    return wavelength, weights


def camera_rgb(wavelength_nm: Array, values: Array, white_balance: str = "sun") -> Array:
    """Linear camera RGB [3] of a spectrum: `values` [N] (irradiance W m^-2 nm^-1 or radiance W m^-2 sr^-1 nm^-1) at
    `wavelength_nm` [N], ascending, linear between them and 0 beyond; the result in W m^-2 or W m^-2 sr^-1."""
    wavelength, weights = response(white_balance)
    return np.interp(wavelength, wavelength_nm, values, left=0.0, right=0.0) @ weights


def sun_rgb(white_balance: str = "sun", total: float = SOLAR_IRRADIANCE) -> Array:
    """Linear camera RGB [3] of sunlight of irradiance `total`, W m^-2."""
    if white_balance == "sun":
        return np.full(3, float(total))
    return camera_rgb(*solar_spectrum(), white_balance) * (total / SOLAR_IRRADIANCE)


def albedo_rgb(reflectance: Spectrum) -> Array:
    """Linear camera RGB reflectance [3] of a `reflectance` table under sunlight, constant beyond its ends and
    clipped to [0, 1]: a saturated surface can lie outside of the sRGB primaries' gamut."""
    wavelength, weights = response("sun")
    sunlight = np.interp(wavelength, *solar_spectrum())
    return np.clip((sunlight * reflectance_at(reflectance, wavelength)) @ weights / SOLAR_IRRADIANCE, 0.0, 1.0)


def solar_reflectance(reflectance: Spectrum, low: float = 300.0, high: float = 2500.0) -> float:
    """Mean of a `reflectance` table weighted with sunlight between `low` and `high` nm; 1 - it is the solar
    absorptance of an opaque surface."""
    wavelength, irradiance = _sunlight(low, high)
    return float(
        np.trapezoid(irradiance * reflectance_at(reflectance, wavelength), wavelength)
        / np.trapezoid(irradiance, wavelength)
    )


def reflectance_at(reflectance: Spectrum, wavelength_nm: ArrayLike) -> Array:
    """The table at `wavelength_nm` [N]: linear between its rows, constant beyond."""
    table = np.asarray(reflectance, dtype=np.float64)
    return np.interp(np.asarray(wavelength_nm, dtype=np.float64), table[:, 0], table[:, 1])


def _sunlight(low: float, high: float) -> tuple[Array, Array]:
    """(wavelengths, spectral irradiance) of sunlight from `low` to `high` nm, 1 nm apart."""
    wavelength = np.linspace(low, high, max(2, round(high - low) + 1))
    return wavelength, np.interp(wavelength, *solar_spectrum())


def _colour_science() -> ModuleType:
    """colour-science, without its warning that Matplotlib is missing and without the mocks of Matplotlib that it
    would leave behind for everyone else."""
    from unittest.mock import Mock  # 0.1 s

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    for name in [name for name, module in sys.modules.items() if isinstance(module, Mock)]:
        del sys.modules[name]
    return colour
