"""Light along rays on a CPU, as text for LLVM: sixteen rays of a Gaussian side by side.

Dr.Jit's lanes, a Gaussian each, read the rays of sixteen Gaussians from sixteen places, and wait for the longest list.
"""

from functools import cache, partial

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Float
from spacesim.backend.kernels.llvm import LlvmKernel, empty
from spacesim.backend.kernels.llvm_text import LANES, Text, Value
from spacesim.splat.light.bounce import Parts, Rays, ray_share, ray_weights
from spacesim.splat.light.surroundings import Surroundings

BLOCK = 64  #: Gaussians of a task
_AXES = "x", "y", "z"


def gather_light(
    surroundings: Surroundings, emitted: list[Float], emitters: int, rays: Rays, parts: Parts
) -> list[Float]:
    """Light that arrives along rays, three Floats [M], RGB, for each weight of these parts. emitted: of
    `bounce.emission`, by so many `emitters`"""
    count = dr.width(rays.begin)
    results = [empty(ad.Float, count) for _ in range(3 * parts.count)]
    axes = [*rays.normals, *(rays.direction if parts.mirrored and rays.direction is not None else [])]
    arrays = [surroundings.met, *emitted, *surroundings.directions, rays.begin, rays.end, *axes, *results]
    _kernel(parts, ray_share(emitters))([-(-count // BLOCK)], arrays, [count])
    return results


@cache
def _kernel(parts: Parts, share: float) -> LlvmKernel:
    names = ["met", "emitted", "directions", "begin", "end", *[f"normal_{axis}" for axis in _AXES]]
    names += [f"direction_{axis}" for axis in _AXES] if parts.mirrored else []
    names += [f"light{i}" for i in range(3 * parts.count)]
    return LlvmKernel(names, ["count"], ("gather", partial(_write, parts, share)))


def _write(parts: Parts, share: float, text: Text) -> None:
    start = text.index * BLOCK
    with text.loop(start, (start + BLOCK).least(text.number("count"))) as gaussians:
        own = gaussians.at
        normal = [_spread(text, f"normal_{axis}", own) for axis in _AXES]
        direction = [_spread(text, f"direction_{axis}", own) for axis in _AXES] if parts.mirrored else normal
        view, end = -_dot(text, normal, direction), text.load("end", own)
        nothing = [text.zeros(LANES)] * (3 * parts.count)
        with text.loop(text.load("begin", own), end, nothing, step=LANES) as rays:
            listed = text.lanes(LANES, rays.at, end)
            met = [text.load("met", (rays.at + k).least(end - 1)) for k in range(LANES)]
            light = text.load_threes("emitted", [ray % text.integer(2**16) * 4 for ray in met])
            towards = text.load_threes("directions", [ray // text.integer(2**16) * 4 for ray in met])
            here, along = _dot(text, normal, towards), _dot(text, towards, direction)
            weights = ray_weights(parts, here, along, view, text.floats(LANES, share), text)
            counted = [listed.choose(weight, text.zeros(LANES)) for weight in weights]
            pairs = [(weight, channel) for weight in counted for channel in light]
            rays.following = [text.fma(*pair, total) for pair, total in zip(pairs, rays.state, strict=True)]
        for i, total in enumerate(rays.state):
            text.store(f"light{i}", own, text.sum(total))


def _spread(text: Text, array: str, index: Value) -> Value:
    return text.spread(text.load_floats(array, index), LANES)


def _dot(text: Text, x: list[Value], y: list[Value]) -> Value:
    return text.fma(x[2], y[2], text.fma(x[1], y[1], x[0] * y[0]))
