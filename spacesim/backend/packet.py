"""Packets: numbers side by side in memory, which a thread reads at once."""

from typing import Any

import drjit as dr

from spacesim.backend.arrays import Bool, Float, UInt32
from spacesim.backend.selection import ad


def gather_packet(array: Float, index: UInt32, size: int, active: Bool | bool = True) -> Any:
    """Packet `index` of `size` numbers, 2, 4 or 8: an Array2f, Array4f or ArrayXf; 0 where not `active`."""
    if size == 8:
        return dr.gather(ad.ArrayXf, array, index, active, shape=(size, dr.width(index)))
    return dr.gather(ad.Array4f if size == 4 else ad.Array2f, array, index, active)
