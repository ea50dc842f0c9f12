"""Plain values to records and back: words, alternatives, and how what is wrong is named."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
import pytest

from spacesim.data.errors import InputError
from spacesim.data.structure import Rules, check_fields, checked, plain, structure
from spacesim.data.toml import Document


@dataclass(frozen=True)
class Disc:
    kind: ClassVar[str] = "disc"
    radius: float = 1.0


@dataclass(frozen=True)
class Box:
    kind: ClassVar[str] = "box"
    sides: tuple[float, float] = (1.0, 2.0)
    count: int = 1
    is_open: bool = False

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class Tag:
    kind: str = "label"


@dataclass(frozen=True)
class Part:
    shape: Disc | Box = field(default_factory=Disc)
    lid: Disc | Box | None = None
    colour: Literal["red", "blue"] = "red"
    finish: Literal["matt"] | None = None
    tag: Tag = field(default_factory=Tag)

    def __post_init__(self) -> None:
        check_fields(self)


def read(values, **rules):
    return structure(Part, Document("part.toml", values, {}), Rules(**rules))


@pytest.mark.parametrize(
    "part", [Part(), Part(Box((3.0, 4.0)), Disc(2.0), "blue", "matt", Tag("other")), Part(lid=Box())]
)
def test_records_round_trip(part):
    assert read(plain(part)) == part


def test_an_alternative_is_chosen_by_its_name():
    assert plain(Part())["shape"] == {"kind": "disc", "radius": 1.0}
    assert plain(Tag()) == {"kind": "label"}  # a field like any other
    assert read({"shape": "box"}) == Part(Box())
    assert read({"shape": {"kind": "box", "sides": [5, 6]}, "lid": None}) == Part(Box((5.0, 6.0)))
    assert read({"shape": {"radius": 3}}) == Part(Disc(3.0))  # the first one
    assert read({"lid": "none", "finish": "none"}, none="none") == Part()


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"shape": "bax"}, "shape: expected one of disc, box, found 'bax'; did you mean box?"),
        ({"shape": {"kind": "ball"}}, r"shape\.kind: expected one of disc, box, found 'ball'"),
        ({"shape": {"kind": 3}}, r"shape\.kind: expected one of disc, box, found 3"),
        ({"shape": 3}, "shape: expected a table, found 3"),
        ({"shape": {"sides": [1, 2]}}, r"shape\.sides: expected one of kind, radius, found 'sides'; kind box knows it"),
        ({"shape": {"radus": 3}}, r"shape\.radus: expected .*; did you mean shape\.radius\?"),
        ({"radus": 3}, r"radus: expected .*; did you mean shape\.radius\?"),
        ({"shape": None}, "shape: expected a table, found none"),
        ({"lid": "none"}, "lid: expected one of disc, box, found 'none'"),
        ({"colour": "rad"}, "colour: expected one of red, blue, found 'rad'; did you mean red?"),
        ({"colour": ["red"]}, "colour: expected one of red, blue, found"),
        ({"finish": "shiny"}, "finish: expected one of matt, found 'shiny'"),
    ],
)
def test_what_is_wrong_is_named(values, said):
    with pytest.raises(InputError, match=f"part.toml: {said}"):
        read(values)


def test_choices_are_checked_on_construction():
    with pytest.raises(InputError, match="colour: expected one of red, blue, found 'green'"):
        Part(colour="green")
    with pytest.raises(InputError, match="finish: expected one of matt, found 'wet'"):
        Part(finish="wet")


@pytest.mark.parametrize(
    ("cls", "fields", "said"),
    [
        (Box, {"sides": (1.0, "2")}, r"sides\[1\]: expected a finite number, found '2'"),
        (Box, {"sides": 3}, "sides: expected a list of 2 numbers, found 3"),
        (Box, {"count": 2.5}, "count: expected a whole number, found 2.5"),
        (Box, {"count": True}, "count: expected a whole number, found True"),
        (Box, {"is_open": "no"}, "is_open: expected true or false, found 'no'"),
        (Part, {"shape": "disc"}, "shape: expected a Box or Disc, found 'disc'"),
        (Part, {"shape": None}, "shape: expected a Box or Disc, found None"),
        (Part, {"tag": {}}, "tag: expected a Tag, found a table"),
    ],
)
def test_fields_are_checked_however_a_record_is_made(cls, fields, said):
    with pytest.raises(InputError, match=f"^{said}$"):
        cls(**fields)


def test_numbers_of_numpy_are_fields():
    Box(sides=np.ones(2), count=np.int64(3), is_open=np.bool_(True))
    Box(sides=[1, np.float32(2)])


@checked
def cut(
    part: Part, depth: float, /, name: str = "", *, times: int | None = None, on_end: Callable[[int], None] = print
) -> int:
    return times or 1


@pytest.mark.parametrize(
    ("arguments", "options", "said"),
    [
        ((Part(), "1"), {}, "depth: expected a finite number, found '1'"),
        ((Part(), float("nan")), {}, "depth: expected a finite number, found nan"),
        ((Part(), 1), {"times": 2.5}, "times: expected a whole number, found 2.5"),
        ((Part(), 1), {"on_end": 4}, "on_end: expected a function, found 4"),
        ((Part(), 1), {"on_end": None}, "on_end: expected a function, found None"),
    ],
)
def test_arguments_are_checked_by_their_annotations(arguments, options, said):
    with pytest.raises(InputError, match=f"^{said}$"):
        cut(*arguments, **options)
    assert cut(Part(), np.float32(1), times=np.int64(3)) == 3
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'depth'"):
        cut(Part())
