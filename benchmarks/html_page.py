"""A run as a page (`spacesim export RUN --html FILE`): how large, how fast without a GPU, how near to `render`.

    python benchmarks/html_page.py RUN [--data DATA] [--suns 20] [--seconds 5] [--size 800x600]

"frames/s" is what headless Chromium draws in software, each frame waited for: while the view goes round, while the Sun
does, and while the page itself may draw fewer pixels, as it does where frames take long. Decibels are PSNR within the
silhouette: of the page and of `render` against the true pictures of Suns that no training picture shows, each Sun's
first frame (of data that has none: test frames), and of the page against `render`, over whole pictures.
"""

import base64
import io
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image
from support import common

from spacesim import backend
from spacesim.cli.parser import resolution
from spacesim.data.errors import InputError
from spacesim.data.images import load_image
from spacesim.data.records import Camera, Dataset, Frame
from spacesim.data.store import read_dataset
from spacesim.eval.metrics.image import psnr
from spacesim.eval.suns import known_suns
from spacesim.progress import show_progress
from spacesim.splat.export.html.page import write_page
from spacesim.splat.run import Run, load_run

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from browser import CHROMIUM, Browser, Page, wait_for

LEAST_ALPHA = 0.5  #: of the silhouette
MOVES = {
    "the view": "controls.state.azimuth += 3; controls.draw();",
    "the Sun": "controls.state.sunAzimuth += 3; controls.draw();",
    "the view, fewer pixels": "controls.change({ azimuth: controls.state.azimuth + 3 });",
}


def main() -> None:
    parser = common.arguments(__doc__)
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument("--data", type=Path, metavar="DATA", help="with true pictures (the run's own)")
    parser.add_argument("--suns", type=common.positive, default=20, help="unseen ones (20)")
    parser.add_argument("--seconds", type=float, default=5, help="that each rate is taken over (5)")
    parser.add_argument("--size", type=resolution, default=(800, 600), metavar="WxH", help="of the window (800x600)")
    options = parser.parse_args()
    if CHROMIUM is None:
        sys.exit("expected Chromium, found none")
    backend.select(options.backend)
    run = load_run(options.run)
    dataset = read_dataset(options.data or Path(run.config["data"]["path"]))
    frames, what = evaluated_frames(dataset, options.suns)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "page.html"
        start = time.perf_counter()
        with show_progress("export", "steps") as report:
            write_page(run, path, report)
        size = {
            "Gaussians": run.gaussian_count,
            "MB": round(path.stat().st_size / 1e6, 2),
            "s to write": round(time.perf_counter() - start, 1),
        }
        browser = Browser(Path(folder) / "chromium")
        try:
            width, height = options.size if isinstance(options.size, tuple) else (options.size,) * 2
            page = opened(browser, path, width, height)
            rates = [rate(page, what, move, options.seconds) for what, move in MOVES.items()]
            near = [nearness(page, run, dataset, frame) for frame in frames]
        finally:
            browser.close()
    means = {key: round(float(np.mean([row[key] for row in near])), 2) for key in near[0]}
    worst = round(max(row["render, dB"] - row["page, dB"] for row in near), 2)
    tables = {
        "The page": [size],
        "Frames a second": rates,
        f"{len(near)} {what}": [means | {"worst loss, dB": worst}],
    }
    common.emit({"page": size, "rates": rates, "suns": near, "means": means, "worst_loss": worst}, tables, options)


def evaluated_frames(dataset: Dataset, count: int) -> tuple[list[Frame], str]:
    """The first test frame of each of `count` Suns at most that training has not seen, or, where there are none, the
    first test frames; which of these they are."""
    known = known_suns(dataset.test, dataset.train)
    frames = [frame for frame, seen in zip(dataset.test, known, strict=True) if seen is False]
    by_sun = {tuple(frame.sun.direction): frame for frame in reversed(frames) if frame.sun is not None}
    if by_sun:
        return list(by_sun.values())[::-1][:count], "unseen Suns"
    if not dataset.test:
        raise InputError(f"{dataset.root}: expected test frames, found none")
    return list(dataset.test[:count]), "test frames"


def opened(browser: Browser, path: Path, width: int, height: int) -> Page:
    """The page of a file once it has drawn."""
    page = browser.open(path.resolve().as_uri(), width, height)
    wait_for(lambda: page.evaluate("window.controls?.waiting === null"), "the first picture")
    return page


def rate(page: Page, what: str, move: str, seconds: float) -> common.Row:
    """Frames a second while something moves; each is read back, so it is finished."""
    page.send("Page.bringToFront")
    frames, milliseconds, share = page.evaluate(
        f"""new Promise(done => {{
            const {{ gl }} = controls.renderer, pixel = new Uint8Array(4);
            let frames = -3, start;
            const step = () => {{
                if (++frames === 0) start = performance.now();
                {move}
                gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
                const took = performance.now() - start;
                if (took > {1000 * seconds}) done([frames + 1, took, gl.canvas.width / innerWidth]);
                else requestAnimationFrame(step);
            }};
            step(); }})"""
    )
    return {"what moves": what, "frames/s": round(1000 * frames / milliseconds, 1), "share of the width drawn": share}


def nearness(page: Page, run: Run, dataset: Dataset, frame: Frame) -> common.Row:
    """Decibels."""
    truth = load_image(dataset, frame)
    mask = truth.alpha >= LEAST_ALPHA
    rendered = np.clip(run.predict(frame.camera, frame.sun).rgb, 0, 1)
    shown = picture(page, frame.camera, np.array([0.0, 0, 1]) if frame.sun is None else frame.sun.direction)
    return {
        "render, dB": psnr(rendered, truth.rgb, mask),
        "page, dB": psnr(shown, truth.rgb, mask),
        "page against render, dB": psnr(shown, rendered),
    }


def picture(page: Page, camera: Camera, sun: np.ndarray) -> np.ndarray:
    """[H, W, 3] in [0, 1]: what the page draws for a camera under a Sun [3], over black."""
    view = {
        "axes": camera.camera_from_world[:3, :3].ravel().tolist(),
        "eye": camera.position.tolist(),
        "lens": [camera.fx, camera.fy, camera.cx, camera.cy],
    }
    address = page.evaluate(
        f"""(() => {{
            const {{ canvas }} = controls.renderer;
            Object.assign(canvas, {{ width: {camera.width}, height: {camera.height} }});
            controls.renderer.draw({json.dumps(view)}, {json.dumps(np.asarray(sun).tolist())});
            return canvas.toDataURL(); }})()"""
    )
    shown = Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGBA")
    pixels = np.asarray(shown, np.float64) / 255
    return pixels[..., :3] * pixels[..., 3:]


if __name__ == "__main__":
    common.run_main(main)
