"""Makes docs/pictures/sun.webp: one view while the Sun goes round, path-traced and by a trained run, and their shadows.

    spacesim generate boxsat --out data --suns 16 --views 40 --resolution 256
    spacesim train data --out run --preset fine --method shadow-splat
    python scripts/make_animation.py run

Two minutes on a GPU; drawing alone takes about five on two cores.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from spacesim import backend
from spacesim.data.geometry import look_at
from spacesim.data.images import srgb_from_linear
from spacesim.data.records import Camera, Sun
from spacesim.eval.pictures import WRONGLY_LIT, WRONGLY_SHADOWED, as_bytes, shadow_picture
from spacesim.learning.pictures import LIT, SHADOWED
from spacesim.scenes.build import build
from spacesim.scenes.render import Renderer
from spacesim.scenes.scenefile import read_scene
from spacesim.splat.run import Run, load_run

SIZE, HEADER, GAP = 512, 34, 4  #: pixels
TOP = 72  #: rows of pixels that are cut off above, and below
FRAMES, MILLISECONDS = 48, 120  #: of a round; of a frame
ELEVATION = 30.0  #: of the Sun, degrees
SPP = 256
FOV = 33.0  #: degrees
PLACE = 7.2, -4.4, 3.2  #: of the camera, metres
INK, DIM = (235, 235, 230), (150, 155, 165)
LEGEND = {"lit": LIT, "in shadow": SHADOWED, "wrongly lit": WRONGLY_LIT, "wrongly shadowed": WRONGLY_SHADOWED}

Panel = np.ndarray
"""[H, W, 3] uint8."""


def main(run: Run, out: Path) -> None:
    config = read_scene("boxsat")
    renderer, camera = Renderer(build(config), SPP), Camera.from_fov(look_at(PLACE, [0, 0, 0.25]), SIZE, SIZE, FOV)
    frames = []
    for number in range(FRAMES):
        azimuth = 360 * number / FRAMES
        sun = Sun.from_angles(azimuth, ELEVATION)
        truth, found = renderer.render(camera, sun, (0, number)), run.predict(camera, sun)
        assert found.visibility is not None, "expected a run that casts shadows"
        picture = srgb_from_linear(np.clip(truth.radiance * config.camera.exposure, 0, 1))
        shadows = shadow_picture(found.visibility <= 0.5, truth.sun_visibility <= 0.5, truth.object_id > 0)
        panels = [as_bytes(picture), as_bytes(np.clip(found.rgb, 0, 1)), shadows]
        frames.append(joined(panels, f"Sun at {azimuth:.0f}°, {ELEVATION:.0f}° up"))
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=MILLISECONDS, loop=0, quality=60, method=6)
    print(f"{out}: {out.stat().st_size / 1e6:.2f} MB")


def joined(panels: list[Panel], caption: str) -> Image.Image:
    """The panels side by side under their titles."""
    gap = np.zeros((SIZE - 2 * TOP, GAP, 3), np.uint8)
    row = np.hstack([part for panel in panels for part in (gap, panel[TOP : SIZE - TOP])][1:])
    canvas = Image.new("RGB", (row.shape[1], row.shape[0] + HEADER))
    canvas.paste(Image.fromarray(row), (0, HEADER))
    draw, large, small = ImageDraw.Draw(canvas), ImageFont.load_default(17), ImageFont.load_default(13)
    titles = ("path-traced", caption), ("spacesim, trained under 16 other Suns", ""), ("sunlight", "")
    x = 0.0
    for i, (title, more) in enumerate(titles):
        x = i * (SIZE + GAP) + 8
        draw.text((x, 7), title, INK, large)
        x += draw.textlength(title, large) + 14
        draw.text((x, 11), more, DIM, small)
    for word, color in LEGEND.items():
        draw.rectangle((x, 12, x + 10, 22), color)
        draw.text((x + 16, 11), word, DIM, small)
        x += draw.textlength(word, small) + 28
    return canvas


if __name__ == "__main__":
    backend.select("auto")
    main(load_run(Path(sys.argv[1])), Path(__file__).parents[1] / "docs" / "pictures" / "sun.webp")
