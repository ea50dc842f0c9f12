"""What commands have in common: messages for wrong options, types of arguments, from where a run is seen."""

import argparse
import math
import re
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn

from spacesim import interrupts
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict
from spacesim.data.structure import did_you_mean

if TYPE_CHECKING:
    from spacesim.data.records import Camera, Sun
    from spacesim.nerf.run import NerfRun
    from spacesim.splat.run import Run


_NUMBERS: dict[object, str] = {int: "a whole number", float: "a number"}


class Parser(argparse.ArgumentParser):
    """Says what is wrong with the usage in one sentence, and takes "-40,10" and "-y" for arguments, not for options."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._negative_number_matcher = re.compile(r"^-(\.?\d|y$)")
        self._typed: Sequence[str] = ()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """As argparse's, but a command refuses by itself what it does not know."""
        self._typed = sys.argv[1:] if args is None else args
        options, rest = super().parse_known_args(args, namespace)
        if rest:
            self.error(self._unknown_option(rest) or f"expected no more arguments, found {' '.join(rest)!r:.60}")
        return options, rest

    def flags(self) -> dict[str, str]:
        """{name of an option's value: the option}."""
        return {action.dest: action.option_strings[-1] for action in self._actions if action.option_strings}

    def _print_message(self, message: str, file: Any = None) -> None:
        """argparse itself would not say that its help could not be written."""
        if file is sys.stdout:
            interrupts.print_output(message, end="")
        else:
            super()._print_message(message, file)

    def _get_value(self, action: argparse.Action, arg_string: str) -> Any:
        try:
            return super()._get_value(action, arg_string)
        except argparse.ArgumentError:
            if action.type not in _NUMBERS:
                raise
            expected = f"expected {_NUMBERS[action.type]}, found {arg_string!r:.60}"
            raise argparse.ArgumentError(action, expected) from None

    def _check_value(self, action: argparse.Action, value: object) -> None:
        if action.choices is not None and value not in action.choices:
            words = ", ".join(map(str, action.choices))
            raise argparse.ArgumentError(
                action, f"expected one of {words}, found {value!r}{did_you_mean(value, map(str, action.choices))}"
            )

    def error(self, message: str) -> NoReturn:
        if "required" in message and self._subparsers is None:  # what is missing may have been misspelt
            message = self._unknown_option(self._typed) or message
        message = message.removeprefix("argument ")
        end = "" if message.endswith("?") else ";"
        self.exit(2, f"{self.prog}: {message}{end} see {self.prog} --help\n")

    def _unknown_option(self, words: Sequence[str]) -> str | None:
        """What is said of the first of the words that looks like an option and is none; None where all are known."""
        known = {option.lstrip("-"): option for action in self._actions for option in action.option_strings}
        for word in words:
            if word == "--":
                break
            name = word.partition("=")[0]
            if re.match(r"--?[a-zA-Z]", name) and not any(option.startswith(name) for option in known.values()):
                bare = name.lstrip("-")
                close = get_close_matches(bare, known, n=1) or self._options_of(bare)
                return f"unknown option {name}" + (f"; did you mean {known[close[0]]}?" if close else "")
        return None

    def _options_of(self, word: str) -> list[str]:
        """The one option, without dashes, whose help speaks of this word; none where several do."""
        actions = [a for a in self._actions if re.search(rf"\b{re.escape(word)}\b", f"{a.help}")]
        return [actions[0].option_strings[-1].lstrip("-")] if len(actions) == 1 and actions[0].option_strings else []


def angles(text: str) -> tuple[float, float]:
    """(azimuth, elevation), degrees, of "AZ,EL"."""
    try:
        azimuth, elevation = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected AZ,EL in degrees, found {text!r}") from None
    if not (math.isfinite(azimuth) and -90 <= elevation <= 90):
        raise argparse.ArgumentTypeError(f"expected a finite azimuth and an elevation up to 90, found {text!r}")
    return azimuth, elevation


def angles_or_none(text: str) -> tuple[float, float] | Literal["none"]:
    """As `angles`, or the word "none"."""
    return "none" if text == "none" else angles(text)


def resolution(text: str) -> int | tuple[int, int]:
    """Pixels of each side, or (width, height) of "WIDTHxHEIGHT"."""
    sides = text.lower().split("x")
    if not all(side.isascii() and side.lstrip("-").isdigit() for side in sides) or len(sides) > 2:
        raise argparse.ArgumentTypeError(f"expected pixels of each side, or WIDTHxHEIGHT, found {text!r}")
    return (int(sides[0]), int(sides[1])) if len(sides) == 2 else int(sides[0])


def frame_range(text: str) -> tuple[int, int | None]:
    """(first, end) of "A:B"; without B the end is None, without A the first is 0."""
    first, colon, end = text.partition(":")
    if not colon or not all(not side or (side.isascii() and side.isdigit()) for side in (first, end)):
        raise argparse.ArgumentTypeError(f"expected A:B, numbers of frames, found {text!r}")
    return int(first or 0), int(end) if end else None


def add_view(parser: Parser) -> None:
    """The options that say from where a run is seen."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--camera", type=Path, metavar="FILE", help="JSON with transform_matrix, w, h, fl_x, ...")
    where.add_argument("--frame", type=int, metavar="K", help="frame K of the dataset, training frames first (0)")
    parser.add_argument("--data", type=Path, metavar="DATA", help="the dataset, where it has moved since training")


def view_of(options: argparse.Namespace, run: "Run | NerfRun") -> "tuple[Camera, Sun | None, str]":
    """The camera that the options of `add_view` name, the Sun of a frame, which the run may have estimated, and which
    frame it is, to be said where none was chosen, else ""."""
    from spacesim.data.transforms import read_camera, read_dataset, read_sun

    if options.camera:
        return read_camera(options.camera), None, ""
    frames = read_dataset(options.data or _data_of(run.config)).frames
    index = options.frame or 0
    if not 0 <= index < len(frames):
        raise InputError(f"frame: expected 0 to {len(frames) - 1}, found {index}")
    frame, cameras = frames[index], run.path / "cameras.json"
    estimated = read_sun(cameras, frame.file_path) if frame.sun is None and cameras.is_file() else None
    note = f"seen from frame 0, {frame.file_path}; --frame K or --camera FILE takes another view"
    return frame.camera, frame.sun or estimated, note if options.frame is None else ""


def _data_of(config: JsonDict) -> Path:
    path = Path(config["data"]["path"])
    if not path.exists():
        raise InputError(f"{path}: expected the data that the run was trained on, found nothing; name it with --data")
    return path
