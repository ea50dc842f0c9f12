"""What the benchmarks share: the splats that are measured, clocks, tables, and a record of where they ran."""

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.backend import BackendError
from spacesim.backend.kernels.ptx import take_times
from spacesim.data.errors import InputError, WorkError
from spacesim.data.files import write_bytes
from spacesim.data.geometry import fibonacci_sphere, look_at
from spacesim.data.records import Camera, Dataset
from spacesim.eval.report.html import escape

if TYPE_CHECKING:
    from spacesim.eval.evaluate import EvaluateConfig
    from spacesim.splat.run import Run
    from spacesim.splat.train.config import TrainConfig

WARM_UP = 5  #: calls that do not count
WARM = 0.3  #: seconds until a GPU's clock has risen, and the host has seen each way through the code
ROUNDS = 3  #: of a measurement: which processors are quiet changes
IN_A_ROW = 20  #: steps that are timed together
QUIET = 1.1  #: times what the quickest processor takes, up to which one is quiet
PACKAGES = ("spacesim", "drjit", "mitsuba", "numpy", "torch", "gsplat", "fused_ssim", "FasterGSCudaBackend")
FIELD_OF_VIEW = 35  #: degrees
CURVES = "#5a6472", "#b9560f", "#2a66ad", "#3d7a3a"  #: colours of a chart that stands alone
DISTANCE = float(np.sqrt(18))  #: of the cameras from the centre of a sphere of radius 1: it fills most of the picture
KNOWN_AND_UNSEEN = {  # of a dataset: its training Suns are tested, too, and 8 that none of its pictures is under
    "spp": 64,
    "test_suns": 8,
    "test_views": 5,
    "known_test_views": 2,
    "shared_test_views": True,
}

Work = Callable[[], Any]
Row = dict[str, Any]


@dataclass(frozen=True)
class Timing:
    """Milliseconds of a call: median, quartiles, least."""

    median: float
    low: float
    high: float
    least: float

    @staticmethod
    def of(seconds: Iterable[float]) -> "Timing":
        least, low, median, high = (1e3 * np.percentile(np.array(list(seconds)), [0, 25, 50, 75])).tolist()
        return Timing(median, low, high, least)

    def __str__(self) -> str:
        return f"{self.median:.2f} ({self.low:.2f} to {self.high:.2f})"


def arguments(
    text: str | None, *more: Literal["sizes", "repeats"], sizes: str | None = None
) -> argparse.ArgumentParser:
    """A parser with the options that every benchmark has, and `more` that several have. text: the script's docstring;
    sizes: the default"""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", choices=backend.NAMES, default="auto")
    if "sizes" in more:
        parser.add_argument("--sizes", default=sizes, help="GAUSSIANSxPIXELS,... (pictures are square)")
    if "repeats" in more:
        parser.add_argument("--repeats", type=positive, default=30, help="timed calls of each (default 30)")
    parser.add_argument("--json", nargs="?", const=Path("-"), type=Path, metavar="FILE", help="to FILE or the screen")
    parser.add_argument("--markdown", action="store_true", help="tables in Markdown")
    return parser


def positive(text: str) -> int:
    """A whole number of at least 1, for argparse."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"expected at least 1, found {number}")
    return number


def natural(text: str) -> int:
    """A whole number of at least 0, for argparse."""
    number = int(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"expected at least 0, found {number}")
    return number


def parse_sizes(text: str) -> list[tuple[int, int]]:
    """[(Gaussians, pixels of a side)] of "31622x1024,...". Raises InputError where it is malformed."""
    try:
        sizes = [(int(count), int(pixels)) for count, pixels in (item.split("x") for item in text.split(","))]
    except ValueError:
        raise InputError(f"--sizes: expected GAUSSIANSxPIXELS,..., found {text!r}") from None
    if min(min(size) for size in sizes) < 1:
        raise InputError(f"--sizes: expected numbers of at least 1, found {text!r}")
    return sizes


def run_main(main: Callable[[], None]) -> None:
    """Run a benchmark; what its user can mend ends it with a sentence and code 2, what cannot be done with code 1."""
    try:
        main()
    except (InputError, BackendError, WorkError) as error:
        print(error, file=sys.stderr)
        sys.exit(2 if isinstance(error, InputError) else 1)


def generated(scene: str, out: Path, **options: Any) -> Path:
    """The folder of a scene's dataset, made as far as it is not there."""
    from spacesim.progress import show_progress
    from spacesim.scenes.generation.generate import generate
    from spacesim.scenes.scenefile import read_scene

    with show_progress("generate", "frames") as report:
        generate(read_scene(scene, **options), out, resume=True, progress=report)
    return out


def measured(
    name: str,
    config: "TrainConfig",
    evaluation: "EvaluateConfig",
    dataset: Dataset,
    folder: Path,
    truth: Dataset | None = None,
) -> Row:
    """metrics.json of a configuration, trained on a dataset in FOLDER/run and evaluated on it, or on `truth`, in
    FOLDER/eval, as far as that is not done; "training" beside it, or {"note": why} where training fails."""
    from spacesim.progress import show_progress
    from spacesim.reproduce.perform import evaluated, trained

    try:
        run = trained(folder / "run", dataset, config, name, show_progress)
    except WorkError as error:
        return {"note": str(error)}
    return {
        **evaluated(run, truth or dataset, folder / "eval", evaluation, name, show_progress),
        "training": run.training,
    }


def number_in(metrics: Row, *names: str) -> float | None:
    """The number that stands under these names in a report, one within another; None where one of them has nothing."""
    value: Any = metrics
    for name in names:
        value = (value or {}).get(name)
    return value


def standalone(drawn: str, names: Sequence[str]) -> str:
    """An SVG file's text of a `line_chart`: its own colours and letters, and the curves' names."""
    style = ".line{fill:none;stroke-width:2}.axis{stroke:#e2e3de}text{font:12px sans-serif;fill:#1b2027}"
    style += "".join(f".s{i}{{stroke:{color}}}" for i, color in enumerate(CURVES))
    marks = [f"<style>{style}</style>", '<rect width="100%" height="100%" fill="#fff"/>']
    for row, name in enumerate(names):
        marks.append(
            f'<text x="250" y="{130 + 16 * row}" style="fill:{CURVES[row % len(CURVES)]}">{escape(name)}</text>'
        )
    head, inner = drawn.split(">", 1)
    return f'{head} xmlns="http://www.w3.org/2000/svg">{"".join(marks)}{inner}\n'


def row_names(text: str) -> list[str]:
    """The names of `--rows`: commas separate them, but one before a space belongs to a name ("map, no bias")."""
    return re.split(r",(?! )", text)


def sphere_arrays(count: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Splats on the unit sphere, a little narrower than their spacing, turned and coloured at random, SH degree 3."""
    rng, spacing = np.random.default_rng(seed), np.sqrt(4 * np.pi / count)
    return {
        "means": fibonacci_sphere(count),
        "log_scales": np.log(spacing * rng.uniform(0.3, 1.0, (count, 3))),
        "quaternions": rng.normal(size=(count, 4)),
        "logit_opacities": rng.normal(size=count),
        "sh": 0.3 * rng.normal(size=(count, 16, 3)),
    }


def sphere_run(count: int, seed: int = 0) -> "Run":
    """Such splats with features, relit and with shadows by untrained networks, refinement included."""
    from spacesim.splat.light.model import LightModel, TrainingFrame
    from spacesim.splat.raster.gaussians import Gaussians
    from spacesim.splat.run import Run
    from spacesim.splat.train.config import preset, with_settings

    refine = preset("demo", "shadow-splat").to_json()["light"]["shadow"]["refine"]
    config = with_settings(preset("demo", "shadow-map"), {"light.shadow.refine": refine}).light
    assert config is not None
    features = np.random.default_rng(seed).normal(size=(count, config.features)).astype(np.float32)
    arrays = {**sphere_arrays(count, seed), "sh": np.zeros((count, 0, 3)), "features": features}
    light = LightModel.initial(config, TrainingFrame(np.zeros(3), 1.0, DISTANCE, 1.0), seed)
    return Run(Path(f"sphere{seed}"), {"method": "shadow-map"}, {}, Gaussians.from_numpy(arrays), 0, light)


def camera_from(direction: Sequence[float], pixels: int) -> Camera:
    """A camera that looks at the sphere from a direction [3]."""
    place = DISTANCE * np.asarray(direction, np.float64) / np.linalg.norm(direction)
    return Camera.from_fov(look_at(place, np.zeros(3)), pixels, pixels, FIELD_OF_VIEW)


def synchronise() -> None:
    """Wait for everything that Dr.Jit and torch have under way."""
    dr.sync_thread()
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available():
        torch.cuda.synchronize()


def seconds(works: Mapping[str, Work], repeats: int, warm_up: int = WARM_UP) -> dict[str, list[float]]:
    """Of each work, device synchronised before and after; they take turns, so that all see the same machine. warm_up:
    turns that do not count, and more until `WARM` seconds are over; 0: none"""
    durations: dict[str, list[float]] = {name: [] for name in works}
    begun, turns, cold = time.perf_counter(), 0, warm_up
    while turns < cold + repeats:
        for name, work in works.items():
            synchronise()
            start = time.perf_counter()
            work()
            synchronise()
            durations[name].append(time.perf_counter() - start)
        turns += 1
        if 0 < warm_up <= turns == cold and time.perf_counter() - begun < WARM:
            cold += 1
    return {name: values[cold:] for name, values in durations.items()}


def on_quiet_host(works: Mapping[str, Work], repeats: int, warm_up: int) -> dict[str, list[float]]:
    """`seconds` in `ROUNDS`, each by the processors that are quiet then (`on_quiet_processors`)."""
    durations: dict[str, list[float]] = {name: [] for name in works}
    for part in range(ROUNDS):
        with on_quiet_processors():
            for name, values in seconds(works, -(-repeats // ROUNDS), 1 if part else warm_up).items():
                durations[name] += values
    return durations


def in_a_row(works: Mapping[str, Work], repeats: int, turn: int = IN_A_ROW, warm_up: int = 1) -> dict[str, list[float]]:
    """Seconds of a call of each work, `turn` of them timed together, as in training, where the device need not wait for
    the host between two, `on_quiet_host`. warm_up: turns"""

    def several(work: Work) -> Work:
        def calls() -> None:
            for _ in range(turn):
                work()

        return calls

    timed = on_quiet_host({name: several(work) for name, work in works.items()}, repeats, warm_up)
    return {name: [of_turn / turn for of_turn in values] for name, values in timed.items()}


def quiet_processors() -> set[int]:
    """Of this process's, those that take no longer than `QUIET` times as long for some Python as the quickest: where
    another guest of the host keeps the other thread of a core busy, ours takes up to twice as long (Linux)."""
    mine = os.sched_getaffinity(0)
    try:
        taken = {one: _probe(one) for one in sorted(mine)}
    finally:
        os.sched_setaffinity(0, mine)
    return {one for one, seconds in taken.items() if seconds <= QUIET * min(taken.values())}


def _probe(processor: int) -> float:
    """Seconds of some Python there."""
    os.sched_setaffinity(0, {processor})
    start = time.perf_counter()
    sum(number * number for number in range(50_000))
    return time.perf_counter() - start


@contextmanager
def on_quiet_processors() -> Iterator[None]:
    """All threads of this process on `quiet_processors` meanwhile, where the system lets them be put there, and a GPU
    computes."""
    if backend.select() != "cuda" or not hasattr(os, "sched_setaffinity"):
        yield
        return
    mine, quiet = os.sched_getaffinity(0), quiet_processors()
    _quiet.append(f"{len(quiet)} of {len(mine)}")
    _put_threads(quiet)
    try:
        yield
    finally:
        _put_threads(mine)


def _put_threads(processors: set[int]) -> None:
    for thread in Path("/proc/self/task").iterdir():
        with suppress(OSError):  # it has ended
            os.sched_setaffinity(int(thread.name), processors)


_quiet: list[str] = []  # how many processors were, at each measurement


def interleaved(works: Mapping[str, Work], repeats: int, warm_up: int = WARM_UP) -> dict[str, Timing]:
    """The same as timings, `on_quiet_host`."""
    return {name: Timing.of(values) for name, values in on_quiet_host(works, repeats, warm_up).items()}


@dataclass(frozen=True)
class Kernels:
    """What Dr.Jit's kernel history and `ptx.take_times` say of a call: launches, milliseconds on the device (median
    and least)."""

    launches: int
    milliseconds: float
    least: float


def kernels(work: Work, repeats: int = 7) -> Kernels:
    """Of one call, warm: the sum of the times of its kernels, copies and fills."""
    return kernels_in_turn({"work": work}, repeats)["work"]


def kernels_in_turn(works: Mapping[str, Work], repeats: int = 7) -> dict[str, Kernels]:
    """The same of works that follow each other, so that each finds the caches as the one before has left them."""
    sums: dict[str, list[float]] = {name: [] for name in works}
    launches = dict.fromkeys(works, 0)
    for _ in range(WARM_UP):
        for work in works.values():
            work()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for _ in range(repeats):
            for name, work in works.items():
                take_times()
                dr.sync_thread()
                dr.kernel_history_clear()
                work()
                dr.sync_thread()
                times = [entry["execution_time"] for entry in dr.kernel_history()] + take_times()
                launches[name] = len(times)
                sums[name].append(sum(times))
    return {name: Kernels(launches[name], float(np.median(sums[name])), min(sums[name])) for name in works}


def _processors() -> tuple[float, float]:
    """Seconds that the machine's processors have had, and of these such as other guests of its host took (Linux)."""
    path = Path("/proc/stat")
    ticks = [float(number) for number in path.read_text().split("\n", 1)[0].split()[1:9]] if path.exists() else [0.0]
    return sum(ticks), ticks[-1]


_BEFORE = os.getloadavg()[0], _processors()  # the benchmark begins: load, and what `_processors` says


def machine() -> dict[str, str]:
    """The device, how quiet it was, and the versions of all that takes part."""
    name = backend.select()
    facts = {"backend": name, "device": _gpu() if name == "cuda" else _cpu(), "python": platform.python_version()}
    load, before = _BEFORE
    had, stolen = (now - then for now, then in zip(_processors(), before, strict=True))
    facts["load before"] = f"{load:.2f} of {os.cpu_count()} processors"
    facts["taken by other guests"] = f"{100 * stolen / max(had, 1e-9):.1f} %"
    if _quiet:
        facts["quiet processors"] = ", ".join(dict.fromkeys(_quiet))
    if name == "cuda":
        facts["cuda"] = ".".join(map(str, dr.detail.cuda_version()))
    else:
        facts["llvm"] = ".".join(map(str, dr.detail.llvm_version()))
    for package in PACKAGES:
        try:
            facts[package] = _version(package)
        except PackageNotFoundError:
            continue
    return facts


def _version(package: str) -> str:
    """Of an installed one, with its commit where pip has it from a repository."""
    found = distribution(package)
    origin = json.loads(found.read_text("direct_url.json") or "{}").get("vcs_info", {})
    return f"{found.version} {origin.get('commit_id', '')[:7]}".strip()


def _gpu() -> str:
    query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    try:
        lines = subprocess.run(query, capture_output=True, text=True, check=True).stdout.splitlines()
    except (OSError, subprocess.CalledProcessError):
        return "an NVIDIA GPU"
    return lines[0].replace(", ", ", driver ")


def _cpu() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.processor()}, {dr.thread_count()} threads"


def resident() -> float:
    """Bytes of memory that this process holds (Linux)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(float(line.split()[1]) for line in lines if line.startswith("VmRSS"))


def table(rows: Sequence[Row], markdown: bool) -> str:
    """Rows with the same keys as a table; numbers to the right."""
    if not rows:
        return ""
    head = list(dict.fromkeys(key for row in rows for key in row))
    cells = [head, *([_cell(row.get(key, "")) for key in head] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(head))]
    lines = [[cell.rjust(width) for cell, width in zip(line, widths, strict=True)] for line in cells]
    if not markdown:
        return "\n".join("  ".join(line) for line in lines)
    dashes = ["-" * (width - 1) + ":" for width in widths]
    return "\n".join("| " + " | ".join(line) + " |" for line in [lines[0], dashes, *lines[1:]])


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.2f}" if abs(value) >= 0.095 or value == 0 else f"{value:.2g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def emit(report: dict[str, Any], tables: Mapping[str, Sequence[Row]], options: argparse.Namespace) -> None:
    """Print the tables under their titles, or the report as JSON, or both where the JSON goes to a file."""
    report = {"command": " ".join(["python", *sys.argv]), "machine": machine(), **report}
    text = json.dumps(report, indent=1, default=lambda value: asdict(value))
    if options.json is not None and str(options.json) == "-":
        print(text)
        return
    facts = ", ".join(f"{key} {value}" for key, value in report["machine"].items())
    print(f"`{report['command']}`\n\n{facts}" if options.markdown else f"{report['command']}\n{facts}")
    for title, rows in tables.items():
        if rows:
            print(f"\n{title}\n\n{table(rows, options.markdown)}")
    if options.json is not None:  # last: what was measured is on the screen where a file cannot be written
        write_bytes(options.json, f"{text}\n".encode())
