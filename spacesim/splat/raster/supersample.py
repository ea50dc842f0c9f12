"""Supersampling: a picture is drawn some times as wide, and a pixel is the mean light of a square of it.

A detector adds up light, and so does a path tracer, before a tone curve makes an sRGB value of it. Blending sRGB values
is as good as that within a surface, but not where a pixel has a lit and a shadowed part: half of white is 0.735 as an
sRGB value, not 0.5. So the values of the square are decoded (IEC 61966-2-1), averaged, and encoded again.
"""

from collections.abc import Callable
from dataclasses import replace

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Array3f, Float, UInt32
from spacesim.data.errors import InputError
from spacesim.data.records import MAX_PIXELS, Camera
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.output import RenderOutput, over_alpha
from spacesim.splat.raster.surface import unit
from spacesim.splat.raster.tone import decode_srgb, encode_srgb_unclipped

MIN_ALPHA = 1e-3  #: a fainter pixel counts as this opaque when its colour is taken out of the blend
MAX_SUPERSAMPLE = 4  #: on a side of a pixel


def upsampled_camera(camera: Camera, times: int) -> Camera:
    """The camera with `times` as many pixels on each side. Raises InputError where these are too many."""
    if times == 1:
        return camera
    width, height = times * camera.width, times * camera.height
    if width * height > MAX_PIXELS:
        raise InputError(
            f"supersample: expected pictures of at most {MAX_PIXELS // times**2} pixels to be drawn {times} times as "
            f"wide, found {camera.width}x{camera.height}"
        )
    numbers = [times * number for number in (camera.fx, camera.fy, camera.cx, camera.cy)]
    return Camera(camera.world_from_camera, width, height, *numbers)


def pixel_means(
    planes: dict[str, list[Float]], transmittance: Float, size: tuple[int, int], times: int, linear: bool
) -> tuple[dict[str, list[Float]], Float]:
    """Planes of a picture with `times` x `times` places in each pixel, [times * height * times * width], as planes of
    pixels [height * width], and the transmittance. Differentiable.

    planes: by name, premultiplied;  size: width and height of the result, pixels;  linear: "color", if any, is light;
    else it is sRGB values, whose light is averaged. What else there is, is averaged as it is.
    """
    squares = _squares(size, times)

    def gathered(plane: Float) -> list[Float]:
        return [dr.gather(ad.Float, plane, place, mode=dr.ReduceMode.Permute) for place in squares]

    def mean(plane: Float) -> Float:
        return _mean(gathered(plane))

    means = {name: [mean(plane) for plane in group] for name, group in planes.items() if linear or name != "color"}
    passed = gathered(transmittance)
    if "color" in planes and not linear:
        alphas = [1 - value for value in passed]
        means["color"] = [mean_light(gathered(plane), alphas) for plane in planes["color"]]
    return means, _mean(passed)


def render_supersampled(
    draw: Callable[[Pinhole], RenderOutput], camera: Camera, times: int, colors: int = 0, linear: bool = False
) -> RenderOutput:
    """What `draw` draws for `camera`, from a picture `times` as wide. Not differentiable.

    colors: so many of the features, from the first, are colours, as `RenderOutput.color` is;  linear: of light.
    Depth and normals are means over what is seen in the pixel; the median depth is the mean of the pixel's where half
    of it has one, else 0.
    """
    output = draw(Pinhole.of(upsampled_camera(camera, times)))
    if times == 1:
        return output
    color_planes, features = _listed(output.color), _listed(output.features)
    groups = {
        "color": color_planes + features[:colors],
        "depth": [] if output.depth is None else [output.depth],
        "normal": _listed(output.normal),
        "median_depth": [] if output.median_depth is None else [output.median_depth],
        "features": features[colors:],
    }
    size = camera.width, camera.height
    alpha, reduced = _reduced(groups, output.alpha, size, times, linear)
    return replace(
        output,
        color=ad.Array3f(reduced["color"][:3]) if color_planes else None,
        alpha=alpha,
        depth=reduced["depth"][0] if groups["depth"] else None,
        width=camera.width,
        height=camera.height,
        median_depth=reduced["median_depth"][0] if groups["median_depth"] else None,
        normal=ad.Array3f(reduced["normal"]) if groups["normal"] else None,
        features=None if output.features is None else reduced["color"][len(color_planes) :] + reduced["features"],
    )


@recorded(elements=lambda _, groups, alpha, size, *_rest, **_named: size[0] * size[1])
def _reduced(
    groups: dict[str, list[Float]], alpha: Float, size: tuple[int, int], times: int, linear: bool
) -> tuple[Float, dict[str, list[Float]]]:
    """(alpha, planes of pixels by name) of `render_supersampled`."""
    covered = {name: [plane * alpha for plane in groups[name]] for name in ("depth", "normal")}
    median = groups["median_depth"]
    is_known = [dr.select(plane > 0, ad.Float(1), 0) for plane in median]
    masks = {**covered, "alpha": [alpha], "known": is_known}
    result, _ = pixel_means({**groups, **masks}, 1 - alpha, size, times, linear)
    (alpha,) = result.pop("alpha")
    result["depth"] = [over_alpha(plane, alpha) for plane in result["depth"]]
    result["normal"] = list(unit(ad.Array3f(result["normal"]))) if groups["normal"] else []
    share = result.pop("known")
    pairs = zip(result["median_depth"], share, strict=True)
    result["median_depth"] = [dr.select(half >= 0.5, plane / dr.maximum(half, 0.5), 0) for plane, half in pairs]
    return alpha, result


def _listed(planes: Array3f | list[Float] | None) -> list[Float]:
    return [] if planes is None else list(planes)


def _squares(size: tuple[int, int], times: int) -> list[UInt32]:
    """UInt32 [height * width] each: the places of a pixel in the picture that is `times` as wide."""
    width, height = size
    pixel = dr.arange(ad.UInt32, width * height)
    x, y = times * (pixel % width), times * (pixel // width)
    return [(y + j) * (times * width) + x + i for j in range(times) for i in range(times)]


def _mean(values: list[Float]) -> Float:
    return sum(values[1:], values[0]) / len(values)


def mean_light(colors: list[Float], alphas: list[Float]) -> Float:
    """sRGB values, premultiplied, of the mean light of places: each as bright as its straight colour, as much of it as
    its alpha."""
    alpha = sum(alphas[1:], alphas[0])
    lights = [
        part * decode_srgb(dr.maximum(color * dr.rcp(dr.maximum(part, MIN_ALPHA)), 0))
        for color, part in zip(colors, alphas, strict=True)
    ]
    light = sum(lights[1:], lights[0]) * dr.rcp(dr.maximum(alpha, MIN_ALPHA))
    return alpha / len(colors) * encode_srgb_unclipped(light)
