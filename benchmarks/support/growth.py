"""How a time grows with the work: slopes on logarithmic axes, a linear model, and a chart of both as SVG."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from spacesim.eval.report.charts import compact
from spacesim.eval.report.html import escape

SIZES = {
    "cuda": "10000x1024,31622x1024,100000x1024,316228x1024,1000000x1024,"
    "100000x128,100000x256,100000x512,100000x2048,1000000x2048",
    "llvm": "10000x256,31622x256,100000x256,316228x256,1000000x256,100000x128,100000x512,100000x1024,100000x2048",
}
WIDTH, HEIGHT = 640, 400
LEFT, RIGHT, TOP, BOTTOM = 62, 18, 44, 52
SLOPE_ONE, OTHER = "#5a6472", "#1b2027"
COLORS = {"gaussians": "#2a66ad", "pixels": "#b9560f"}


@dataclass(frozen=True)
class Point:
    """A measurement: what was drawn, and milliseconds."""

    gaussians: int
    pixels: int  #: of a side
    pairs: int  #: of tile and splat
    milliseconds: float


def slope(points: list[Point]) -> float:
    """d log t / d log pairs by least squares: 1 is linear, less where fixed costs show."""
    x, y = np.log([p.pairs for p in points]), np.log([p.milliseconds for p in points])
    return float(np.polyfit(x, y, 1)[0]) if len(points) > 1 else float("nan")


def model(points: list[Point]) -> tuple[dict[str, float], float]:
    """({part: ms}, largest relative error) of t = c0 + c1 pairs + c2 Gaussians + c3 pixels, none negative.

    Fitted to relative errors. A time that is linear in the work is met by it at every size.
    """
    work = np.array([[1, p.pairs / 1e6, p.gaussians / 1e6, p.pixels**2 / 1e6] for p in points])
    times = np.array([p.milliseconds for p in points])
    coefficients, _ = nnls(work / times[:, None], np.ones(len(points)))
    names = ("fixed", "a million pairs", "a million Gaussians", "a million pixels")
    return dict(zip(names, coefficients.tolist(), strict=True)), float(np.abs(work @ coefficients / times - 1).max())


def summary(points: list[Point]) -> dict[str, float]:
    """Slopes of the whole and of the larger half, and the linear model, in ms."""
    ordered = sorted(points, key=lambda p: p.pairs)
    parts, worst = model(points)
    result = {"slope": slope(points)} if len(points) > 1 else {}
    if len(points) > 3:
        result["slope, larger half"] = slope(ordered[len(ordered) // 2 :])
    return (
        result | {f"ms {name}": value for name, value in parts.items()} | {"largest error of the fit, %": 100 * worst}
    )


def plot(title: str, points: list[Point]) -> str:
    """SVG that stands alone: milliseconds against pairs, both logarithmic. A series varies the Gaussians, another the
    pixels, what is in neither is a mark of its own; a dashed line has slope 1."""
    series = {"gaussians": common_side(points), "pixels": common_count(points)}
    series = {name: chosen for name, chosen in series.items() if len(chosen) > 1}
    others = [p for p in points if not any(p in chosen for chosen in series.values())]
    xs, ys = [p.pairs for p in points], [p.milliseconds for p in points]
    (left, right), (low, high) = decades(xs), decades(ys)

    def place(x: float, y: float) -> tuple[float, float]:
        return (
            LEFT + np.log(x / left) / np.log(right / left) * (WIDTH - LEFT - RIGHT),
            HEIGHT - BOTTOM - np.log(y / low) / np.log(high / low) * (HEIGHT - TOP - BOTTOM),
        )

    marks = [f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>', text(LEFT, 20, f"{title}, ms", "start", 14)]
    for x in ticks(left, right):
        at = place(x, low)[0]
        marks.append(f'<path d="M{at:.1f} {TOP}V{HEIGHT - BOTTOM}" stroke="#e2e3de"/>')
        marks.append(text(at, HEIGHT - BOTTOM + 18, compact(x), "middle"))
    for y in ticks(low, high):
        at = place(left, y)[1]
        marks.append(f'<path d="M{LEFT} {at:.1f}H{WIDTH - RIGHT}" stroke="#e2e3de"/>')
        marks.append(text(LEFT - 8, at + 4, compact(y), "end"))
    marks.append(text(WIDTH - RIGHT, HEIGHT - 12, "pairs of tile and splat", "end"))
    top = max(points, key=lambda p: p.pairs)
    start = max(left, low / top.milliseconds * top.pairs)
    ends = place(start, top.milliseconds * start / top.pairs), place(top.pairs, top.milliseconds)
    (x0, y0), (x1, y1) = ends
    marks.append(f'<path d="M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" stroke="{SLOPE_ONE}" stroke-dasharray="5 4"/>')
    legend = [(SLOPE_ONE, "slope 1")]
    for name, chosen in series.items():
        where = [place(p.pairs, p.milliseconds) for p in chosen]
        path = "L".join(f"{x:.1f} {y:.1f}" for x, y in where)
        marks.append(f'<path d="M{path}" fill="none" stroke="{COLORS[name]}" stroke-width="2"/>')
        marks += [dot(x, y, COLORS[name]) for x, y in where]
        legend.append((COLORS[name], f"{describe(name, chosen)}: slope {slope(chosen):.2f}"))
    for point in others:
        x, y = place(point.pairs, point.milliseconds)
        words = f"{compact(point.gaussians)} on {point.pixels}²"
        marks += [
            dot(x, y, OTHER),
            text(x - 7, y - 6, words, "end") if x > WIDTH / 2 else text(x + 7, y + 14, words, "start"),
        ]
    for row, (color, words) in enumerate(reversed(legend)):
        at = TOP + 16 + 18 * row
        dashes = ' stroke-dasharray="5 4"' if color == SLOPE_ONE else ' stroke-width="2"'
        marks.append(f'<path d="M{LEFT + 12} {at - 4}h22" stroke="{color}"{dashes}/>')
        marks.append(text(LEFT + 42, at, words, "start"))
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}"'
    return f'{head} role="img" aria-label="{escape(title)}" font-family="sans-serif">{"".join(marks)}</svg>\n'


def dot(x: float, y: float, color: str) -> str:
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{color}"/>'


def common_side(points: list[Point]) -> list[Point]:
    """The points on the number of pixels that most of them have, by pairs."""
    sides = [p.pixels for p in points]
    return sorted((p for p in points if p.pixels == max(sides, key=sides.count)), key=lambda p: p.pairs)


def common_count(points: list[Point]) -> list[Point]:
    """The points with the number of Gaussians that most of them have, by pairs."""
    counts = [p.gaussians for p in points]
    return sorted((p for p in points if p.gaussians == max(counts, key=counts.count)), key=lambda p: p.pairs)


def describe(name: str, points: list[Point]) -> str:
    first, last = points[0], points[-1]
    if name == "gaussians":
        return f"{compact(first.gaussians)} to {compact(last.gaussians)} Gaussians on {first.pixels}² pixels"
    return f"{compact(first.gaussians)} Gaussians on {first.pixels}² to {last.pixels}² pixels"


def decades(values: Sequence[float]) -> tuple[float, float]:
    """The nearest of 1, 2 and 5 times a power of ten below and above all values."""
    steps = [factor * 10.0**power for power in range(-6, 12) for factor in (1, 2, 5)]
    return max(s for s in steps if s <= min(values)), min(s for s in steps if s > max(values))


def ticks(low: float, high: float) -> list[float]:
    steps = [factor * 10.0**power for power in range(-6, 12) for factor in (1, 2, 5)]
    inner = [s for s in steps if low * 0.999 <= s <= high * 1.001]
    return inner if len(inner) <= 9 else [s for s in inner if np.isclose(np.log10(s), np.round(np.log10(s)))]


def text(x: float, y: float, words: str, anchor: str, size: int = 12) -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size}" fill="#1b2027">{escape(words)}</text>'
    )
