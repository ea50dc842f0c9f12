"""EVAL folders as the report reads them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from spacesim.data.errors import InputError
from spacesim.data.files import MAX_LIST_BYTES, JsonDict
from spacesim.data.identity import same_digest
from spacesim.data.structure import read_record
from spacesim.eval.report.html import escape, swatch
from spacesim.eval.schema import RULES, Metrics


@dataclass(frozen=True, eq=False)
class Evaluation:
    """An evaluation on disk, as the report reads it."""

    folder: Path  #: that `spacesim eval` has written
    index: int  #: place in the report
    name: str  #: the run's, unique there
    metrics: JsonDict  #: what metrics.json holds

    @property
    def label(self) -> str:
        """HTML: the run's coloured dot and its name."""
        return swatch(self.index) + escape(self.name)

    @property
    def frames(self) -> dict[str, JsonDict]:
        """The evaluated frames by the names of their folders."""
        return {frame["name"]: frame for frame in self.metrics["frames"]}

    @property
    def scene(self) -> str:
        """What the pictures show: the scene's name or else the data folder's."""
        return str(self.metrics["dataset"].get("scene") or Path(self.metrics["data"]).name)

    @property
    def whole_pictures(self) -> bool:
        """Whether no silhouette is known: then "image" is over whole pictures."""
        return self.metrics.get("image_region") == "frame"

    @property
    def tag(self) -> str:
        """HTML: what was fitted to the pictures that it is evaluated on, "" for nothing."""
        fitted = ", ".join(part["name"] for part in self.metrics.get("fitted") or [])
        return f' <small class="fitted">{escape(fitted)} fitted</small>' if fitted else ""

    def mean(self, group: str, metric: str) -> float | None:
        """Mean of a metric over the frames; None where it is null."""
        value = self.summary(group, metric)
        return None if value is None else value["mean"]

    def summary(self, group: str, metric: str, suns: str = "") -> JsonDict | None:
        """Mean, spread and count of a metric; None where it is null. suns: "" all frames, or "known_suns" or
        "unseen_suns": those frames alone."""
        where = self.metrics.get(suns) if suns else self.metrics
        return ((where or {}).get(group) or {}).get(metric)


def read_evals(folders: Sequence[Path]) -> list[Evaluation]:
    """The evaluations in `folders`. Raises InputError where there is none or a folder holds no such."""
    if not folders:
        raise InputError("report: expected at least one EVAL folder, found none")
    contents = [_read_metrics(Path(folder)) for folder in folders]
    names = _unique_names(contents, [Path(folder) for folder in folders])
    together = zip(folders, names, contents, strict=True)
    return [Evaluation(Path(folder), index, name, metrics) for index, (folder, name, metrics) in enumerate(together)]


def by_data(runs: Sequence[Evaluation]) -> list[list[Evaluation]]:
    """The runs that were evaluated on the same frames, together, in their order; each numbered within its group.

    Frames are known by their digest; where a file lacks it, those of one folder and split are the same. What
    "image" is over must be the same, too.
    """
    groups: list[list[Evaluation]] = []
    for run in runs:
        for group in groups:
            if all(_same_frames(run, other) for other in group):
                group.append(replace(run, index=len(group)))
                break
        else:
            groups.append([replace(run, index=0)])
    return groups


def _same_frames(one: Evaluation, other: Evaluation) -> bool:
    if one.whole_pictures != other.whole_pictures:
        return False
    digests = [run.metrics["dataset"].get("digest") for run in (one, other)]
    if all(digests):
        return same_digest(*digests)
    return all(one.metrics[key] == other.metrics[key] for key in ("data", "split"))


def legend(runs: Sequence[Evaluation]) -> str:
    """HTML that names the colours of several runs; "" for one."""
    if len(runs) == 1:
        return ""
    return f'<p class="key">{"".join(f"<span>{run.label}</span>" for run in runs)}</p>'


def _read_metrics(folder: Path) -> JsonDict:
    return read_record(folder / "metrics.json", Metrics, RULES, MAX_LIST_BYTES)[1]


def _unique_names(contents: Sequence[JsonDict], folders: Sequence[Path]) -> list[str]:
    """The runs' last path components if these differ, else the runs' paths, else those of the folders."""
    for names in (
        [Path(metrics["run"]).name for metrics in contents],
        [str(metrics["run"]) for metrics in contents],
        [str(folder) for folder in folders],
    ):
        if len(set(names)) == len(names) and all(names):
            return names
    return [f"{folder} ({number})" for number, folder in enumerate(folders, start=1)]
