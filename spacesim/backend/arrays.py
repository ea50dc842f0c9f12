"""Names of Dr.Jit's array types for annotations: `Float` is `ad.Float` of whichever backend runs.

A type checker and an editor read Dr.Jit's own stubs, in which `dr.gather(ad.Float, ...)` is a `Float` and a comparison
a `Bool`. At run time the names stand for anything, and neither Dr.Jit nor a backend is loaded for them.
"""

from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from drjit.auto.ad import (
        Array2f,
        Array2u64,
        Array3f,
        Array4f,
        ArrayXf,
        Bool,
        Float,
        Float64,
        Int32,
        TensorXf,
        UInt32,
        UInt64,
    )
else:
    Array2f = Array2u64 = Array3f = Array4f = ArrayXf = Bool = Any
    Float = Float64 = Int32 = TensorXf = UInt32 = UInt64 = Any

ArrayT = TypeVar("ArrayT", Float, Array3f)  #: the same type in and out
NumberT = TypeVar("NumberT", Float, UInt32, Int32)  #: the same type in and out, of one dimension

__all__ = [
    "Array2f",
    "Array2u64",
    "Array3f",
    "Array4f",
    "ArrayT",
    "ArrayXf",
    "Bool",
    "Float",
    "Float64",
    "Int32",
    "NumberT",
    "TensorXf",
    "UInt32",
    "UInt64",
]
