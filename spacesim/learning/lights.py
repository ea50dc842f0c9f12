"""Which sources light a picture, as commands and scripts name them: the Sun, the Earth that it lights, or both."""

import logging
from dataclasses import replace
from pathlib import Path
from typing import Literal, Protocol, get_args

import numpy as np

from spacesim.data.earth import Earth
from spacesim.data.errors import InputError
from spacesim.data.geometry import direction_from_angles
from spacesim.data.images.tone import display_values, linear_from_display
from spacesim.data.records import Camera, Dataset, Sun
from spacesim.learning.prediction import MaterialView, Prediction

log = logging.getLogger(__name__)

Light = Literal["all", "sun", "earth"]  #: of both sources, or of one alone
Named = tuple[float, float] | Literal["none"] | None  #: azimuth and elevation, degrees; "none"; or nothing is said


class CanPredict(Protocol):
    """What predicts views: a run of any method, or a scene of them."""

    @property
    def path(self) -> Path | None:
        """The run's folder, or the scene's file."""

    @property
    def relightable(self) -> bool:
        """Whether the Sun's direction changes what is predicted."""

    @property
    def knows_earth(self) -> bool:
        """Whether the light of a Sun's Earth changes what is predicted: it has learned it (`light.earth`)."""

    def predict(
        self, camera: Camera, sun: Sun | None = None, normals: bool = False, exposure: float | None = None
    ) -> Prediction:
        """Render one view. normals: predict these, too;  exposure: EV, of colours that are linear; by default that of
        the training pictures. Raises InputError where the Sun matters and none is given, and for an exposure of colours
        that are sRGB values."""

    def draw_material(self, camera: Camera) -> MaterialView:
        """What one view shows of the materials that can be read out of a model. Raises InputError where none can."""


def named_sources(run: CanPredict, sun: Named, earth: Named, of_frame: Sun | None = None) -> tuple[Sun | None, Light]:
    """(the Sun, with the Earth that it lights, whose light is asked for) of what the options `--sun` and `--earth`
    say, degrees. What they do not name is as the frame has it (`of_frame`); sun="none" asks for the Earth's light under
    the frame's Sun;  earth: see `named_earth`

    Raises InputError where a relightable run gets no Sun, for the Earth's light of a run without, and as `named_earth`.
    """
    light: Light = "earth" if sun == "none" else "all"
    found = of_frame if sun is None or sun == "none" else Sun.from_angles(*sun)
    if found is None and light == "all" and run.relightable:
        raise InputError("sun: expected AZ,EL for a run that can be relit and a camera without a Sun, found none")
    shown = named_earth(run, earth, of_frame.earth if of_frame else None)
    if found is not None:
        found = Sun(found.direction, shown)
    if light == "earth":
        _check_knows_earth(run, "sun")
        if earth == "none":
            raise InputError("sun: expected AZ,EL where the Earth gives no light, found none")
        if found is None or shown is None:
            raise InputError("sun: expected AZ,EL where no frame says which Sun lights which Earth, found none")
    return found, light


def named_earth(run: CanPredict, earth: Named, of_frame: Earth | None = None) -> Earth | None:
    """The Earth in a direction, as large and bright as the frame's, else as `Earth` has it; the frame's where none is
    named. Raises InputError for one that is named for a run that no Sun relights; of one that has not learned its light
    a sentence says so."""
    if earth is None or earth == "none":
        return of_frame if earth is None else None
    if not run.relightable:
        raise InputError(f"earth: expected a run that the Sun relights, found {run.path}")
    if not run.knows_earth:
        log.warning("%s: has not learned the Earth's light (light.earth); it can but hide the Sun", run.path)
    towards = direction_from_angles(*earth)
    return replace(of_frame, direction=towards) if of_frame else Earth(towards)


def check_light(run: CanPredict, sun: Sun | None, light: Light) -> None:
    """Raise InputError for no such `light`, and for that of the Earth where a run has not learned it or `sun` has
    none."""
    if light not in get_args(Light):
        raise InputError(f"light: expected one of {', '.join(get_args(Light))}, found {light!r}")
    if light == "earth":
        _check_knows_earth(run, "light")
        if sun is None or sun.earth is None:
            raise InputError("light: expected a Sun with the Earth that it lights, found none")


def predict_light(
    run: CanPredict,
    camera: Camera,
    sun: Sun | None,
    light: Light,
    normals: bool = False,
    exposure: float | None = None,
) -> Prediction:
    """As `run.predict`, in the light of both sources or of one alone."""
    without = sun
    if sun is not None and sun.earth is not None:
        without = replace(sun, earth=replace(sun.earth, albedo=0.0))  # which hides the Sun as it does
    if light == "sun":
        return run.predict(camera, without, normals, exposure)
    seen = run.predict(camera, sun, normals, exposure)
    return added_light(seen, run.predict(camera, without, exposure=exposure)) if light == "earth" else seen


def sunlit_frames(dataset: Dataset, whole: bool = False) -> list[int]:
    """Which training frames a method that takes the Sun trains on: not those whose Sun the Earth hides; a sentence says
    how many. whole: nor those of whose Sun it hides a part. Raises InputError where none stays."""
    frames, part = dataset.train, ", whole or in part" if whole else ""
    suns = [frame.sun for frame in frames]
    sunlit = [k for k, sun in enumerate(suns) if not (sun and (sun.visible_share < 1 if whole else sun.is_hidden))]
    if not sunlit:
        expected = f"expected a training frame whose Sun the Earth does not hide{part}"
        raise InputError(f"{dataset.root}: {expected}, found none")
    if len(sunlit) < len(frames):
        dark = len(frames) - len(sunlit)
        log.warning("%d of %d training frames are left out: the Earth hides their Sun%s", dark, len(frames), part)
    return sunlit


def added_light(prediction: Prediction, to: Prediction) -> Prediction:
    """The view `prediction` in the light that it has beyond the same view under fewer sources, `to`: sources add up in
    linear light."""
    one, other = (
        linear_from_display(view.rgb, view.tone) if view.linear is None else view.linear for view in (prediction, to)
    )
    more = np.maximum(one - other, 0)
    linear = None if prediction.linear is None else more
    return replace(prediction, rgb=display_values(more, prediction.tone), linear=linear)


def _check_knows_earth(run: CanPredict, name: str) -> None:
    if not run.knows_earth:
        expected = "expected a run that has learned the Earth's light (light.earth)"
        raise InputError(f"{name}: {expected}, found {run.path}, trained without it")
