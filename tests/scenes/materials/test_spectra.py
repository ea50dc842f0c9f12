"""Sunlight and camera RGB against Planck's law, closed forms and colour-science's own integration."""

import subprocess
import sys

import numpy as np
import pytest

from spacesim.data.errors import InputError
from spacesim.scenes.materials import spectra


def test_table_holds_the_nominal_sun_but_for_its_ends():
    """A black body of 5772 K has 1.2 % of its power below 280 nm and 0.9 % above 4000 nm."""
    wavelength, irradiance = spectra.solar_spectrum()
    assert wavelength[0] == 280
    assert wavelength[-1] == 4000
    assert np.trapezoid(irradiance, wavelength) == pytest.approx(1361 * 1347.93 / 1366.1, rel=1e-3)


def test_plancks_law_gives_the_solar_constant():
    wavelength = np.geomspace(50, 1e6, 200_001)
    assert np.trapezoid(spectra.planck(wavelength), wavelength) == pytest.approx(1361, rel=1e-3)
    peak = wavelength[spectra.planck(wavelength).argmax()]
    assert peak == pytest.approx(2897771.955 / 5772, rel=1e-3)  # Wien, nm


@pytest.mark.parametrize(
    ("low", "high", "tolerance"),
    [(380, 780, 0.04), (400, 500, 0.09), (500, 600, 0.065), (600, 700, 0.04), (700, 1000, 0.02), (1000, 2500, 0.10)],
)
def test_bands_are_those_of_a_black_sun(low, high, tolerance):
    """Tolerances are what the real Sun's lines and the H- opacity minimum at 1.6 um leave."""
    wavelength = np.linspace(low, high, 2001)
    expected = np.trapezoid(spectra.planck(wavelength), wavelength)
    assert spectra.band_irradiance(low, high) == pytest.approx(expected, rel=tolerance)


def test_bands_add_up_and_scale():
    parts = spectra.band_irradiance(380, 555) + spectra.band_irradiance(555, 780)
    assert parts == pytest.approx(spectra.band_irradiance(), rel=1e-6)
    assert spectra.band_irradiance(total=100.0) == pytest.approx(spectra.band_irradiance() * 100 / 1361)
    with pytest.raises(InputError, match="280 to 4000"):
        spectra.band_irradiance(200, 500)


def test_sunlight_is_white_and_has_its_irradiance():
    np.testing.assert_allclose(spectra.camera_rgb(*spectra.solar_spectrum()), 1361.0, rtol=1e-6)
    np.testing.assert_array_equal(spectra.sun_rgb(total=50.0), [50.0, 50.0, 50.0])


def test_d65_balance_agrees_with_colour_science():
    """Chromaticity of sunlight by colour-science's integration, and luminance equal to the irradiance."""
    rgb = spectra.sun_rgb("d65")
    assert rgb @ [0.2126, 0.7152, 0.0722] == pytest.approx(1361, rel=1e-3)
    colour = spectra._colour_science()
    wavelength = np.arange(360.0, 781.0)
    irradiance = np.interp(wavelength, *spectra.solar_spectrum())
    sun = colour.SpectralDistribution(dict(zip(wavelength, irradiance, strict=True)))
    xyz = colour.sd_to_XYZ(sun, method="Integration", k=1.0)
    expected = colour.XYZ_to_RGB(xyz, "sRGB", illuminant=None)
    np.testing.assert_allclose(rgb / rgb.sum(), expected / expected.sum(), atol=1e-3)
    assert rgb[0] > rgb[1] > rgb[2], "sunlight is yellower than D65"
    with pytest.raises(InputError, match="sun, d65"):
        spectra.sun_rgb("d50")


def test_albedo_of_flat_and_stepped_spectra():
    np.testing.assert_allclose(spectra.albedo_rgb([(300, 0.4), (2500, 0.4)]), 0.4, rtol=1e-6)
    red = spectra.albedo_rgb([(580, 0.0), (600, 1.0)])
    blue = spectra.albedo_rgb([(490, 1.0), (500, 0.0)])
    assert red[0] == 1.0, "clipped"
    assert red[2] < 0.01
    assert blue[2] > 0.8
    assert blue[0] == 0.0
    both = spectra.camera_rgb([380, 780], [1.0, 1.0]) / 1361
    assert (both > 0).all()


def test_solar_reflectance_is_weighted_with_sunlight():
    assert spectra.solar_reflectance([(300, 0.3), (2500, 0.3)]) == pytest.approx(0.3)
    step = spectra.solar_reflectance([(699.9, 0.0), (700.1, 1.0)], 300, 2500)
    assert step == pytest.approx(spectra.band_irradiance(700, 2500) / spectra.band_irradiance(300, 2500), rel=1e-3)


def test_colour_science_leaves_no_trace_and_is_not_needed_for_presets():
    code = (
        "import sys, warnings; warnings.simplefilter('error')\n"
        "from spacesim.scenes.materials import spectra, table\n"
        "table.material('white-paint'); spectra.sun_rgb('sun')\n"
        "assert 'colour' not in sys.modules\n"
        "spectra.sun_rgb('d65')\n"
        "assert 'colour' in sys.modules\n"
        "mocks = [n for n, m in sys.modules.items() if type(m).__name__ == 'MagicMock']\n"
        "assert not mocks, mocks\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
