"""`spacesim train`. Its options stand for fields of TrainConfig and NerfConfig, whose comments say what they mean."""

import argparse
import logging
import re
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from spacesim import backend, interrupts
from spacesim.cli.parser import Parser
from spacesim.data.errors import InputError
from spacesim.data.files import JsonValue

if TYPE_CHECKING:
    from spacesim.learning.folder import TrainingProgress

SUMMARY, NEEDS_BACKEND = "reconstruct a dataset with Gaussian splatting or a radiance field", True
OPTIONS = {
    "--method": ("method", "NAME"),
    "--strategy": ("strategy", "NAME"),
    "--preset": ("preset", "NAME"),
    "--iterations": ("iterations", "N"),
    "--seed": ("seed", "N"),
    "--init": ("init", "NAME"),
    "--max-gaussians": ("refinement.max_gaussians", "N"),
}
"""Options with a value: the field that each sets, and what stands for its value. Every other field is for --set."""

_KEYS = {option: key for option, (key, _) in OPTIONS.items()} | {
    "--sun": "sun",
    "--warm-start": "warm_start",
    "--refine-poses": "refine_poses",
}
"""{option: the field that it sets} of all."""

log = logging.getLogger(__name__)

MANY = 5_000  #: iterations that take long on a CPU

_NAMES = ("method", "strategy", "preset")  #: of a configuration: `preset` makes it, with all its defaults


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    from spacesim.cli.fields import fields_of
    from spacesim.methods import METHODS
    from spacesim.splat.train.config import TrainConfig

    lists = "--fields" in arguments
    meanings = {field.key: field for field in fields_of(TrainConfig(preset="fast"))}
    parser.usage = "spacesim train DATA --out RUN [options]"
    parser.formatter_class = _help
    parser.epilog = "All fields: spacesim train --fields. Which to take: docs/how-to/choose.md, in the repository"
    parser.add_argument("data", type=Path, nargs="?" if lists else None, metavar="DATA", help="folder of the dataset")
    parser.add_argument("--out", type=Path, required=not lists, metavar="RUN", help="folder that the run is written to")
    for option, (key, value) in OPTIONS.items():
        field = meanings[key]
        words = field.type.removesuffix(" | none").replace(" | ", ", ") if value == "NAME" else field.meaning
        words = ", ".join(METHODS) if key == "method" else words
        kind = int if value == "N" else str
        shown = field.default if key in (*_NAMES, "seed") else "what the data has" if key == "init" else "of the preset"
        text = f"{words} (default: {shown})"
        parser.add_argument(option, type=kind, metavar=value, help=text)
    parser.add_argument(
        "--warm-start", action="store_true", default=None, help=meanings["warm_start"].meaning.partition(";")[0]
    )
    sun = meanings["sun"].meaning
    parser.add_argument("--sun", choices=("given", "unknown"), help=f"{sun} (default: given)")
    parser.add_argument("--refine-poses", action="store_true", default=None, help=meanings["refine_poses"].meaning)
    parser.add_argument("--resume", action="store_true", help="go on from the newest checkpoint")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="any field: refinement.max_gaussians=60000; repeatable",
    )
    parser.add_argument("--fields", action="store_true", help="list every field with its default under these options")


def option_of(field: str, options: argparse.Namespace) -> str | None:
    """The option that sets a field, by the field's dotted name."""
    from spacesim.nerf.config import NerfConfig
    from spacesim.splat.train.config import TrainConfig

    options_by_key = {key: option for option, key in _KEYS.items()}
    keys = {text.partition("=")[0].strip() for text in options.set}  # of which some are no fields
    if field in options_by_key and field not in keys:
        return options_by_key[field]
    known = {key.partition(".")[0] for key in keys} | _fields(TrainConfig) | _fields(NerfConfig)
    return f"--set {field}" if field.partition(".")[0] in known else None


def run(options: argparse.Namespace) -> None:
    from spacesim.cli.fields import listing
    from spacesim.data.store import read_dataset
    from spacesim.methods import configuration, train, with_settings
    from spacesim.nerf.config import NerfConfig
    from spacesim.progress import report_training, show_progress
    from spacesim.splat.train.config import TrainConfig, warm_start

    own = dict(map(parse_setting, options.set))
    values = {key: getattr(options, option[2:].replace("-", "_")) for option, key in _KEYS.items()}
    chosen = {key: value for key, value in values.items() if value is not None and key not in _NAMES}
    begun = options.out if options.resume else None
    config = configuration(options.preset, options.method, options.strategy, begun)
    for option, key in _KEYS.items():
        if key in own and values[key] is not None:
            raise InputError(f"{key}: expected none beside {option}, found {own[key]!r}")
    if isinstance(config, TrainConfig):
        if chosen.pop("warm_start", False) and config.warm_start is None:
            config = replace(config, warm_start=warm_start(config.preset or "fast"))
    elif others := [key for key in chosen | own if key.partition(".")[0] in _fields(TrainConfig) - _fields(NerfConfig)]:
        raise InputError(f"{others[0]}: expected with a method of Gaussians, found with {config.method}")
    try:
        config = with_settings(config, chosen | own)
    except InputError as error:
        sentence = re.sub(r"expected a field of \w+", "expected a field that spacesim train --fields lists", str(error))
        raise InputError(f"{sentence}{_advice(sentence)}") from None
    if options.fields:
        interrupts.print_output(listing(config))
        return
    dataset = read_dataset(options.data)
    is_default = options.preset is None and begun is None
    takes_long = is_default and config.iterations >= MANY and backend.select() == "llvm"
    with show_progress("train", "iterations") as report:
        show = report_training(report)
        if takes_long:
            show = _telling(f"preset {config.preset} is made for a GPU; on a CPU --preset demo is far quicker", show)
        done = train(dataset, options.out, config, options.resume, show, options.arguments)
    history, gaussians = done.training["history"], done.gaussian_count
    size = f"{done.training['parameters']} numbers" if gaussians is None else f"{gaussians} Gaussians"
    interrupts.print_output(
        f"{options.out}: {size} after {config.iterations} iterations in "
        f"{done.training['seconds']:.0f} s on {done.training['backend']}, final loss {history[-1]['loss']:.4f}"
    )


def _telling(sentence: str, show: "Callable[[TrainingProgress], None]") -> "Callable[[TrainingProgress], None]":
    """`show`, before whose first call a sentence is logged: what is refused says one alone."""
    untold = [sentence]

    def on_progress(state: "TrainingProgress") -> None:
        while untold:
            log.warning(untold.pop())
        show(state)

    return on_progress


def _fields(config: type) -> set[str]:
    return {field.name for field in fields(config)}


def parse_setting(text: str) -> tuple[str, JsonValue]:
    """(key, value) of "KEY=VALUE"; the value is one of TOML, or a bare word. Raises InputError for another text."""
    from spacesim.data.toml import parse

    key, equals, value = (part.strip() for part in text.partition("="))
    if not (key and equals and value):
        raise InputError(f"set: expected KEY=VALUE, found {text!r}")
    if key in ("method", "preset"):
        raise InputError(f"set: expected --{key}, which sets all that goes with it, found {text!r}")
    try:
        values = parse(f"value = {value}", "--set").values
    except InputError:
        return key, value
    return key, values["value"] if set(values) == {"value"} else value


def _advice(sentence: str) -> str:
    """What helps against an error of `with_settings`, "light.bounce: expected ..., found ...", if anything does."""
    field, _, rest = sentence.partition(": ")
    if rest.startswith(("expected light to be there", "expected light.shadow to be there")):
        return "; try --method shadow-map"
    if field == "warm_start" or rest.startswith("expected warm_start to be there"):
        return "; add --warm-start"
    is_unknown = f"found {field.rpartition('.')[2]!r}" in rest
    has_advice = "did you mean" in rest or "train --fields" in rest
    return "; see spacesim train --fields" if is_unknown and not has_advice else ""


def _help(prog: str) -> argparse.HelpFormatter:
    return argparse.HelpFormatter(prog, max_help_position=28)
