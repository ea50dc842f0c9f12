"""Gradient noise on Dr.Jit: sums of octaves, each left out where a pixel is wider than its cells."""

import drjit as dr

from spacesim import backend
from spacesim.backend import mitsuba_types as mt
from spacesim.backend.arrays import Bool, Float, UInt32

_PRIMES = (0x8DA6B343, 0xD8163841, 0xCB1AB31F)  # spread the coordinates of a cell's corner over 32 bits
LACUNARITY = 2.17  #: frequency of an octave over that of the one before: cells of two octaves do not line up


def octaves(point: mt.Point3f, seed: UInt32, count: int, frequency: float, gain: float, width: Float) -> mt.Vector3f:
    """The sum of at most `count` octaves of noise, three independent ones, about -1 to 1.

    frequency: cells a unit of the first octave; gain: amplitude of each octave over that
    of the one before; width: of a pixel at the point, in units of `point`: octaves fade out from half a cell a pixel on
    (A. Apodaca, L. Gritz, "Advanced RenderMan", 2000, 11.3: clamping).
    """
    mi = backend.mitsuba()

    def within(k: UInt32, scale: Float, *_: object) -> Bool:
        return (k < count) & (scale * width < 1)

    def add(k: UInt32, scale: Float, weight: Float, total: mt.Vector3f) -> tuple[UInt32, Float, Float, mt.Vector3f]:
        shown = dr.clip(2 - 2 * scale * width, 0, 1)
        value = gradient_noise(point * scale, seed + k * 0x9E3779B9)
        return k + 1, scale * LACUNARITY, weight * gain, total + weight * shown * value

    start = mi.UInt32(0), mi.Float(frequency), mi.Float(1), mi.Vector3f(0)
    return dr.while_loop(start, within, add, labels=("k", "scale", "weight", "total"))[3]


def gradient_noise(point: mt.Point3f, seed: UInt32) -> mt.Vector3f:
    """Three independent noises at `point`, from -1 to 1: 0 at the corners of the cells of side 1, where
    each has a gradient drawn at random (K. Perlin, "Improving noise", 2002, with his fifth-degree blend)."""
    mi = backend.mitsuba()
    cell = dr.floor(point)
    f = point - cell
    blend = f * f * f * (f * (f * 6 - 15) + 10)
    corner = [mi.UInt32(mi.Int32(c)) for c in cell]
    total = mi.Vector3f(0)
    for number in range(8):
        bits = [(number >> axis) & 1 for axis in range(3)]
        key = seed
        for axis in range(3):
            key = key ^ ((corner[axis] + bits[axis]) * _PRIMES[axis])
        away = mi.Vector3f(*(f[axis] - bits[axis] for axis in range(3)))
        weight = mi.Float(1)
        for axis in range(3):
            weight *= blend[axis] if bits[axis] else 1 - blend[axis]
        values = []
        for _ in range(3):
            key = _scramble(key)
            values.append(dr.dot(_vector(key), away))
        total += weight * mi.Vector3f(*values)
    return total


def _scramble(key: UInt32) -> UInt32:
    """A permutation of 32 bits (C. Wellons' "lowbias32", 2018)."""
    key = (key ^ (key >> 16)) * 0x7FEB352D
    key = (key ^ (key >> 15)) * 0x846CA68B
    return key ^ (key >> 16)


def _vector(key: UInt32) -> mt.Vector3f:
    """A vector in the cube from -1 to 1, of 30 of the bits."""
    mi = backend.mitsuba()
    return mi.Vector3f(*(mi.Float((key >> shift) & 1023) * (2 / 1023) - 1 for shift in (0, 10, 20)))
