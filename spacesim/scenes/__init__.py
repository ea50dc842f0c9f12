"""Spacecraft under the Sun, path-traced with all their truth: `generate` writes a dataset."""

from spacesim.scenes.build import build
from spacesim.scenes.config import SceneConfig, with_options
from spacesim.scenes.generation.generate import generate
from spacesim.scenes.render import Renderer
from spacesim.scenes.scene import Scene, SceneObject
from spacesim.scenes.scenefile import BUILT_IN_SCENES, read_scene
from spacesim.scenes.spacecraft import Part, Spacecraft, boxsat

__all__ = [
    "BUILT_IN_SCENES",
    "Part",
    "Renderer",
    "Scene",
    "SceneConfig",
    "SceneObject",
    "Spacecraft",
    "boxsat",
    "build",
    "generate",
    "read_scene",
    "with_options",
]
