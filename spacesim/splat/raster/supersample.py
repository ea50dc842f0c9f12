"""Supersampling: a picture is drawn some times as wide, and a pixel is the mean light of a square of it.

A detector adds up light, and so does a path tracer, before a tone curve makes an sRGB value of it. Blending sRGB values
is as good as that within a surface, but not where a pixel has a lit and a shadowed part: half of white is 0.735 as an
sRGB value, not 0.5. So the values of the square are decoded (IEC 61966-2-1), averaged, and encoded again.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.data.errors import InputError
from spacesim.data.records import MOST_PIXELS, Camera
from spacesim.splat.raster.bin import RECORDINGS
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.render import RenderOutput, over_alpha
from spacesim.splat.raster.surface import unit
from spacesim.splat.raster.tone import decoded, encoded_unclipped

LEAST_ALPHA = 1e-3  #: a fainter pixel counts as this opaque when its colour is taken out of the blend
MOST_PLACES = 4  #: on a side of a pixel, chosen


def finer(camera: Camera, times: int) -> Camera:
    """The camera with `times` as many pixels on each side. Raises InputError where these are too many."""
    if times == 1:
        return camera
    width, height = times * camera.width, times * camera.height
    if width * height > MOST_PIXELS:
        raise InputError(
            f"--supersample {times}: expected pictures of at most {MOST_PIXELS // times**2} pixels, found "
            f"{camera.width}x{camera.height}"
        )
    numbers = [times * number for number in (camera.fx, camera.fy, camera.cx, camera.cy)]
    return Camera(camera.world_from_camera, width, height, *numbers)


def pixel_means(
    planes: dict[str, list[Any]], transmittance: Any, size: tuple[int, int], times: int, linear: bool
) -> tuple[dict[str, list[Any]], Any]:
    """Planes of a picture with `times` x `times` places in each pixel, [times * height * times * width], as planes of
    pixels [height * width], and the transmittance. Differentiable.

    planes: by name, premultiplied;  size: width and height of the result, pixels;  linear: "colour", if any, is light;
    else it is sRGB values, whose light is averaged. What else there is, is averaged as it is.
    """
    squares = _squares(size, times)

    def gathered(plane: Any) -> list[Any]:
        return [dr.gather(ad.Float, plane, place, mode=dr.ReduceMode.Permute) for place in squares]

    def mean(plane: Any) -> Any:
        return _mean(gathered(plane))

    found = {name: [mean(plane) for plane in group] for name, group in planes.items() if linear or name != "colour"}
    passed = gathered(transmittance)
    if "colour" in planes and not linear:
        alphas = [1 - value for value in passed]
        found["colour"] = [_mean_light(gathered(plane), alphas) for plane in planes["colour"]]
    return found, _mean(passed)


def supersampled(
    draw: Callable[[Pinhole], RenderOutput], camera: Camera, times: int, colours: int = 0, linear: bool = False
) -> RenderOutput:
    """What `draw` draws for `camera`, from a picture `times` as wide. Not differentiable.

    colours: so many of the features, from the first, are colours, as `RenderOutput.colour` is;  linear: of light.
    Depth and normals are means over what is seen in the pixel; the median depth is the mean of the pixel's where half
    of it has one, else 0.
    """
    output = draw(Pinhole.of(finer(camera, times)))
    if times == 1:
        return output
    own, features = _listed(output.colour), _listed(output.features)
    groups = {
        "colour": own + features[:colours],
        "depth": [] if output.depth is None else [output.depth],
        "normal": _listed(output.normal),
        "median_depth": [] if output.median_depth is None else [output.median_depth],
        "features": features[colours:],
    }
    size = camera.width, camera.height
    reduce = _trace_reduced if size == (1, 1) else _reduced  # a recording gives a plane of one pixel another size
    alpha, found = reduce(groups, output.alpha, size, times, linear)
    return replace(
        output,
        colour=ad.Array3f(found["colour"][:3]) if own else None,
        alpha=alpha,
        depth=found["depth"][0] if groups["depth"] else None,
        width=camera.width,
        height=camera.height,
        median_depth=found["median_depth"][0] if groups["median_depth"] else None,
        normal=ad.Array3f(found["normal"]) if groups["normal"] else None,
        features=None if output.features is None else found["colour"][len(own) :] + found["features"],
    )


def _trace_reduced(
    groups: dict[str, list[Any]], alpha: Any, size: tuple[int, int], times: int, linear: bool
) -> tuple[Any, dict[str, list[Any]]]:
    """(alpha, planes of pixels by name) of `supersampled`."""
    covered = {name: [plane * alpha for plane in groups[name]] for name in ("depth", "normal")}
    median = groups["median_depth"]
    known = [dr.select(plane > 0, ad.Float(1), 0) for plane in median]
    more = {**covered, "alpha": [alpha], "known": known}
    found, _ = pixel_means({**groups, **more}, 1 - alpha, size, times, linear)
    (alpha,) = found.pop("alpha")
    found["depth"] = [over_alpha(plane, alpha) for plane in found["depth"]]
    found["normal"] = list(unit(ad.Array3f(found["normal"]))) if groups["normal"] else []
    share = found.pop("known")
    pairs = zip(found["median_depth"], share, strict=True)
    found["median_depth"] = [dr.select(half >= 0.5, plane / dr.maximum(half, 0.5), 0) for plane, half in pairs]
    return alpha, found


def _listed(planes: Any) -> list[Any]:
    return [] if planes is None else list(planes)


def _squares(size: tuple[int, int], times: int) -> list[Any]:
    """UInt32 [height * width] each: the places of a pixel in the picture that is `times` as wide."""
    width, height = size
    pixel = dr.arange(ad.UInt32, width * height)
    x, y = times * (pixel % width), times * (pixel // width)
    return [(y + j) * (times * width) + x + i for j in range(times) for i in range(times)]


def _mean(values: list[Any]) -> Any:
    return sum(values[1:], values[0]) / len(values)


def _mean_light(colours: list[Any], alphas: list[Any]) -> Any:
    """sRGB values, premultiplied, of the mean light of places: each as bright as its straight colour, as much of it as
    its alpha."""
    alpha = sum(alphas[1:], alphas[0])
    lights = [
        part * decoded(dr.maximum(colour * dr.rcp(dr.maximum(part, LEAST_ALPHA)), 0))
        for colour, part in zip(colours, alphas, strict=True)
    ]
    light = sum(lights[1:], lights[0]) * dr.rcp(dr.maximum(alpha, LEAST_ALPHA))
    return alpha / len(colours) * encoded_unclipped(light)


_reduced = recorded(_trace_reduced, RECORDINGS)
