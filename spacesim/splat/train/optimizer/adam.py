"""Adam (Kingma & Ba 2015) over rows of parameters, whose moments follow when Gaussians come and go."""

from collections.abc import Sequence

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Bool, Float, UInt32
from spacesim.backend.upload import upload
from spacesim.learning.adam import AdamSteps
from spacesim.splat.raster.gaussians import ROWS, gather_entries
from spacesim.splat.train.optimizer.packing import (
    Layout,
    load,
    pack_numpy,
    plan_packing,
    release,
    store,
    unpack_numpy,
    zeros,
)

OWN = ROWS["sh"].start  #: rows of place, shape and opacity; harmonics or features come behind
CONSTANT = 3  #: rows of the constant harmonic, which are moved with them
PART = 15  #: rows of harmonics that are moved at once: five coefficients


class Adam(AdamSteps):
    """Moments of the rows of Gaussians (`Gaussians.rows`), part by part, those of a part in few arrays (`packing`).

    slices: the rows of each part; features, a packed row, are none
    layouts, arrays: how the moments of each part lie, and where
    features: their two moments [F * N], or none
    source: which each Gaussian was at the last `take_source`, UInt32 [N]; None: all are what they were
    """

    def __init__(self, rows: list[Float]) -> None:
        self.slices, count = parts(len(rows)), dr.width(rows[0])
        self.source: UInt32 | None = None
        self.arrays: list[list[Float]] = []
        self.layouts: list[Layout] = []
        self._lay_out(count)
        sizes = [rows.stop - rows.start for rows in self.slices]
        self.arrays = [zeros(layout, size, count) for layout, size in zip(self.layouts, sizes, strict=True)]
        self.features = [dr.opaque(ad.Float, 0, dr.width(row)) for row in 2 * rows[self.slices[-1].stop :]]

    def take_source(self) -> UInt32 | None:
        """`source`, counted anew from now on."""
        source, self.source = self.source, None
        return source

    def select(self, index: UInt32, fresh: Bool) -> None:
        """Entry i of each moment becomes entry index[i], or zero where `fresh[i]`. index, fresh: [M]."""
        before, count, chosen = self.layouts, self.count, dr.width(index)
        self.source = ad.UInt32(index) if self.source is None else dr.gather(ad.UInt32, self.source, index)
        dr.eval(self.source)
        self._lay_out(chosen)
        for number, (old, new) in enumerate(zip(before, self.layouts, strict=True)):
            pairs = load(self.arrays[number], old, index)
            first, second = ([dr.select(fresh, 0, moment) for moment in moments] for moments in pairs)
            arrays = store(first, second, new)
            dr.eval(arrays)
            self.arrays[number] = arrays  # part by part, so that old ones go as new ones come
            del pairs, first, second, arrays
            release(count, chosen)
        size = dr.opaque(ad.UInt32, chosen)  # as a literal each size would be compiled
        for number, moment in enumerate(self.features):
            copies = dr.width(moment) // count
            forget = dr.gather(ad.Bool, fresh, dr.arange(ad.UInt32, copies * chosen) % size)
            self.features[number] = dr.select(forget, 0, gather_entries(moment, index, count))
        dr.eval(self.features)

    def forget(self, row: int) -> None:
        """Set the moments of a row to zero."""
        number = next(i for i, rows in enumerate(self.slices) if rows.start <= row < rows.stop)
        within, layout = row - self.slices[number].start, self.layouts[number]
        first, second = load(self.arrays[number], layout, dr.arange(ad.UInt32, self.count))
        first[within], second[within] = (dr.opaque(ad.Float, 0, self.count) for _ in range(2))
        self.arrays[number] = store(first, second, layout)
        dr.eval(self.arrays[number])

    def moments(self) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """The first and the second moment of each row, float32 [N], and of the features [F * N]."""
        first, second = list[np.ndarray](), list[np.ndarray]()
        for arrays, layout in zip(self.arrays, self.layouts, strict=True):
            first_moments, second_moments = unpack_numpy(arrays, layout, self.count)
            first, second = first + first_moments, second + second_moments
        features = [np.array(moment) for moment in self.features]
        return first + features[:1], second + features[1:]

    def put(self, first: Sequence[np.ndarray], second: Sequence[np.ndarray]) -> None:
        """The inverse of `moments`."""
        for number, (rows, layout) in enumerate(zip(self.slices, self.layouts, strict=True)):
            self.arrays[number] = pack_numpy(first[rows], second[rows], layout)
        last = self.slices[-1].stop
        self.features = [upload(moment) for moment in (*first[last:], *second[last:])]

    def _lay_out(self, count: int) -> None:
        self.count = count
        self.layouts = [plan_packing(rows.stop - rows.start, count) for rows in self.slices]


def parts(rows: int) -> list[slice]:
    """Rows that are moved at once, of so many (`Gaussians.rows`) without features: those of place, shape and opacity
    with the constant harmonic, where there are harmonics, then `PART` each."""
    drawn = rows - (rows % 3 == 0)  # 11, and harmonics come in threes
    first = min(OWN + CONSTANT, drawn)
    return [slice(0, first), *(slice(start, min(start + PART, drawn)) for start in range(first, drawn, PART))]
