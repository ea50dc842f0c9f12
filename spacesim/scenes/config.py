"""What a scene file says: spacecraft and poses, materials, sources, rig, camera, quality."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from spacesim.data.errors import InputError, expect
from spacesim.data.files import JsonDict
from spacesim.data.records import Sun
from spacesim.data.structure import did_you_mean, field_value
from spacesim.scenes.background.config import BackgroundConfig
from spacesim.scenes.cameras.camera import FOV_DEG, CameraConfig
from spacesim.scenes.cameras.rig import Rig
from spacesim.scenes.cameras.sphere_rigs import FibonacciRig
from spacesim.scenes.lights.earth import EarthConfig
from spacesim.scenes.lights.sun import SunConfig
from spacesim.scenes.rigs import kinds_with, rig_kind
from spacesim.scenes.trajectory.rig import FileRig

Vector = tuple[float, float, float]
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3, "in": 0.0254, "ft": 0.3048}
"""Metres of the units that a mesh file may be in."""

UP_AXES = ("x", "y", "z")
"""Axes of a mesh file that may become z."""

SCALES = (1e-9, 1e9)
"""Least and greatest factor on the size of an object."""

MAX_COORDINATE = 1e9
"""Metres of a position in each coordinate (the Moon is at 3.8e8)."""


_UNLESS_ASKED_FOR = (
    "known_test_views",
    "shared_test_views",
    "min_phase_deg",
    "max_phase_deg",
)  # in scene.json: datasets without them stay as they were

MAX_SEED = 2**63 - 1
"""Largest whole number that every TOML reader knows."""


@dataclass(frozen=True)
class ObjectConfig:
    """An object and its pose. Raises InputError unless it names one of spacecraft and mesh."""

    spacecraft: str = ""  #: a built-in one
    mesh: str = ""  #: a mesh file, relative to the scene file
    name: str = ""  #: "" the spacecraft's or the file's
    position: Vector = (0.0, 0.0, 0.0)  #: metres, world frame
    #: quaternion that turns body axes into world axes, of any length but 0
    rotation_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    scale: float = 1.0  #: factor on its size
    units: str = "m"  #: of the mesh file, and only with one: "m", "cm", "mm", "km", "in" or "ft"
    up: str = ""  #: the mesh file's axis that becomes z: "x", "y" or "z"; "" the format's own, z where it has none
    two_sided: bool | None = None  #: whether all parts show both sides; None and False: open ones alone
    #: a material's name for each part or pattern of parts ("panel_*"), the last that fits counts
    materials: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if bool(self.spacecraft) == bool(self.mesh):
            given = "both" if self.mesh else "neither"
            raise InputError(f"objects: expected either spacecraft or mesh, found {given}")
        near = all(abs(x) <= MAX_COORDINATE for x in self.position)  # which nan is not
        expect(near, "position", f"metres from {-MAX_COORDINATE:g} to {MAX_COORDINATE:g}", list(self.position))
        turns = all(map(math.isfinite, self.rotation_wxyz)) and any(self.rotation_wxyz)
        expect(turns, "rotation_wxyz", "four finite numbers, not all 0", list(self.rotation_wxyz))
        least, most = SCALES
        expect(least <= self.scale <= most, "scale", f"a factor from {least:g} to {most:g}", self.scale)
        expect(self.units in UNITS, "units", f"one of {', '.join(UNITS)}", self.units)
        expect(self.up in ("", *UP_AXES), "up", f"one of {', '.join(UP_AXES)}", self.up)
        for name in ("units", "up", "two_sided"):
            value = getattr(self, name)
            if not self.mesh and value != getattr(type(self), name):
                raise InputError(f"{name}: expected beside a mesh only, found {value!r} beside a spacecraft")


@dataclass(frozen=True)
class MaterialConfig:
    """A material of a scene file: a preset, changed."""

    preset: str  #: name of a material of the table
    albedo: Vector | None = None  #: linear camera RGB, 0 to 1
    roughness: float | None = None  #: GGX alpha; None: as the preset

    def __post_init__(self) -> None:
        albedo = self.albedo or (0.0,)
        expect(min(albedo) >= 0 and max(albedo) <= 1, "albedo", "fractions from 0 to 1", self.albedo)
        expect(self.roughness is None or 0.01 <= self.roughness <= 1, "roughness", "0.01 to 1", self.roughness)


@dataclass(frozen=True)
class QualityConfig:
    """How carefully frames are rendered. Raises InputError for a value out of range."""

    spp: int = 64  #: samples a pixel
    #: of test views, whose noise counts as an error of whatever is evaluated by them, None for four times as many
    test_spp: int | None = None
    max_depth: int = 6  #: longest light path in edges, 2 is direct light alone
    points: int = 20_000  #: surface samples in points.ply

    def __post_init__(self) -> None:
        samples = (1, 1_000_000)
        limits = {"spp": samples, "test_spp": samples, "max_depth": (2, 1000), "points": (1, 10_000_000)}
        for name, (lowest, highest) in limits.items():
            value = getattr(self, name)
            expect(value is None or value >= lowest, name, f"at least {lowest}", value)
            expect(value is None or value <= highest, name, f"at most {highest:,}", value)

    @property
    def resolved_test_spp(self) -> int:
        """Samples a pixel of test views."""
        return self.test_spp or 4 * self.spp


@dataclass(frozen=True)
class SceneConfig:
    """All of a scene."""

    name: str  #: of the scene
    objects: tuple[ObjectConfig, ...]  #: at least one
    seed: int = 0  #: of view lattices, noise and points
    materials: Mapping[str, MaterialConfig] = field(default_factory=dict)  #: by name, beside those of the table
    sun: SunConfig = field(default_factory=SunConfig)  #: its size and brightness
    earth: EarthConfig | None = None  #: lights the scene; none: the Sun alone
    background: BackgroundConfig | None = None  #: drawn behind the objects; none: pictures have alpha
    rig: Rig = field(default_factory=FibonacciRig)  #: where cameras and Suns stand
    camera: CameraConfig = field(default_factory=CameraConfig)  #: that takes the pictures
    quality: QualityConfig = field(default_factory=QualityConfig)  #: samples and points
    #: frames of whose object less than this share is sunlit, and those that show none, are left out; those that stay
    #: are numbered from 0
    min_sunlit: float = 0.0
    folder: Path | None = field(default=None, compare=False)  #: where relative paths of meshes begin

    def __post_init__(self) -> None:
        expect(bool(self.name), "name", "a name", self.name)
        if not self.objects:
            raise InputError("objects: expected at least one object, found none")
        if self.background is not None and self.background.share != 1 and self.background.is_fixed(self.earth):
            raise InputError("background: expected placement behind for a share of the pictures, found a fixed Earth")
        if self.background is not None and self.background.placement == "fixed" and self.earth is None:
            raise InputError("background: expected an [earth] in the scene for placement fixed, found none")
        expect(0 <= self.seed <= MAX_SEED, "seed", f"0 to {MAX_SEED}", self.seed)
        expect(0 <= self.min_sunlit < 1, "min_sunlit", "a share from 0 to below 1", self.min_sunlit)

    def to_json(self) -> JsonDict:
        """Plain JSON values, without the folder: a dataset does not depend on where its scene file lay."""
        values = {**asdict(replace(self, folder=None, rig=FibonacciRig())), "rig": self.rig.to_json()}
        del values["folder"]
        unused = [name for name in ("focal", "principal") if values["camera"][name] is None]
        for name in unused if self.camera.focal is None else [*unused, "fov_deg"]:
            del values["camera"][name]
        rig = {key: value for key, value in values["rig"].items() if value or key not in _UNLESS_ASKED_FOR}
        if self.background is None:
            del values["background"]
        if not self.min_sunlit:
            del values["min_sunlit"]
        return {**values, "rig": {"kind": rig_kind(self.rig), **rig}}


def with_options(scene: SceneConfig, **options: object) -> SceneConfig:
    """`scene` with its name, seed or min_sunlit, or fields of its rig, camera or quality changed by name; None changes
    nothing. `rig` is a rig in place of the scene's own, and `trajectory` the table that such a one follows (`FileRig`).
    `resolution` may be one number, of a square, and `sun` (azimuth, elevation) in degrees, a direction [3], a `Sun`, or
    several of them. `sun` takes the place of the rig's own arrangement, whatever the number of its Suns, and `suns`
    alone that of `sun`. `background` is a `BackgroundConfig`, or words that say what the scene's own draws.

    Raises InputError for a name that this scene's rig does not know, or a value out of range.
    """
    rig_given, path = options.pop("rig", None), options.pop("trajectory", None)
    if path is not None:
        expect(rig_given is None, "trajectory", "none beside a rig", str(path))
        rig_given = FileRig(path=str(Path(str(path)).absolute()))
    if rig_given is not None:
        if not isinstance(rig_given, Rig):
            raise InputError(f"rig: expected a Rig, such as PoseRig, found {str(rig_given)[:60]!r}")
        scene = replace(scene, rig=rig_given)
    changes: dict[str, JsonDict] = {"": {}, "rig": {}, "camera": {}, "quality": {}}
    names_by_part = {
        part: {f.name for f in fields(getattr(scene, part))} if part else {"name", "seed", "background", "min_sunlit"}
        for part in changes
    }
    for name, value in options.items():
        part = next((part for part, names in names_by_part.items() if name in names), None)
        if part is None:
            raise InputError(f"{name}: expected {_options_of(scene, name, names_by_part)}")
        if name == "background" and not isinstance(value, str | BackgroundConfig | None):
            raise InputError(f"background: expected words that say what is drawn, found {value!r:.60}")
        if value is not None:
            value = (value, value) if name == "resolution" and isinstance(value, int) else value
            value = _angles_of(value) if name == "sun" else value
            of_words = name == "background"  # which is a record or the words of one
            changes[part][name] = value if of_words else field_value(type(_part(scene, part)), name, value)
    _choose_lens(changes["camera"])
    rig = changes["rig"]
    if "sun" in rig:
        if "suns" in names_by_part["rig"]:
            rig.setdefault("suns", len(rig["sun"]))
    elif "suns" in rig:
        rig["sun"] = ()
    if isinstance(words := changes[""].get("background"), str):
        changes[""]["background"] = (scene.background or BackgroundConfig()).showing(words)
    parts = {part: replace(getattr(scene, part), **changed) for part, changed in changes.items() if part}
    return replace(scene, **changes[""], **parts)


def _choose_lens(camera: JsonDict) -> None:
    """Of a focal length and an angle of view, the one that changes takes the place of the scene's other one."""
    if "focal" in camera and "fov_deg" in camera:
        raise InputError("focal: expected alone, found fov_deg beside it")
    if "focal" in camera:
        camera["fov_deg"] = FOV_DEG
    elif "fov_deg" in camera:
        camera["focal"] = None


def _part(scene: SceneConfig, name: str) -> object:
    return getattr(scene, name) if name else scene


def _angles_of(suns: Any) -> Any:
    """A Sun, or several, as (azimuth, elevation) each; what is none stays as it is."""
    if isinstance(suns, Sun) or _are_numbers(suns):
        suns = [suns]
    if not isinstance(suns, list | tuple | np.ndarray):
        return suns
    return [sun.angles if isinstance(sun, Sun) else Sun(sun).angles if _are_numbers(sun, 3) else sun for sun in suns]


def _are_numbers(value: Any, count: int | None = None) -> bool:
    """Whether it is a list of numbers, of so many, or of one and more."""
    is_list = isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim == 1)
    if not is_list or not len(value) or count not in (None, len(value)):
        return False
    return all(isinstance(number, Real) for number in value)


def _options_of(scene: SceneConfig, name: str, names_by_part: Mapping[str, Iterable[str]]) -> str:
    """What is expected of an option that `scene` does not know: those of its rig, where another kind knows it."""
    kinds = kinds_with(name)
    names = names_by_part["rig"] if kinds else set().union(*names_by_part.values())
    whose = f"{scene.name}, whose rig is of kind {rig_kind(scene.rig)}"
    others = f" ({' and '.join(kinds)} know{'s' * (len(kinds) == 1)} {name})" if kinds else ""
    hint = "" if kinds else did_you_mean(name, sorted(names))
    return f"one of the options {', '.join(sorted(names))} of {whose}{others}{hint}"
