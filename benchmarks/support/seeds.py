"""Rows of a benchmark that are trained several times: its options, its trainings, and means over them."""

import argparse
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from spacesim.data.records import Dataset
from spacesim.eval.evaluate import EvaluateConfig
from spacesim.splat.train.config import TrainConfig, preset, with_options
from support import common


def arguments(text: str | None, methods: Sequence[str]) -> argparse.ArgumentParser:
    """`common.arguments` with what such a benchmark has. methods: of light, to choose from"""
    parser = common.arguments(text)
    parser.add_argument("--out", type=Path, required=True, help="where data and runs are, or are made")
    parser.add_argument("--resolution", type=common.positive, default=256, metavar="PX", help="of the pictures (256)")
    parser.add_argument("--samples", type=common.positive, default=1024, metavar="N", help="of test pictures (1024)")
    parser.add_argument("--method", choices=methods, default="shadow-splat")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--iterations", type=common.positive, help="default: the preset's")
    parser.add_argument("--seeds", type=common.positive, default=1, help="trainings a row (1)")
    return parser


def add_rig(parser: argparse.ArgumentParser) -> None:
    """Options of how many pictures there are."""
    parser.add_argument("--suns", type=common.positive, default=16, help="of training (16)")
    parser.add_argument("--views", type=common.positive, default=40, help="under each of them (40)")


def chosen(parser: argparse.ArgumentParser, option: str, text: str, known: Collection[str]) -> list[str]:
    """The names in an option's text. Ends the program with a sentence where one is not known."""
    names = common.row_names(text)
    unknown = [name for name in names if name not in known]
    if unknown:
        parser.error(f"{option}: expected some of {', '.join(known)}, found {unknown[0]!r}")
    return names


def config_of(options: argparse.Namespace) -> TrainConfig:
    """What the options ask for."""
    return with_options(preset(options.preset, options.method), iterations=options.iterations)


def trainings(
    name: str, config: TrainConfig, dataset: Dataset, folder: Path, seeds: int, truth: Dataset | None = None
) -> list[common.Row]:
    """`common.measured` of each seed, in FOLDER-SEED; shapes are left out."""
    return [
        common.measured(
            name,
            replace(config, seed=seed),
            EvaluateConfig(geometry=None),
            dataset,
            folder.with_name(f"{folder.name}-{seed}"),
            truth,
        )
        for seed in range(seeds)
    ]


def means(results: Sequence[common.Row], columns: Mapping[str, Sequence[str]]) -> common.Row:
    """Of each column, by its heading, the mean of the `number_in` of all results, and their standard deviation where
    there are several; {"note": why} where one has failed."""
    notes = [result["note"] for result in results if "note" in result]
    if notes:
        return {"note": notes[0]}
    cells: common.Row = {}
    for heading, names in columns.items():
        values = [value for value in (common.number_in(result, *names) for result in results) if value is not None]
        if len(values) < len(results):
            continue
        cells[heading] = float(np.mean(values))
        if len(values) > 1:
            cells[f"{heading}, deviation"] = float(np.std(values, ddof=1))
    return cells
