"""A run as one HTML file that needs nothing else: arrays, deflated, and the renderer of `assets/page`."""

import base64
import html
import json
import math
import re
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from spacesim.data.earth import Earth
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict, write_bytes
from spacesim.data.geometry import robust_radius
from spacesim.data.integrity.outputs import check_output
from spacesim.learning.folder import run_name
from spacesim.splat.export.html.colors import NODES, color_steps, tabulate_colors, tells_cosines
from spacesim.splat.export.html.seen import SIDE as SEEN_SIDE
from spacesim.splat.export.html.seen import tabulate_seen
from spacesim.splat.export.html.sunlight import BOUNCE_SIDE, SunlightTables, sunlight_steps, tabulate_sunlight
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.run import Run

ASSETS = Path(__file__).parents[3] / "assets" / "page"
LEVEL = 7  #: of zlib: 9 saves 2 % and takes seven times as long
SCRIPTS = ("model.js", "shaders.js", "renderer.js", "controls.js")

Arrays = dict[str, np.ndarray]


def write_page(
    run: Run,
    path: Path,
    report: Callable[[int, int], None] | None = None,
    earth: Earth | None = None,
    name: str | None = None,
) -> None:
    """Write `run` as a page. report: called with (steps done, of all);  earth: that any Sun lights, for a run that
    `knows_earth`, and that can hide it; where it is stays;  name: above the picture, by default the run's

    The same run on the same backend gives the same bytes. Raises InputError for a run without Gaussians and for a file
    that cannot be written.
    """
    if run.gaussian_count == 0:
        raise InputError(f"{run.path}: expected a run with Gaussians, found none")
    check_output(Path(path), "html")
    about, arrays = _content(run, report, earth if run.relightable else None)
    write_bytes(Path(path), _page(run, name or run_name(run.path), about, arrays).encode())


def _content(run: Run, report: Callable[[int, int], None] | None, earth: Earth | None) -> tuple[JsonDict, Arrays]:
    """The data of the page, and its arrays."""
    gaussians, light, bright = run.gaussians, run.light, earth if run.knows_earth else None
    steps = SEEN_SIDE**2 + color_steps(light) + (sunlight_steps(gaussians, light, bright) if light else 0)
    done = 0

    def step() -> None:
        nonlocal done
        done += 1
        if report is not None:
            report(done, steps)

    colors = tabulate_colors(gaussians, light, step)
    sunlight = tabulate_sunlight(gaussians, light, step, bright) if light else None
    arrays = _shapes(gaussians) | {"colors": colors.coefficients, "color_table": colors.table}
    means = arrays["means"].astype(np.float64)
    centre = np.median(means, axis=0)
    seen = tabulate_seen(gaussians, run.antialiased, centre, step)
    arrays["seen"] = seen.bits
    about: JsonDict = {
        "count": gaussians.count,
        "centre": centre.tolist(),
        "radius": robust_radius(means),
        "seen": {"side": SEEN_SIDE, "radius": seen.radius},
        "antialiased": run.antialiased,
        "sun": run.relightable,
        "components": len(colors.coefficients),
        "offset": colors.offset,
    }
    if light is not None and tells_cosines(light):
        about |= {"cosines": True, "nodes": list(NODES)}
    else:
        about |= {"terms": colors.table.shape[1], "color_side": round(len(colors.table) ** 0.5)}
    if light is not None and light.config.field.surface:
        arrays["normals"] = _normals(gaussians, light.config.field.features)
    if run.curve:
        about["curve"] = {"tone": run.curve.tone, "white": run.curve.white}
    if earth is not None:
        about["earth"] = {"direction": earth.direction.tolist(), "radius": math.radians(earth.angular_radius_deg)}
    if sunlight is not None:
        _add_sunlight(sunlight, about, arrays)
    return about, arrays


def _shapes(gaussians: Gaussians) -> Arrays:
    numbers = gaussians.to_numpy()
    quaternions = numbers["quaternions"]
    quaternions = quaternions / np.maximum(np.linalg.norm(quaternions, axis=1, keepdims=True), 1e-12)
    shapes = np.concatenate([numbers["log_scales"], numbers["logit_opacities"][:, None]], axis=1)
    return {
        "means": numbers["means"],
        "quaternions": quaternions.astype(np.float16),
        "shapes": shapes.astype(np.float16),
    }


def _normals(gaussians: Gaussians, first: int) -> np.ndarray:
    """int8 [N, 3] of any length: features from number `first`."""
    features = np.array(gaussians.features).reshape(-1, gaussians.count)
    normals = features[first : first + 3].T
    return np.rint(127 * normals / np.maximum(np.abs(normals).max(axis=1, keepdims=True), 1e-12)).astype(np.int8)


def _add_sunlight(sunlight: SunlightTables, about: JsonDict, arrays: Arrays) -> None:
    if sunlight.visibility is not None:
        about["shadows"] = {"side": sunlight.side}
        arrays["visibility"] = sunlight.visibility
    if sunlight.bounce is not None and sunlight.bounce_table is not None:
        about["bounce"] = {"side": BOUNCE_SIDE, "components": len(sunlight.bounce)}
        arrays["bounce"], arrays["bounce_table"] = sunlight.bounce, sunlight.bounce_table


def _page(run: Run, name: str, about: JsonDict, arrays: Arrays) -> str:
    """The whole file."""
    packed, start, described = [], 0, []
    for array_name, array in arrays.items():
        content = np.ascontiguousarray(array.astype(array.dtype.newbyteorder("<"))).tobytes()
        described.append({"name": array_name, "type": array.dtype.name, "start": start, "length": array.size})
        content += bytes(-len(content) % 4)
        start += len(content)
        packed.append(content)
    caption = f"{run.config['method']}, {about['count']:,} Gaussians, made by spacesim"
    metadata = json.dumps(about | {"arrays": described}, sort_keys=True).replace("<", "\\u003c")
    parts = {
        "name": html.escape(name),
        "caption": html.escape(caption),
        "style": _asset("page.css"),
        "script": "\n".join(_asset(script) for script in SCRIPTS),
        "about": metadata,
        "data": base64.b64encode(zlib.compress(b"".join(packed), LEVEL)).decode(),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda mark: parts[mark[1]], _asset("page.html"))


def _asset(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")
