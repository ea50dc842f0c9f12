"""Makes docs/pictures/readme.png: held-out views of boxsat as truth, reconstruction, error, shadow classes and depth.

    python scripts/make_pictures.py [FOLDER]

FOLDER (out/pictures) keeps the dataset and the run, so that a second call only draws. A few minutes on two cores.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from spacesim.data.images import load_image, write_png
from spacesim.data.records import Dataset, Frame
from spacesim.data.store import SHADOW_ATTACHED, SHADOW_LIT, SHADOW_SELF_CAST, load_truth
from spacesim.eval.pictures import ERROR_SCALE, as_bytes, error_picture
from spacesim.scenes import generate, read_scene
from spacesim.splat.run import Run
from spacesim.splat.train.config import preset
from spacesim.splat.train.train import train

DATA = read_scene("boxsat", views=60, test_views=6, resolution=256, spp=64, sun=((40.0, 25.0),))
VIEWS = (3, 0, 1)  #: of the held-out ones, from easy to hard
WIDTH, HEIGHT = 240, 160  #: of a panel, pixels
GAP, HEADER = 6, 46  #: pixels
CLASSES = {SHADOW_LIT: (226, 222, 205), SHADOW_SELF_CAST: (213, 94, 0), SHADOW_ATTACHED: (70, 82, 112)}
INK, DIM = (235, 235, 230), (150, 155, 165)

Panel = np.ndarray
"""[H, W, 3] uint8."""


def main(folder: Path, out: Path) -> None:
    dataset = generate(DATA, folder / "data", resume=(folder / "data").exists())
    run = train(dataset, folder / "run", preset("demo"), resume=(folder / "run").exists())
    rows = [panels(dataset, run, dataset.test[index]) for index in VIEWS]
    write_png(out, np.asarray(with_titles(np.vstack([strip(row) for row in rows]))))
    print(f"{out}: {out.stat().st_size / 1e3:.0f} kB")


def panels(dataset: Dataset, run: Run, frame: Frame) -> list[Panel]:
    """Truth, reconstruction, error, true shadow classes and reconstructed depth of a frame, cut out alike."""
    truth, labels = load_image(dataset, frame), load_truth(dataset, frame)
    prediction = run.predict(frame.camera, frame.sun)
    wanted = truth.over(np.zeros(3))
    classes = np.zeros((*labels.shadow.shape, 3), np.uint8)
    for value, color in CLASSES.items():
        classes[labels.shadow == value] = color
    depth, surface = prediction.depth, prediction.alpha > 0.5
    near, far = depth[surface].min(), depth[surface].max()
    shade = np.where(surface, 1 - 0.85 * (depth - near) / (far - near), 0)
    pictures = [
        as_bytes(wanted),
        as_bytes(prediction.rgb),
        error_picture(np.clip(prediction.rgb, 0, 1), wanted, truth.valid),
        classes,
        as_bytes(np.repeat(shade[..., None], 3, axis=-1)),
    ]
    return [cut_out(picture, labels.object_id > 0) for picture in pictures]


def cut_out(picture: Panel, object_mask: np.ndarray) -> Panel:
    """The panel's part of a picture, about the middle of the object."""
    rows, columns = np.nonzero(object_mask)
    top = int(np.clip((rows.min() + rows.max() - HEIGHT) // 2, 0, picture.shape[0] - HEIGHT))
    left = int(np.clip((columns.min() + columns.max() - WIDTH) // 2, 0, picture.shape[1] - WIDTH))
    return picture[top : top + HEIGHT, left : left + WIDTH]


def strip(row: list[Panel]) -> Panel:
    gap = np.zeros((row[0].shape[0], GAP, 3), np.uint8)
    parts = [part for panel in row for part in (gap, panel)][1:]
    joined = np.hstack(parts)
    return np.vstack([joined, np.zeros((GAP, joined.shape[1], 3), np.uint8)])


def with_titles(picture: Panel) -> Image.Image:
    canvas = Image.new("RGB", (picture.shape[1], picture.shape[0] + HEADER))
    canvas.paste(Image.fromarray(picture), (0, HEADER))
    draw = ImageDraw.Draw(canvas)
    large, small = ImageFont.load_default(16), ImageFont.load_default(12)
    titles = {
        "truth": [("path-traced", DIM)],
        "reconstruction": [("held-out view", DIM)],
        "error": [(f"black 0, white {ERROR_SCALE:g} or more", DIM)],
        "shadow classes": [
            ("lit ", CLASSES[SHADOW_LIT]),
            ("cast ", CLASSES[SHADOW_SELF_CAST]),
            ("attached", CLASSES[SHADOW_ATTACHED]),
        ],
        "depth": [("reconstructed, near is bright", DIM)],
    }
    for i, (title, words) in enumerate(titles.items()):
        x: float = i * (WIDTH + GAP) + 6
        draw.text((x, 4), title, INK, large)
        for word, color in words:
            draw.text((x, 25), word, color, small)
            x += draw.textlength(word, small)
    return canvas


if __name__ == "__main__":
    pictures = Path(__file__).parents[1] / "docs" / "pictures"
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/pictures"), pictures / "readme.png")
