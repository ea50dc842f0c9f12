"""A process that path-traces the truth: the viewer's own draws meanwhile (Dr.Jit is not shared between threads).

It is started with a socket (see `truth`), gets `TraceRequest`s, and answers each with a `TraceResult` after
every few samples a pixel; a newer request, or None, ends the one before. Where the viewer has gone, it ends.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from spacesim.data.images.tone import display_values
from spacesim.data.records import Camera, Sun
from spacesim.processes import connect_to_parent
from spacesim.scenes.config import CameraConfig, SceneConfig
from spacesim.scenes.generation.workers import select_backend
from spacesim.viewer.drawing.paint import Planes

if TYPE_CHECKING:
    from spacesim.scenes.render import Renderer

OF_COLOUR = "colour", "ellipsoids", "accumulation"  #: modes that ask for paths, the others for labels
PASS = 4  #: samples a pixel between two answers
NICENESS = 10  #: less urgent than the viewer's own pictures


@dataclass(frozen=True, eq=False)
class TraceRequest:
    """What to trace."""

    number: int  #: given back with answers
    scene: SceneConfig  #: what is traced
    camera: Camera  #: pose and intrinsics
    sun: Sun  #: that lights it; the Earth that it names hides it where the scene has none
    samples: int  #: a pixel
    mode: str  #: whose planes
    models: Sequence[int] = ()  #: see `model_ids`
    exposure: float = 0.0  #: EV more than the scene's


@dataclass(frozen=True, eq=False)
class TraceResult:
    """A path-traced picture, or why there is none."""

    number: int  #: of the request
    planes: Planes | None  #: of all samples so far, None where `error` says in a sentence why there are none
    samples: int  #: a pixel, so far
    done: bool  #: nothing more comes
    error: str = ""  #: a sentence, "" where there is none


class Tracer:
    """Answers requests; keeps the scene last asked for."""

    def __init__(self) -> None:
        self._scene: SceneConfig | None = None
        self._renderer: Renderer | None = None

    def answers(self, request: TraceRequest) -> Iterator[TraceResult]:
        """One answer after another, each of more samples than the one before."""
        renderer = self._loaded(request.scene)
        camera, sun, config = request.camera, request.sun, request.scene.camera
        left = sun.visible_share if request.scene.earth is None else 1.0  # a scene's own Earth is traced
        if request.mode not in OF_COLOUR:
            labels = renderer.labels(camera, sun)
            labels["sun_visibility"] = np.float32(left) * labels["sun_visibility"]
            yield TraceResult(request.number, _label_planes(labels, request.models), 1, True)
            return
        total, weight, done = np.zeros(()), np.zeros(()), 0
        while done < request.samples:
            radiance, alpha = renderer.radiance(camera, sun, (request.scene.seed, done))
            total, weight, done = total + radiance.astype(np.float64), weight + alpha.astype(np.float64), done + PASS
            share = PASS / done
            planes = _picture(2.0**request.exposure * left * total * share, weight * share, config)
            yield TraceResult(request.number, planes, done, done >= request.samples)

    def _loaded(self, scene: SceneConfig) -> "Renderer":
        if self._renderer is None or scene != self._scene:
            from spacesim.scenes.build import build
            from spacesim.scenes.render import Renderer

            self._renderer = None
            self._renderer = Renderer(build(scene), PASS, scene.quality.max_depth)
            self._scene = scene
        return self._renderer


def _picture(radiance: np.ndarray, alpha: np.ndarray, config: CameraConfig) -> Planes:
    """As the data's pictures are, over black, without a sensor's noise."""
    if config.sensor is not None:  # which records what is over black
        rgb = display_values(config.exposure * radiance, config.tone)
    else:
        straight = radiance / np.where(alpha > 0, alpha, 1)[..., None]
        rgb = display_values(config.exposure * straight, config.tone) * alpha[..., None]
    return Planes(alpha.astype(np.float32), rgb=rgb.astype(np.float32))


def model_ids(objects: np.ndarray, models: Sequence[int]) -> np.ndarray:
    """Numbers of objects [H, W] as those of the models that they are part of. models: of each object the number of its
    model, from 1; nothing where they are the same"""
    return np.array([0, *models], objects.dtype).take(objects, mode="clip") if models else objects


def _label_planes(labels: dict[str, np.ndarray], models: Sequence[int]) -> Planes:
    surface = (labels["object_id"] > 0).astype(np.float32)
    return Planes(
        surface,
        depth=labels["depth"],
        visibility=labels["sun_visibility"],
        normal=labels["normal"],
        albedo=labels["albedo"],
        object_id=model_ids(labels["object_id"], models),
    )


def main(socket: int) -> None:
    """Answer requests that come through a socket, for ever."""
    inbox, tell = connect_to_parent(socket)
    name, threads = inbox.get()
    with suppress(OSError, AttributeError):
        os.nice(NICENESS)
    tracer, ready = None, None
    while True:
        request = ready or inbox.get()
        while not inbox.empty():  # the newest counts
            request = inbox.get()
        ready = None
        if request is None:
            continue
        try:
            if tracer is None:
                select_backend(name, threads)
                tracer = Tracer()
            for answer in tracer.answers(request):
                tell(answer)
                if not inbox.empty():
                    break
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            tell(TraceResult(request.number, None, 0, True, reason))
