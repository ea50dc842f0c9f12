"""What long work says of the time that is left."""

import io

from rich.console import Console

from spacesim import progress
from spacesim.learning.folder import TrainingProgress
from spacesim.progress import Reporter, TimeLeftColumn, report_training


def lines(capsys, *records):
    report = Reporter("train", "iterations", None)
    for record in records:
        report.last_line = -1e9  # every line is due
        report_training(report)(record)
    return capsys.readouterr().err.splitlines()


def test_lines_say_what_training_knows(capsys):
    first, second, third, last = lines(
        capsys,
        TrainingProgress(50, 200, 0.5, 8000),
        TrainingProgress(100, 200, 0.4, 8000, 90.4, True),
        TrainingProgress(150, 200, 0.3, 9000, 60.2, False),
        TrainingProgress(200, 200, 0.2, 9000, 0.0, False),
    )
    assert "left" not in first
    assert second.endswith("  at least 90 s left")
    assert third.endswith("9000 Gaussians  60 s left")
    assert "left" not in last


def test_other_work_goes_on_by_its_speed(capsys, monkeypatch):
    clock = iter([0.0, 10.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    report = Reporter("generate", "frames", None)
    for done in (0, 5):
        report.last_line = -1e9
        report(done, 20)
    assert capsys.readouterr().err.splitlines()[1] == "generate: 5/20  0.5 frames/s  30 s left"


def test_the_bar_says_the_same():
    console = Console(file=io.StringIO(), force_terminal=True)
    bar = progress.progress.Progress(TimeLeftColumn(), console=console, auto_refresh=False)
    report = Reporter("train", "iterations", bar)
    (task,) = bar.tasks
    report_training(report)(TrainingProgress(100, 200, 0.4, 8000, 90.4, True))
    assert TimeLeftColumn().render(task).plain == "at least 0:01:30"
    report_training(report)(TrainingProgress(150, 200, 0.3, 9000, 3660.0, False))
    assert TimeLeftColumn().render(task).plain == "1:01:00"  # a new one: a column keeps what it shows for a while
    bar.update(task.id, left=None)
    assert TimeLeftColumn().render(task).plain == progress.progress.TimeRemainingColumn().render(task).plain
