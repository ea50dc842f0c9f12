"""Tensors to Dr.Jit's arrays and back, without a copy where memory allows."""

import drjit as dr
import torch
from torch import Tensor

from spacesim.backend import ad
from spacesim.backend.arrays import Float, Int32, NumberT

ALIGNED = 64  #: bytes to a multiple of which torch allocates on a CPU
PACKET = 16  #: bytes to a multiple of which CUDA reads packets
WIDEST = 16  #: numbers of a row that a kernel reads or stores at once, at most


def to_floats(tensor: Tensor) -> Float:
    """A tensor of float32 as one flat Float, without a copy where it is contiguous and aligned: elsewhere a kernel on
    LLVM could read beyond its last page, see `spacesim.backend.upload`, and one on CUDA reads no packets."""
    flat = tensor.detach().reshape(-1)
    return ad.Float(flat if flat.data_ptr() % (PACKET if flat.is_cuda else ALIGNED) == 0 else flat.clone())


def column(flat: Float, index: int, size: int, count: int) -> Float:
    """Column `index` of a flat array [count * size], in memory of Dr.Jit's own: what torch has may lie otherwise, and
    each way to lie is recorded anew."""
    rows = dr.arange(ad.UInt32, count)
    return dr.gather(ad.Float, flat, rows * size + index, mode=dr.ReduceMode.Permute)


def row_parts(flat: Float, used: int, size: int, count: int) -> list[Float]:
    """The first `used` columns of a flat array [count * size], as `column` gives them. Rows are read in packets of
    WIDEST numbers or fewer that divide them: on a CPU a packet is several times as fast as its columns one by one."""
    packet = _packet(size)
    if packet == 1:
        return [column(flat, i, size, count) for i in range(used)]
    rows = dr.arange(ad.UInt32, count) * (size // packet)
    parts: list[Float] = []
    for first in range(0, used, packet):
        place = rows + first // packet
        parts += list(dr.gather(ad.ArrayXf, flat, place, mode=dr.ReduceMode.Permute, shape=(packet, count)))
    return parts[:used]


def _packet(size: int) -> int:
    """Numbers that a kernel reads or stores at once of a row of `size`."""
    return next(width for width in (WIDEST, 8, 4, 2, 1) if size % width == 0)


def columns(tensor: Tensor) -> list[Float]:
    """The columns of a tensor [count, size], Floats; not evaluated."""
    flat, size = to_floats(tensor), tensor.shape[-1]
    return [column(flat, i, size, len(tensor)) for i in range(size)]


def rows(values: list[NumberT], size: int, count: int, capacity: int | None = None) -> NumberT:
    """A flat array [capacity * size] whose first `count` rows are `values` (at least one column, at most `size`) side
    by side; what is missing of a row is 0. One kernel writes it, in packets of at most WIDEST numbers that divide a
    row; `dr.concat` would launch one for each column.

    capacity: `count` by default; in a recording a number that is an argument of it, by `round_capacity`: what a
    recording allocates stays as large as it was when it was recorded"""
    kind = type(values[0])
    packet = _packet(size)
    packets = size // packet
    whole = len(values) + packet > size  # packets that hold a value are all that there are
    length = size * (count if capacity is None else capacity)
    target = dr.empty(kind, length) if whole else dr.zeros(kind, length)
    place = dr.arange(ad.UInt32, count) * packets
    values = values + [kind(0)] * (-len(values) % packet)
    for first in range(0, len(values), packet):
        own = values[first : first + packet]
        stored = (ad.ArrayXi if kind is ad.Int32 else ad.ArrayXf)(own) if packet > 1 else own[0]
        dr.scatter(target, stored, place + first // packet, mode=dr.ReduceMode.Permute)
    return target


def as_base(tensor: Tensor) -> Tensor:
    """The same memory, shape and strides, but to torch no view of another tensor: what an operation of torch's returns
    may then be changed in place by the caller."""
    base = torch.empty(0, dtype=tensor.dtype, device=tensor.device)
    return base.set_(tensor.untyped_storage(), tensor.storage_offset(), tensor.shape, tensor.stride())


def to_table(flat: Float | Int32, count: int, size: int) -> Tensor:
    """The first `count` rows of a flat array of at least as many rows of `size`: a tensor [count, size]."""
    return to_tensor(flat).as_strided((count, size), (size, 1))


def to_tensor(flat: Float | Int32) -> Tensor:
    """A flat array as a tensor that shares its memory."""
    tensor: Tensor = torch.from_dlpack(dr.detach(flat))
    return tensor
