"""A run in the world of another dataset: one that was trained in axes and a scale of its own."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from spacesim.data.files import JsonDict
from spacesim.data.geometry import Array
from spacesim.data.records import Camera, Frame, Sun
from spacesim.splat.compose.members import Ensemble, Member
from spacesim.splat.compose.pose import Pose
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.run import MaterialView, Prediction, Run


@dataclass(frozen=True, eq=False)
class AlignedRun:
    """A run whose model is turned, moved and scaled; see `Predictor`."""

    run: Run  #: in the axes and the scale of its training
    pose: Pose  #: of the model in the world

    @property
    def path(self) -> Path:
        """The run's folder."""
        return self.run.path

    @property
    def config(self) -> JsonDict:
        """How it was trained."""
        return self.run.config

    @property
    def training(self) -> JsonDict:
        """How training went."""
        return self.run.training

    @cached_property
    def gaussians(self) -> Gaussians:
        """Its Gaussians in the world, colours left out."""
        member = Member.of(self.run)
        return Ensemble([member] if member.count else []).placed([self.pose])

    @property
    def gaussian_count(self) -> int:
        """Number of Gaussians."""
        return self.run.gaussian_count

    @property
    def model_bytes(self) -> int:
        """Size of the model's file."""
        return self.run.model_bytes

    @property
    def backend(self) -> str:
        """The backend that renders now."""
        return self.run.backend

    @property
    def antialiased(self) -> bool:
        """Whether Gaussians are drawn with the anti-aliasing filter."""
        return self.run.antialiased

    @property
    def relightable(self) -> bool:
        """Whether the Sun's direction changes what is predicted."""
        return self.run.relightable

    @property
    def knows_earth(self) -> bool:
        """Whether the light of a Sun's Earth changes what is predicted."""
        return self.run.knows_earth

    @property
    def has_shadows(self) -> bool:
        """Whether its method knows visibility."""
        return self.run.has_shadows

    @property
    def parts(self) -> tuple[()]:
        """None: it was trained as one."""
        return ()

    @property
    def gaussian_run(self) -> Run:
        """In axes and a scale of its own."""
        return self.run

    def with_embedding(self, embedding: np.ndarray) -> "AlignedRun":
        """See `Run.with_embedding`."""
        return replace(self, run=self.run.with_embedding(embedding))

    def predict(
        self, camera: Camera, sun: Sun | None = None, normals: bool = False, exposure: float | None = None
    ) -> Prediction:
        """As `Run.predict`, of a camera and a Sun in the world."""
        near = self.pose.camera_in_model(camera)
        towards = None if sun is None else _turned(sun, self.pose.direction_in_model)
        drawn = self.run.predict(near, towards, normals, exposure)
        normal = None if drawn.normal is None else drawn.normal @ self.pose.rotation.T.astype(np.float32)
        return replace(drawn, depth=drawn.depth * np.float32(self.pose.scale), normal=normal)

    def draw_material(self, camera: Camera) -> MaterialView:
        """As `Run.draw_material`, of a camera in the world."""
        drawn = self.run.draw_material(self.pose.camera_in_model(camera))
        return replace(drawn, normal=drawn.normal @ self.pose.rotation.T.astype(np.float32))


def moved_frame(frame: Frame, pose: Pose) -> Frame:
    """A frame of a model's own dataset in the world: its camera and its Sun."""
    place = np.eye(4)
    place[:3, :3] = pose.rotation @ frame.camera.world_from_camera[:3, :3]
    place[:3, 3] = pose.points(frame.camera.position)
    sun = None if frame.sun is None else _turned(frame.sun, lambda direction: pose.rotation @ direction)
    return replace(frame, camera=replace(frame.camera, world_from_camera=place), sun=sun)


def _turned(sun: Sun, turn: Callable[[Array], Array]) -> Sun:
    """The Sun, and the Earth where it lights one. turn: directions [3] to others"""
    earth = None if sun.earth is None else replace(sun.earth, direction=turn(sun.earth.direction))
    return Sun(turn(sun.direction), earth)
