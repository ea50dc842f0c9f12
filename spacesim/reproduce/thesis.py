"""What the thesis prints, read from assets/thesis.toml, and cells in its form."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

from spacesim.data.errors import InputError
from spacesim.data.files import JsonMapping
from spacesim.data.structure import Rules, check_fields, structure
from spacesim.data.toml import read_document
from spacesim.eval.labels import HIGHER, LOWER, Metric

PATH = Path(__file__).parents[1] / "assets" / "thesis.toml"
SMALL = 1e-3  #: below it the thesis writes powers of ten


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    heading: str  #: as printed
    metric: str  #: group.name of metrics.json
    goal: str  #: "↑", "↓" or "→ x", the value to come close to
    #: how its numbers are printed
    form: Literal["ten-thousandths", "scientific", "count", "hundredths", "millionths"] = "ten-thousandths"
    spread: bool = True  #: whether the thesis has standard deviations
    arrow: bool = True  #: whether the thesis says which way is better

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def comparison(self) -> str:
        """What a better value is, in words."""
        return {HIGHER: "above", LOWER: "below"}.get(self.goal, f"nearer to {self.goal[2:]} than")

    def distance(self, value: float) -> float:
        """How far a value is from the goal; the smaller, the better."""
        return Metric(self.metric, self.heading, "", self.goal, 4, "").distance(value)

    def printed(self, value: float) -> str:
        """A number as the thesis prints those of this column."""
        if self.form == "count":
            return f"{value:,.0f}"
        if self.form == "scientific":
            return f"{1e3 * value:.4f}×10⁻³"
        if self.form != "ten-thousandths":
            return f"{value:.{2 if self.form == 'hundredths' else 6}f}"
        return f"{value:.2e}" if 0 < abs(value) < SMALL else f"{value:.4f}"

    def cell(self, mean: float, std: float | None) -> str:
        """A mean and its standard deviation as the thesis prints them."""
        return self.printed(mean) if std is None or not self.spread else f"{self.printed(mean)} ± {self.printed(std)}"


@dataclass(frozen=True)
class Row:
    """A row of a table: what was trained, and its cells as printed."""

    name: str  #: as printed
    method: str  #: of training, that of ours beside it
    cells: tuple[str, ...]  #: numbers as printed, one for each column
    strategy: str = "default"  #: of densification, that of ours beside it


@dataclass(frozen=True)
class ExpectedRanking:
    """What the thesis says of two rows."""

    metric: str  #: group.name of metrics.json
    better: str  #: name of the row that the thesis has ahead
    worse: str  #: name of the other row


@dataclass(frozen=True)
class Remark:
    """A cause of a difference, of a metric or, where that is "", of the whole table."""

    text: str  #: a sentence
    metric: str = ""  #: group.name of metrics.json, or ""


@dataclass(frozen=True)
class Table:
    """A table of the thesis."""

    number: str  #: as printed: "4.4"
    title: str  #: as printed
    columns: tuple[Column, ...]  #: one for each metric
    rows: tuple[Row, ...]  #: what was trained, a cell for each column
    claims: tuple[ExpectedRanking, ...]  #: what the thesis says of its rows
    remarks: tuple[Remark, ...] = ()  #: why ours differ
    scene: Literal["own", "pair"] = "own"  #: the trained object alone, or two of it in one scene
    by_suns: bool = True  #: whether its numbers depend on the Suns of the test views

    def __post_init__(self) -> None:
        check_fields(self)
        metrics, names = {column.metric for column in self.columns}, {row.name for row in self.rows}
        for row in self.rows:
            if len(row.cells) != len(self.columns):
                raise InputError(f"cells: expected {len(self.columns)} in {row.name}, found {len(row.cells)}")
        for claim in self.claims:
            if claim.metric not in metrics or not {claim.better, claim.worse} <= names:
                raise InputError(f"claims: expected a metric and two rows of table {self.number}, found {claim}")
        if unknown := {remark.metric for remark in self.remarks} - metrics - {""}:
            raise InputError(f"remarks: expected a metric of table {self.number}, found {unknown.pop()!r}")

    def printed_numbers(self, row: Row) -> dict[str, dict[str, float]]:
        """{metric: {"mean", and "std" where it is printed}} of a row."""
        return {column.metric: parse(cell) for column, cell in zip(self.columns, row.cells, strict=True)}


@dataclass(frozen=True)
class Thesis:
    """All that is shown beside ours."""

    conditions: Mapping[str, str]  #: data, trainings and device of the thesis, in words, by name
    nerf_times: float  #: what a frame of NeRFs takes as a multiple of one of Gaussians, "around" (figure 3.2)
    tables: tuple[Table, ...]  #: in the thesis's order


@cache
def thesis() -> Thesis:
    """The file's content, in each table the columns that it names."""
    document = read_document(PATH)
    lists = document.values["columns"]
    tables = [{**table, "columns": _listed(table["columns"], lists)} for table in document.values["tables"]]
    values = {key: value for key, value in document.values.items() if key != "columns"} | {"tables": tables}
    return structure(Thesis, replace(document, values=values), Rules())


def _listed(columns: str | Sequence[JsonMapping], lists: Mapping[str, Sequence[JsonMapping]]) -> Sequence[JsonMapping]:
    return lists[columns] if isinstance(columns, str) else columns


def parse(cell: str) -> dict[str, float]:
    """The numbers of a printed cell: {"mean", and "std" where there is one}."""
    words = [word.replace(",", "").replace("×10⁻³", "e-3") for word in cell.split(" ± ")]
    return dict(zip(("mean", "std"), map(float, words), strict=False))


def best(column: Column, values: Mapping[str, float | None]) -> set[str]:
    """The names of the best values of a column; empty where fewer than two are there."""
    there = {name: column.distance(value) for name, value in values.items() if value is not None}
    least = min(there.values(), default=math.inf)
    return {name for name, value in there.items() if value == least} if len(there) > 1 else set()


def holds(column: Column, values: Mapping[str, float | None], better: str, worse: str) -> bool | None:
    """Whether one row is better than another; None where one of them is missing."""
    pair = values.get(better), values.get(worse)
    return None if None in pair else column.distance(pair[0]) < column.distance(pair[1])  # type: ignore[arg-type]


def pairs(column: Column, printed: Mapping[str, float], values: Mapping[str, float | None]) -> Sequence[bool]:
    """Of each two rows that the thesis distinguishes and that are there, whether ours stand in the thesis's order."""
    names = list(printed)
    ordered = [(a, b) for a in names for b in names if column.distance(printed[a]) < column.distance(printed[b])]
    return [verdict for a, b in ordered if (verdict := holds(column, values, a, b)) is not None]
