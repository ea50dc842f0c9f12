"""All methods of reconstruction behind one door: Gaussians (`splat`) and radiance fields (`nerf`).

A method's name says its family; of a run, that is the method that its config.json names.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from spacesim.data.errors import InputError
from spacesim.data.files import JsonMapping, as_path, read_json
from spacesim.data.records import Dataset
from spacesim.data.structure import did_you_mean
from spacesim.nerf import config as nerf
from spacesim.nerf.config import NerfConfig
from spacesim.splat.train import config as splat
from spacesim.splat.train.config import TrainConfig

if TYPE_CHECKING:
    from spacesim.learning.folder import TrainingProgress
    from spacesim.nerf.run import NerfRun
    from spacesim.splat.compose.posed_scene import PosedScene
    from spacesim.splat.run import Predictor, Run

METHODS = (*splat.METHODS, *nerf.METHODS)
Config = TrainConfig | NerfConfig


@overload
def preset(name: str = "fast", method: splat.Method = "vanilla", strategy: str | None = None) -> TrainConfig: ...


@overload
def preset(name: str, method: nerf.Method, strategy: None = None) -> NerfConfig: ...


@overload
def preset(name: str = "fast", method: str = "vanilla", strategy: str | None = None) -> Config: ...


def preset(name: str = "fast", method: str = "vanilla", strategy: str | None = None) -> Config:
    """The configuration of a preset, a `TrainConfig` or, of a radiance field, a `NerfConfig`.

    name: "demo", "fast", "fine" (Gaussians alone) or "thesis";  method: one of `spacesim train --help`;  strategy: of
    densification, "default" where none is named
    Raises InputError for a name that is none, and for a strategy of a method without Gaussians.
    """
    if method not in nerf.METHODS:
        if method not in (*splat.METHODS, *splat.ALIASES):
            hint = did_you_mean(method, METHODS)
            raise InputError(f"method: expected one of {', '.join(METHODS)}, found {method!r}{hint}")
        return splat.preset(name, method, strategy or "default")
    if strategy is not None:
        raise InputError(f"strategy: expected with a method of Gaussians, found {strategy!r} with {method}")
    return nerf.preset(name, method)


def configuration(
    name: str | None = None, method: str | None = None, strategy: str | None = None, begun: Path | None = None
) -> Config:
    """What `preset` returns for these names, "fast" and "vanilla" where none is given; of the run that is begun in the
    folder `begun`, if there is one, its own configuration. Raises InputError as `preset`, and for a name that is not
    that of the run."""
    chosen = preset("fast" if name is None else name, "vanilla" if method is None else method, strategy)
    own = None if begun is None else _begun_configuration(begun)
    if begun is None or own is None:
        return chosen
    from spacesim.learning.folder import holds_training, started_with

    given = {"method": method, "preset": name, "strategy": strategy}
    found, names = _names_of(chosen), _names_of(own)
    differing = [key for key, word in given.items() if word is not None and found[key] != names[key]]
    if not differing:
        return own
    if holds_training(begun):
        raise started_with(begun, differing[0], names[differing[0]], found[differing[0]])
    method = method or own.method
    strategy = strategy or (None if method in nerf.METHODS else names["strategy"])
    return preset(name or own.preset or "fast", method, strategy)


def _names_of(config: Config) -> dict[str, str | None]:
    """The names by which `preset` gives a configuration of its kind."""
    strategy = None if isinstance(config, NerfConfig) else config.strategy.kind
    return {"method": config.method, "preset": config.preset, "strategy": strategy}


def _begun_configuration(out: Path) -> Config | None:
    """Of the run in a folder, whether its training has ended or not; None where there is none, or one that is broken
    and has not come to a checkpoint."""
    from spacesim.learning.folder import holds_training, read_described

    path = out / "config.json"
    if not path.exists():
        return None
    try:
        values, _ = read_described(path)
        family = NerfConfig if _method_of(path, values) in nerf.METHODS else TrainConfig
        return family.from_json(values, str(path))
    except InputError:
        if holds_training(out):
            raise
        return None


def shortened(config: Config, iterations: int | None) -> Config:
    """`config` with so many iterations, its schedule with them where they are fewer; as it is for None."""
    if iterations is None:
        return config
    return nerf.shortened(config, iterations) if isinstance(config, NerfConfig) else splat.shortened(config, iterations)


def with_settings(config: Config, settings: JsonMapping) -> Config:
    """`config` with fields set by their dotted names. Raises InputError for a name or a value that cannot be."""
    for name in ("method", "preset"):
        if name in settings:
            raise InputError(f"{name}: expected beside the settings, for it sets all that goes with it, found in them")
    if isinstance(config, NerfConfig):
        return nerf.with_settings(config, settings)
    return splat.with_settings(config, settings)


def train(
    dataset: Dataset,
    out: Path,
    config: Config,
    resume: bool = False,
    on_progress: "Callable[[TrainingProgress], None]" = lambda progress: None,
    command: Sequence[str] = (),
) -> "Run | NerfRun":
    """Train with the family's own `train`."""
    if isinstance(config, NerfConfig):
        from spacesim.nerf.train.train import train as train_field

        return train_field(dataset, out, config, resume, on_progress, command)
    from spacesim.splat.train.train import train as train_splats

    return train_splats(dataset, out, config, resume, on_progress, command)


def load_run(path: str | Path) -> "Run | NerfRun":
    """Load a finished run of any method. Raises InputError where the folder is no run or its training has not ended."""
    path = as_path(path, "path")
    config = path / "config.json"
    if _method_of(config, read_json(config) if config.exists() else {}) in nerf.METHODS:
        from spacesim.nerf.run import load_run as load_field

        return load_field(path)
    from spacesim.splat.run import load_run as load_splats

    return load_splats(path)


def _method_of(path: Path, values: object) -> str:
    """Of what a run's config.json at `path` holds; a file without it is of Gaussians, whose reader says what it lacks.
    Raises InputError where it names none that is known."""
    method = values.get("method", "vanilla") if isinstance(values, dict) else "vanilla"
    if method not in (*METHODS, *splat.ALIASES):
        raise InputError(f"{path}: method: expected one of {', '.join(METHODS)}, found {method!r:.60}")
    return str(method)


def load_scene(path: str | Path) -> "PosedScene":
    """The scene that a TOML file describes, of runs of any method. Raises InputError with file, line and key."""
    from spacesim.splat.compose.scenefile import load_scene as load

    return load(path, load_run, compose)


def load_predictor(path: Path) -> "Predictor":
    """The run in a folder, or the scene of a TOML file at its beginning. Raises InputError where there is neither."""
    if path.suffix != ".toml":
        return load_run(path)
    from spacesim.splat.compose import ComposedRun

    return ComposedRun(load_scene(path).posed_at(0.0), path)


def compose(models: Sequence[Any], config: Any = None, path: Path | None = None) -> Any:
    """What draws posed runs: `splat.compose.GaussianComposition`, of fields `nerf.compose.FieldComposition`, of both
    `mixed.scene.MixedComposition`."""
    from spacesim.mixed.scene import MixedComposition
    from spacesim.nerf.compose import FieldComposition
    from spacesim.nerf.run import NerfRun
    from spacesim.splat.compose.scene import ComposeConfig, GaussianComposition

    fields = [isinstance(model.run, NerfRun) for model in models]
    kind = FieldComposition if fields and all(fields) else MixedComposition if any(fields) else GaussianComposition
    return kind(models, config or ComposeConfig(), path)
