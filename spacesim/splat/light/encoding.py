"""Unit directions and points as the numbers that networks read (psi of thesis 4.2)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import drjit as dr

from spacesim.backend.arrays import Float
from spacesim.backend.upload import upload_numbers
from spacesim.data.errors import check_ranges
from spacesim.data.geometry import Array
from spacesim.data.structure import check_fields


@dataclass(frozen=True)
class Encoding:
    """Real spherical harmonics of a unit direction up to `degree`, (degree + 1)^2 numbers (thesis, tables 4.1 and 4.2),
    or "positional": the three coordinates, and sine and cosine of 2^k pi times each for k < degree, 3 + 6 degree
    numbers (Mildenhall et al. 2020; thesis, table 4.3).

    Raises InputError for another kind or a degree that has no meaning.
    """

    kind: Literal["harmonics", "positional"] = "harmonics"  #: spherical harmonics, or sines and cosines
    degree: int = 4  #: of the harmonics, or how many octaves; 0 to 9

    def __post_init__(self) -> None:
        check_fields(self)
        check_ranges(self, degree=(0, 9))

    @property
    def size(self) -> int:
        """How many numbers."""
        return (self.degree + 1) ** 2 if self.kind == "harmonics" else 3 + 6 * self.degree

    def __call__(self, vectors: Any) -> list[Any]:
        """`size` Floats [N] of vectors, Array3f [3, N], or numbers of one vector, Dr.Jit's scalar Array3f64."""
        if self.kind == "harmonics":
            return list(dr.sh_eval(vectors, self.degree))
        terms = list(vectors)
        for k in range(self.degree):
            for value in vectors:
                terms += dr.sincos(value * (2**k * dr.pi))
        return terms

    def of_one(self, vector: Sequence[float] | Array) -> Float:
        """Float [size] of one vector, three numbers, by the host. They are no constants of a kernel: others compile
        nothing."""
        return upload_numbers([float(term) for term in self(dr.scalar.Array3f64([float(number) for number in vector]))])
