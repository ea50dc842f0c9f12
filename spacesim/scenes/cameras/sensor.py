"""A sensor: electrons, noise and digital numbers.

It follows the linear camera model of EMVA standard 1288 (release 4.0 Linear, 2021, chapter 2): electrons are
counted with Poisson statistics, dark ones among them; the amplifier adds normal noise; the system gain turns electrons
into digital numbers (DN), which are rounded. Left out are nonuniformity of pixels, blooming, a colour filter array.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spacesim.data.errors import expect

_MAX_ELECTRONS = 1e12  # far above any full well; Poisson numbers end at 2^63


@dataclass(frozen=True)
class SensorConfig:
    """A sensor that records the linear image. Raises InputError for a value out of range. The defaults
    describe a generic low-noise CMOS sensor of 12 bits."""

    psf_sigma_px: float = 0.0  #: standard deviation of a Gaussian point spread function, pixels
    full_well_e: float = 10_000.0  #: electrons at which a pixel is full, which is also what a display value of 1 makes
    shot_noise: bool = True  #: Poisson statistics of electrons
    dark_e: float = 0.0  #: mean electrons of a frame without light
    read_noise_e: float = 2.5  #: standard deviation of the amplifier's noise, electrons
    bits: int = 12  #: of a digital number
    black_level_dn: int = 64  #: digital number of no electrons
    gain_dn_per_e: float | None = None  #: digital numbers an electron makes, None: a full well makes the highest
    monochrome: bool = False  #: one number a pixel, of the mean of R, G and B

    def __post_init__(self) -> None:
        expect(0 <= self.psf_sigma_px <= 100, "psf_sigma_px", "0 to 100 pixels", self.psf_sigma_px)
        expect(1 <= self.full_well_e <= 1e9, "full_well_e", "1 to 1e9 electrons", self.full_well_e)
        for name in ("dark_e", "read_noise_e"):
            expected = f"electrons from 0 to the full well's {self.full_well_e:g}"
            expect(0 <= getattr(self, name) <= self.full_well_e, name, expected, getattr(self, name))
        expect(1 <= self.bits <= 16, "bits", "1 to 16", self.bits)
        expected = f"at least 0, below {self.highest}, the highest of {self.bits} bits"
        expect(0 <= self.black_level_dn < self.highest, "black_level_dn", expected, self.black_level_dn)
        if self.gain_dn_per_e is not None:
            expected = "digital numbers an electron, above 0"
            expect(0 < self.gain_dn_per_e < math.inf, "gain_dn_per_e", expected, self.gain_dn_per_e)

    @property
    def highest(self) -> int:
        """The highest digital number."""
        return 2**self.bits - 1

    @property
    def gain(self) -> float:
        """Digital numbers that an electron makes: EMVA 1288's system gain K."""
        return self.gain_dn_per_e or (self.highest - self.black_level_dn) / self.full_well_e

    def expose(self, light: np.ndarray, random: np.random.Generator) -> NDArray[np.uint16]:
        """Digital numbers of linear `light` [H, W], or [H, W, C] for a sensor a channel, of which 1 fills the well."""
        if self.psf_sigma_px > 0:  # what lies beyond the border is taken to be as bright as the border
            from scipy.ndimage import gaussian_filter  # a tenth of a second, that cameras without it need not wait

            axes = (self.psf_sigma_px, self.psf_sigma_px, 0.0)[: light.ndim]
            light = gaussian_filter(light, axes, mode="nearest", truncate=5.0)
        electrons = np.clip(self.full_well_e * light + self.dark_e, 0, _MAX_ELECTRONS)
        if self.shot_noise:
            electrons = random.poisson(electrons).astype(np.float64)
        electrons = np.minimum(electrons, self.full_well_e)
        if self.read_noise_e > 0:
            electrons = electrons + random.normal(0.0, self.read_noise_e, electrons.shape)
        numbers = np.rint(self.black_level_dn + self.gain * electrons)
        return np.clip(numbers, 0, self.highest).astype(np.uint16)
