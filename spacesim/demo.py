"""`spacesim demo`: one satellite under many Suns, from a scene to a report and a page: minutes on two CPU cores."""

import json
import logging
import shutil
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict, holds_files, read_json, write_json
from spacesim.eval.evaluate import EvaluateConfig, evaluate
from spacesim.eval.report.headings import PAGE
from spacesim.eval.report.write import write_report
from spacesim.progress import Reporter, report_training
from spacesim.scenes.generation.generate import generate, versions
from spacesim.scenes.scenefile import read_scene
from spacesim.splat.export.html.page import write_page
from spacesim.splat.train.config import preset
from spacesim.splat.train.train import train

log = logging.getLogger(__name__)

SCENE = "boxsat"
DATA = {
    "suns": 40,
    "views": 8,
    "test_suns": 4,
    "test_views": 5,
    "known_test_views": 1,
    "resolution": 128,
    "spp": 64,
}
TRAINING = preset("demo", "shadow-map")


def demo(out: Path, reporting: Callable[[str, str], AbstractContextManager[Reporter]]) -> JsonDict:
    """Generate, train, evaluate and report into `out`; what an earlier call of the same demo has finished is kept.

    Returns {"report": path, "page": path, "metrics": metrics.json, "seconds": {part: s}}. Raises InputError where
    `out` holds other files than a demo's.
    """
    out = Path(out)
    _prepare(out)
    seconds, start = {}, time.monotonic()

    def finished(part: str) -> None:
        nonlocal start
        seconds[part], start = time.monotonic() - start, time.monotonic()

    with reporting("generate", "frames") as report:
        dataset = generate(read_scene(SCENE, **DATA), out / "data", resume=True, progress=report)
    finished("generate")
    with reporting("train", "iterations") as report:
        command = ("spacesim", "demo", "--out", str(out))
        run = train(dataset, out / "run", TRAINING, True, report_training(report), command)
    finished("train")
    page = out / "run" / PAGE
    if not page.exists():
        with reporting("export", "steps") as report:
            write_page(run, page, report, name=SCENE)
    finished("page")
    with reporting("evaluate", "frames") as report:
        metrics = evaluate(run, dataset, out / "eval", EvaluateConfig(), report)
    write_report([out / "eval"], out / "eval" / "report.html")
    finished("evaluate and report")
    return {"report": out / "eval" / "report.html", "page": page, "metrics": metrics, "seconds": seconds}


def _prepare(out: Path) -> None:
    """Make the folder; take away what a demo of another version or another backend has left in it."""
    marker = out / "demo.json"
    this = {
        "data": read_scene(SCENE, **DATA).to_json(),
        "train": TRAINING.to_json(),
        "backend": backend.select(),
        "versions": versions(),
    }
    this = json.loads(json.dumps(this))
    if marker.exists():
        if read_json(marker) == this:
            return
        log.info("%s: is of another version or backend; starting afresh", out)
        for part in ("data", "run", "eval"):
            shutil.rmtree(out / part, ignore_errors=True)
    elif holds_files(out):
        raise InputError(f"{out}: expected an empty or new folder, or an earlier demo, found other files in it")
    write_json(marker, this)
