"""Unit directions and points as the numbers that networks read (psi of thesis 4.2)."""

from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad
from spacesim.data.errors import InputError

KINDS = ("harmonics", "positional")


@dataclass(frozen=True)
class Encoding:
    """kind "harmonics": real spherical harmonics of a unit direction up to `degree`, (degree + 1)^2 numbers (thesis,
    tables 4.1 and 4.2);  kind "positional": the three coordinates, and sine and cosine of 2^k pi times each for
    k < degree, 3 + 6 degree numbers (Mildenhall et al. 2020; thesis, table 4.3).

    Raises InputError for another kind or a degree that has no meaning.
    """

    kind: str = "harmonics"
    degree: int = 4

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"encoding: expected one of {', '.join(KINDS)}, found {self.kind!r}")
        if not 0 <= self.degree <= 9:
            raise InputError(f"encoding: expected a degree of 0 to 9, found {self.degree}")

    @property
    def size(self) -> int:
        """How many numbers."""
        return (self.degree + 1) ** 2 if self.kind == "harmonics" else 3 + 6 * self.degree

    def __call__(self, vectors: Any) -> list[Any]:
        """`size` Floats [N] of vectors Array3f [3, N]."""
        if self.kind == "harmonics":
            return list(dr.sh_eval(vectors, self.degree))
        terms = list(vectors)
        for k in range(self.degree):
            for value in vectors:
                terms += dr.sincos(value * (2**k * dr.pi))
        return terms

    def of_one(self, vector: Any) -> Any:
        """Float [size] of one vector, three numbers. They are no constants of a kernel: others compile nothing."""
        numbers = ad.Float([float(number) for number in vector])  # no numpy array: see `backend.recorded`
        point = ad.Array3f([dr.gather(ad.Float, numbers, ad.UInt32(i)) for i in range(3)])
        return dr.concat([ad.Float(term) for term in self(point)])
