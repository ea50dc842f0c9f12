"""`spacesim demo`: one satellite from a scene to a report, small enough for two CPU cores and three minutes."""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from spacesim.eval.evaluate import EvaluateConfig, evaluate
from spacesim.eval.report import write_report
from spacesim.progress import Reporter, tell_training
from spacesim.scenes import GenerateConfig, generate
from spacesim.splat.train.config import preset
from spacesim.splat.train.train import train

SCENE = "boxsat"
DATA = GenerateConfig(views=80, test_views=12, resolution=256, spp=64, sun=((40.0, 25.0),))


def demo(out: Path, reporting: Callable[[str, str], AbstractContextManager[Reporter]]) -> dict[str, Any]:
    """Generate, train, evaluate and report into `out`; what an earlier call has finished is kept.

    Returns {"report": path, "metrics": metrics.json, "seconds": {part: s}}.
    """
    out = Path(out)
    seconds, start = {}, time.monotonic()

    def finished(part: str) -> None:
        nonlocal start
        seconds[part], start = time.monotonic() - start, time.monotonic()

    with reporting("generate", "frames") as report:
        dataset = generate(SCENE, out / "data", DATA, resume=True, progress=report)
    finished("generate")
    with reporting("train", "iterations") as report:
        command = ("spacesim", "demo", "--out", str(out))
        run = train(dataset, out / "run", preset("demo"), True, tell_training(report), command)
    finished("train")
    with reporting("evaluate", "frames") as report:
        metrics = evaluate(run, dataset, out / "eval", EvaluateConfig(), report)
    write_report([out / "eval"], out / "report.html")
    finished("evaluate and report")
    return {"report": out / "report.html", "metrics": metrics, "seconds": seconds}
