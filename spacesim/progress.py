"""Progress of long work: a bar on a terminal, a plain line every few seconds elsewhere; all on standard error."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING

from rich import progress
from rich.console import Console
from rich.text import Text

if TYPE_CHECKING:
    from spacesim.learning.folder import TrainingProgress

LINE_EVERY = 5.0  #: seconds between two plain lines


class Reporter:
    """Called with how far a piece of work is; estimates its speed and the time left."""

    def __init__(self, title: str, unit: str, bar: progress.Progress | None) -> None:
        self.title, self.unit, self.bar = title, unit, bar
        self.task = bar.add_task(title, total=None, detail="") if bar else None
        self.first: tuple[float, int] | None = None
        self.last_line = 0.0

    def __call__(
        self, done: int, total: int, detail: str = "", left: float | None = None, lower_bound: bool = False
    ) -> None:
        """`done` of `total` units are finished. left: seconds that the others will take, where the caller knows better
        than by the units' mean; lower_bound: or longer"""
        now = time.monotonic()
        if self.first is None:
            self.first = now, done
        speed = (done - self.first[1]) / max(now - self.first[0], 1e-9)
        rate = f"{speed:.1f} {self.unit}/s" if done > self.first[1] else ""
        text = "  ".join(part for part in (rate, detail) if part)
        if self.bar is not None and self.task is not None:
            least = "at least " * lower_bound
            self.bar.update(self.task, completed=done, total=total, detail=text, left=left, least=least)
        elif now - self.last_line >= LINE_EVERY or done == total:
            if left is None and rate:
                left = (total - done) / speed
            rest = f"  {'at least ' * lower_bound}{left:.0f} s left" if left is not None and done < total else ""
            print(f"{self.title}: {done}/{total}  {text}{rest}", file=sys.stderr, flush=True)
            self.last_line = now


def report_training(report: Reporter) -> "Callable[[TrainingProgress], None]":
    """A callback that passes a training's progress to `report`."""
    return lambda p: report(p.iteration, p.iterations, p.words, p.seconds_left, p.lower_bound)


class TimeLeftColumn(progress.TimeRemainingColumn):
    """What the work itself says, else what rich computes from the units' speed."""

    def render(self, task: progress.Task) -> Text:
        left = task.fields.get("left")
        if left is None or task.finished:
            return super().render(task)
        return Text(f"{task.fields['least']}{timedelta(seconds=round(left))}", style="progress.remaining")


@contextmanager
def show_progress(title: str, unit: str, quiet: bool = False) -> Iterator[Reporter]:
    """A `Reporter` for the work of the `with` block. quiet: no bar (plain lines go on)."""
    console = Console(stderr=True)
    if quiet or not console.is_terminal:
        yield Reporter(title, unit, None)
        return
    columns: list[progress.ProgressColumn] = [
        progress.TextColumn("{task.description}"),
        progress.BarColumn(bar_width=20),
        progress.MofNCompleteColumn(),
    ]
    columns += [TimeLeftColumn(), progress.TextColumn("{task.fields[detail]}")]
    with progress.Progress(*columns, console=console) as bar:
        yield Reporter(title, unit, bar)
