"""Charts as inline SVG in the colours of the page's style sheet: lines, histograms, columns of histograms."""

import math
from collections.abc import Sequence

import numpy as np

from spacesim.eval.report.html import SERIES, escape

Points = Sequence[tuple[float, float]]

WIDTH, HEIGHT = 460, 230
BAR_WIDTH = 330
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 10, 26, 40


def line_chart(title: str, x_label: str, series: Sequence[Points], log: bool = False) -> str:
    """SVG of curves of (x, y), one for each run, that may be empty; with `log` the y axis is logarithmic."""
    points = [point for curve in series for point in curve]
    if not points:
        return ""
    xs, ys = zip(*points, strict=True)
    x_ticks = nice_ticks(min(xs), max(xs), 5)
    y_ticks = _log_ticks(min(ys), max(ys)) if log else nice_ticks(min(0, *ys), max(ys), 4)
    height = math.log if log else float
    left, right = _span(x_ticks, xs)
    bottom, top = map(height, _span(y_ticks, ys))

    def place(x: float, y: float) -> tuple[float, float]:
        return (
            _LEFT + (x - left) / (right - left) * (WIDTH - _LEFT - _RIGHT),
            HEIGHT - _BOTTOM - (height(y) - bottom) / (top - bottom) * (HEIGHT - _TOP - _BOTTOM),
        )

    marks = [f'<text x="0" y="12">{escape(title)}</text>']
    for tick in y_ticks:
        y = place(left, tick)[1]
        marks.append(f'<path class="axis" d="M{_LEFT} {y:.1f}H{WIDTH - _RIGHT}"/>')
        marks.append(f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{compact(tick)}</text>')
    for tick in x_ticks:
        x = place(tick, y_ticks[0])[0]
        marks.append(f'<text x="{x:.1f}" y="{HEIGHT - 22}" text-anchor="middle">{compact(tick)}</text>')
    marks.append(f'<text x="{WIDTH - _RIGHT}" y="{HEIGHT - 4}" text-anchor="end">{escape(x_label)}</text>')
    for index, curve in enumerate(series):
        path = "L".join("{:.1f} {:.1f}".format(*place(x, y)) for x, y in curve)
        marks.append(f'<path class="line s{index % SERIES}" d="M{path}"/>' if curve else "")
    return _svg(f"{title} against {x_label}", WIDTH, HEIGHT, marks)


def histogram(title: str, groups: Sequence[Sequence[float]], edges: Sequence[float], tallest: int) -> str:
    """SVG of counts between the `edges`, an outline a run; `tallest`: the count that fills the height."""
    width, height, bottom = 240, 118, 22
    marks = [f'<text x="0" y="12">{escape(title)}</text>']
    step = width / (len(edges) - 1)
    frames = max(len(values) for values in groups)
    count_label = f"{frames} frame{'s' if frames != 1 else ''}"
    marks.append(f'<text x="{width}" y="12" text-anchor="end">{count_label}</text>')
    for index, values in enumerate(groups):
        counts, _ = np.histogram(values, edges)
        tops = [height - bottom - count / tallest * (height - bottom - 24) for count in counts]
        path = "".join(f"V{top:.1f}H{step * (i + 1):.1f}" for i, top in enumerate(tops))
        marks.append(f'<path class="block s{index % SERIES}" d="M0 {height - bottom}{path}V{height - bottom}Z"/>')
    marks.append(f'<path class="base" d="M0 {height - bottom}H{width}"/>')
    for position, anchor in ((0, "start"), (len(edges) // 2, "middle"), (len(edges) - 1, "end")):
        x = step * position
        marks.append(f'<text x="{x:.1f}" y="{height - 6}" text-anchor="{anchor}">{compact(edges[position])}</text>')
    return _svg(f"Histogram, {title}", width, height, marks)


def column_histograms(
    title: str, columns: Sequence[tuple[str, Sequence[float]]], edges: Sequence[float], index: int = 0
) -> str:
    """SVG of many histograms side by side, each a column of cells, stronger where they hold more values.

    columns: (what it is, its values);  index: the run's colour
    """
    width, height = 2 * WIDTH, HEIGHT
    step_x, step_y = (width - _LEFT) / len(columns), (height - _TOP - _BOTTOM) / (len(edges) - 1)
    marks = [f'<text x="0" y="12">{escape(title)}</text>']
    counts = [np.histogram(values, edges)[0] for _, values in columns]
    most = max(int(count.max()) for count in counts) or 1
    scale = f"full colour: {most} frame{'s' if most != 1 else ''}"
    marks.append(f'<text x="{width}" y="12" text-anchor="end">{scale}</text>')
    for column, (count, (label, values)) in enumerate(zip(counts, columns, strict=True)):
        x = _LEFT + step_x * column
        mean = f": mean {np.mean(values):.2f} of {len(values)}" if values else ""
        cells = "".join(
            f'<rect class="cell s{index % SERIES}" x="{x:.1f}" '
            f'y="{height - _BOTTOM - step_y * (row + 1):.1f}" '
            f'width="{max(step_x - 1, 0.5):.1f}" height="{step_y - 1:.1f}" fill-opacity="{n / most:.2f}"/>'
            for row, n in enumerate(count)
            if n
        )
        marks.append(f"<g><title>{escape(label + mean)}</title>{cells}</g>")
    for row in range(0, len(edges), max((len(edges) - 1) // 4, 1)):
        y = height - _BOTTOM - step_y * row
        marks.append(f'<path class="axis" d="M{_LEFT} {y:.1f}H{width}"/>')
        marks.append(f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{compact(edges[row])}</text>')
    every = max(len(columns) // 8, 1)
    for column in range(0, len(columns), every):
        x = _LEFT + step_x * (column + 0.5)
        marks.append(f'<text x="{x:.1f}" y="{height - 22}" text-anchor="middle">{escape(columns[column][0])}</text>')
    return _svg(title, width, height, marks)


def bar_chart(
    title: str, x_label: str, labels: Sequence[str], series: Sequence[tuple[int, Sequence[float | None]]]
) -> str:
    """SVG of a group of bars at each label, one for each run, from 0 up; None leaves a gap.

    series: (the run's colour, its values at the labels)
    """
    values = [value for _, heights in series for value in heights if value is not None]
    ticks = nice_ticks(0, max(values, default=0), 4)
    step = (BAR_WIDTH - _LEFT - _RIGHT) / len(labels)
    width = 0.72 * step / len(series)
    marks = [f'<text x="0" y="12">{escape(title)}</text>']

    def height_of(value: float) -> float:
        return value / ticks[-1] * (HEIGHT - _TOP - _BOTTOM)

    for tick in ticks:
        y = HEIGHT - _BOTTOM - height_of(tick)
        marks.append(f'<path class="axis" d="M{_LEFT} {y:.1f}H{BAR_WIDTH - _RIGHT}"/>')
        marks.append(f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{compact(tick)}</text>')
    for place, label in enumerate(labels):
        x = _LEFT + step * (place + 0.5)
        marks.append(f'<text x="{x:.1f}" y="{HEIGHT - 22}" text-anchor="middle">{escape(label)}</text>')
        for number, (index, heights) in enumerate(series):
            value = heights[place]
            if value is None:
                continue
            left, tall = x + (number - 0.5 * len(series)) * width, height_of(value)
            marks.append(
                f'<g><title>{escape(label)}: {value:.4f}</title><rect class="cell s{index % SERIES}" x="{left:.1f}" '
                f'y="{HEIGHT - _BOTTOM - tall:.1f}" width="{max(width - 1.5, 0.5):.1f}" height="{tall:.1f}"/></g>'
            )
    marks.append(f'<text x="{BAR_WIDTH - _RIGHT}" y="{HEIGHT - 4}" text-anchor="end">{escape(x_label)}</text>')
    return _svg(f"{title} by {x_label}", BAR_WIDTH, HEIGHT, marks)


def shared_edges(values: Sequence[float], bins: int = 12) -> list[float]:
    """Edges of about `bins` bins of a round width that hold all `values`."""
    low, high = min(values), max(values)
    step = _round_step(max(high - low, 1e-6 * max(abs(high), 1), 0.5) / bins)
    first = math.floor(low / step)
    return [round(step * k, 10) for k in range(first, max(math.floor(high / step) + 1, first + bins) + 1)]


def nice_ticks(low: float, high: float, count: int) -> list[float]:
    """About `count` round numbers from `low` or just below it to `high` or just above it."""
    step = _round_step((high - low or abs(high) or 1) / count)
    first = math.floor(low / step + 1e-9)
    last = max(math.ceil(high / step - 1e-9), first + 1)
    return [round(step * k, 12) for k in range(first, last + 1)]


def compact(value: float) -> str:
    """A tick's label: 20k, 1.5M, 0.05."""
    for unit, name in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= unit:
            return f"{value / unit:.4g}{name}"
    return f"{value:.4g}"


def _log_ticks(low: float, high: float) -> list[float]:
    """Decades around [low, high], with 2 and 5 between them where there are few."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    factors = (1, 2, 5) if len(decades) <= 3 else (1,)
    ticks = [factor * 10.0**decade for decade in decades for factor in factors]
    inner = [tick for tick in ticks if low / 2.5 < tick < high * 2.5]
    return inner if len(inner) > 1 else ticks


def _span(ticks: Sequence[float], values: Sequence[float]) -> tuple[float, float]:
    return min(ticks[0], *values), max(ticks[-1], *values)


def _round_step(step: float) -> float:
    """The smallest of 1, 2, 2.5 and 5 times a power of ten that is at least `step`."""
    unit = 10.0 ** math.floor(math.log10(step))
    return next(factor * unit for factor in (1, 2, 2.5, 5, 10) if factor * unit >= step * (1 - 1e-9))


def _svg(label: str, width: float, height: float, marks: Sequence[str]) -> str:
    return f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(label)}">{"".join(marks)}</svg>'
