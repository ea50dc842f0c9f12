"""What the experiments have found so far, as reproduce.json has it."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spacesim.data.files import MAX_LIST_BYTES, JsonDict, JsonMapping, read_json
from spacesim.reproduce.experiments import (
    FIGURES,
    VARIANTS,
    Curve,
    Experiment,
    Variant,
    Work,
    curves,
    experiment_of,
    figure_fixed_sun,
    figure_frames,
    figure_relighting,
    preset_of,
    telescope,
)
from spacesim.reproduce.perform import folder_of, is_done
from spacesim.reproduce.size import Size
from spacesim.reproduce.thesis import Column, ExpectedRanking, Row, Table, best, holds, pairs, thesis

PICTURES = ("psnr", "ssim", "lpips", "mae")
SHAPE = ("chamfer", "hausdorff99", "iou")
Values = JsonDict


@dataclass(frozen=True)
class ResultColumn:
    """A column of ours beside the thesis's."""

    variant: Variant  #: which of our trainings: as the thesis has it, or improved
    suns: str  #: "known_suns", "unseen_suns" or "", which of the test views count

    @property
    def key(self) -> str:
        return self.variant + ("_unseen" if self.suns == "unseen_suns" else "")


def result_columns(table: Table) -> list[ResultColumn]:
    """The columns of ours: where the Suns matter, first those that training knows, as in the thesis."""
    suns = ("known_suns", "unseen_suns") if table.by_suns and table.scene == "own" else ("",)
    return [ResultColumn(variant, which) for which in suns for variant in VARIANTS]


class Results:
    """What lies in a folder. Files are read once."""

    def __init__(self, root: Path, size: Size, seeds: int) -> None:
        self.root, self.size, self.seeds = root, size, seeds
        self._read: dict[Path, Any] = {}

    def file(self, work: Work, name: str) -> Any:
        """Content of an experiment's JSON file, None where it is not there."""
        path = folder_of(self.root, work.name) / name
        if path not in self._read:
            self._read[path] = read_json(path, MAX_LIST_BYTES) if path.exists() else None
        return self._read[path]

    def evaluation(self, work: Experiment, part: str) -> Any:
        """metrics.json of a finished evaluation, None where there is none."""
        done = (folder_of(self.root, work.name) / part / "report.html").exists()
        return self.file(work, f"{part}/metrics.json") if done else None

    def state(self, work: Work) -> str:
        """ "finished", "failed" or "not run"."""
        if is_done(self.root, work):
            return "finished"
        return "not run" if self.file(work, "failed.json") is None else "failed"

    def all(self, parts: Iterable[str], experiments: Sequence[Work]) -> Values:
        """All numbers of the wanted tables and figures."""
        wanted = set(parts)
        tables = [self.table(table) for table in thesis().tables if table.number in wanted]
        makers = {
            "figure-3.2": self.frames,
            "figure-4.2": lambda: self.relighting(figure_relighting(self.size)),
            "figure-4.3": self.fixed_sun,
            "figure-4.4": self.fixed_sun,
            "figure-5.5": self.curves,
            "figure-6.2": lambda: self.relighting([telescope(self.size)]),
        }
        figures = {name: make() for name, make in makers.items() if name in wanted}
        return {
            "experiments": [self.described(one) for one in experiments],
            "tables": tables,
            "figures": {name: {"title": FIGURES[name], "rows": rows} for name, rows in figures.items()},
        }

    def described(self, work: Work) -> Values:
        """What an experiment is and how far it has come."""
        training = self.file(work, "run/training.json") or {}
        failed = self.file(work, "failed.json") or {}
        return {
            "name": work.name,
            "state": self.state(work),
            "reason": failed.get("reason"),
            "data": work.data,
            "parts": list(work.parts) if isinstance(work, Experiment) else ["curve"],
            "preset": work.config.preset,
            "iterations": self.size.figure_steps if isinstance(work, Curve) else work.config.iterations,
            "gaussians": training.get("gaussians"),
            "seconds": training.get("seconds"),
            "device": training.get("device"),
        }

    def table(self, table: Table) -> Values:
        """The thesis's numbers and ours, the best of each column, and what of the thesis's order holds."""
        columns = result_columns(table)
        printed = {row.name: table.printed_numbers(row) for row in table.rows}
        metrics = []
        means: dict[tuple[str, str], dict[str, float | None]] = {}
        for column in table.columns:
            rows: list[Values] = []
            for row in table.rows:
                cells = {one.key: self.cell(table, row, column, one) for one in columns}
                rows.append({"name": row.name, "cells": {"printed": printed[row.name][column.metric], **cells}})
            for key in ("printed", *(one.key for one in columns)):
                means[key, column.metric] = {row["name"]: row["cells"][key]["mean"] for row in rows}
            metrics.append({"metric": column.metric, "heading": column.heading, "goal": column.goal, "rows": rows})
        keys = ["printed", *(one.key for one in columns)]
        return {
            "number": table.number,
            "title": table.title,
            "presets": {one.key: preset_of(self.size, table, one.variant) for one in columns},
            "metrics": metrics,
            "orderings": [
                *(_claim(table, claim, keys, means) for claim in table.claims),
                *(_best(column, keys, means) for column in table.columns if column.arrow),
            ],
            "in_order": {key: _in_order(table, key, means) for key in keys},
            "remarks": [{"metric": remark.metric, "text": remark.text} for remark in table.remarks],
        }

    def cell(self, table: Table, row: Row, column: Column, shown: ResultColumn) -> Values:
        """{"mean", "std", "seeds", "state"}: over the frames, and the means over the seeds of these."""
        made = [experiment_of(self.size, table, row, shown.variant, seed) for seed in range(self.seeds)]
        evaluations = [self.evaluation(one, table.scene) for one in made]
        values = [value_of(one, table, column.metric, shown.suns) for one in evaluations if one is not None]
        known = [value for value in values if value is not None]
        if not known:
            state = "failed" if any(self.state(one) == "failed" for one in made) else "not run"
            return {"mean": None, "std": None, "seeds": [], "state": "null" if values else state}
        stds = [std for _, std in known if std is not None]
        seeds = [mean for mean, _ in known]
        std = float(np.mean(stds)) if stds else None
        return {"mean": float(np.mean(seeds)), "std": std, "seeds": seeds, "state": "there"}

    def frames(self) -> list[Values]:
        """Of Gaussians, then of the radiance field: milliseconds a frame by the number of models, and how many times
        what Gaussians take, where the same device drew both."""
        works = figure_frames(self.size)
        timings = [(work, self.file(work, "frames/frames.json")) for work in works]
        first = timings[0][1]
        rows = []
        for work, frames in timings:
            same = first and frames and (first["device"], first["pixels"]) == (frames["device"], frames["pixels"])
            times = [own / least for own, least in zip(frames["ms"], first["ms"], strict=True)] if same else None
            rows.append({"name": work.name, "state": self.state(work), "frames": frames, "times": times})
        return rows

    def relighting(self, works: Sequence[Work]) -> list[Values]:
        """Of each model: the view under many Suns, most Gaussians and those at the end, how good it is."""
        rows = []
        for work in works:
            history = (self.file(work, "run/training.json") or {}).get("history") or []
            counts = [step["gaussians"] for step in history]
            own = self.evaluation(work, "own") if isinstance(work, Experiment) else None
            rows.append(
                {
                    "name": work.name,
                    "state": self.state(work),
                    "sweep": self.file(work, "suns/suns.json"),
                    "gaussians": [max(counts), counts[-1]] if counts else None,
                    "image": {name: _mean(own, "image", name) for name in PICTURES} if own else None,
                }
            )
        return rows

    def fixed_sun(self) -> list[Values]:
        """Of each model: means over the fully lit test views, over all of them, and the shape."""
        rows = []
        for work in figure_fixed_sun(self.size):
            assert isinstance(work, Experiment)
            metrics, views = self.evaluation(work, "one-sun"), self.file(work, "one-sun/views.json")
            row: Values = {"name": work.name, "state": self.state(work), "views": views}
            if metrics is not None:
                lit = [frame for frame in metrics["frames"] if frame["file_path"] in views["fully_lit"]]
                row |= {
                    "fully_lit": {name: _over(lit, name) for name in PICTURES},
                    "all": {name: _over(metrics["frames"], name) for name in PICTURES},
                    "shape": {name: (metrics["geometry"] or {}).get(name) for name in SHAPE},
                    "frames": [len(lit), len(metrics["frames"])],
                }
            rows.append(row)
        return rows

    def curves(self) -> list[Values]:
        """Of each start: the share of Gaussians inside the true mesh by steps."""
        files = [(work, self.file(work, "curve.json")) for work in curves(self.size)]
        return [{"name": work.name, "state": self.state(work), **(curve or {})} for work, curve in files]


def value_of(metrics: JsonMapping, table: Table, path: str, suns: str) -> tuple[float, float | None] | None:
    """Mean and, over frames, standard deviation of a metric; None where it is null."""
    group, name = path.split(".")
    if group in ("model", "geometry"):
        number = _model_value(metrics, name) if group == "model" else (metrics["geometry"] or {}).get(name)
        return None if number is None else (float(number), None)
    where = metrics.get(suns) if suns else metrics
    if table.scene == "pair":
        where = next((one for one in metrics["objects"] or [] if one["name"] == "second"), None)
    summary = ((where or {}).get(group) or {}).get(name)
    return None if summary is None else (summary["mean"], summary["std"])


def _model_value(metrics: JsonMapping, name: str) -> float:
    model = metrics["model"]
    seconds = max(model["render_ms"], 1e-6) / 1e3
    numbers = {
        "gaussians": model["gaussians"],
        "megabytes": model["bytes"] / 1e6,
        "seconds": seconds,
        "rate": 1 / seconds,
    }
    return float(numbers[name])


def _mean(metrics: JsonMapping, group: str, name: str) -> float | None:
    summary = (metrics.get(group) or {}).get(name)
    return None if summary is None else float(summary["mean"])


def _over(frames: Sequence[JsonMapping], name: str) -> dict[str, float] | None:
    """Mean and standard deviation over frames that have the metric, None where none has."""
    values = [frame[name] for frame in frames if frame.get(name) is not None]
    return {"mean": float(np.mean(values)), "std": float(np.std(values))} if values else None


Means = Mapping[tuple[str, str], Mapping[str, float | None]]


def _claim(table: Table, claim: ExpectedRanking, keys: Sequence[str], means: Means) -> Values:
    column = next(column for column in table.columns if column.metric == claim.metric)
    verdicts = {key: holds(column, means[key, claim.metric], claim.better, claim.worse) for key in keys}
    return {"text": f"{column.heading}: {claim.better} {column.comparison} {claim.worse}", "holds": verdicts}


def _best(column: Column, keys: Sequence[str], means: Means) -> Values:
    """Whether the best row of the thesis, or one of several, is among our best."""
    theirs = best(column, means["printed", column.metric])
    verdicts = {}
    for key in keys:
        ours = means[key, column.metric]
        verdicts[key] = None if None in ours.values() else bool(best(column, ours) & theirs)
    return {"text": f"{column.heading}: {' or '.join(sorted(theirs))} best", "holds": verdicts}


def _in_order(table: Table, key: str, means: Means) -> list[int]:
    """[pairs of rows in the thesis's order, pairs that can be compared], over all columns."""
    holding: list[bool] = []
    for column in table.columns:
        printed = {name: value for name, value in means["printed", column.metric].items() if value is not None}
        holding += pairs(column, printed, means[key, column.metric])
    return [sum(holding), len(holding)]
