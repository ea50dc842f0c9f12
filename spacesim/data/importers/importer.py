"""What the command line and Python know of an importer: its function, and its options."""

from collections.abc import Callable
from dataclasses import dataclass

from spacesim.data.records import Dataset


@dataclass(frozen=True)
class Option:
    """A keyword of an importer's function, and an option of the command: `known_length` is `--known-length`."""

    name: str  #: of the keyword
    type: Callable[[str], object]  #: of its value: int, float, str, Path; bool: a switch without a value
    value: str  #: what stands for the value in the help: DIR, N, M; "" of a switch
    help: str  #: a line, with the default in words
    choices: tuple[str, ...] = ()  #: allowed values, () for any


@dataclass(frozen=True)
class Importer:
    """A kind of source."""

    function: Callable[..., Dataset]
    """(src, out, *, progress=None, and a keyword for each option) -> the dataset written. Keywords have the defaults.
    `progress` is as in `writing.Progress`."""
    summary: str  #: what it reads, a line
    source: str  #: what SRC is: a folder, a file
    options: tuple[Option, ...] = ()  #: what the command asks for beside the source
