"""Spacecraft under the Sun, path-traced with all their truth: `generate` writes a dataset."""

from spacesim.scenes.generate import GenerateConfig, generate
from spacesim.scenes.render import Renderer
from spacesim.scenes.scene import BUILT_IN_SCENES, Scene, SceneObject, built_in_scene
from spacesim.scenes.spacecraft import Part, Spacecraft, boxsat

__all__ = [
    "BUILT_IN_SCENES",
    "GenerateConfig",
    "Part",
    "Renderer",
    "Scene",
    "SceneObject",
    "Spacecraft",
    "boxsat",
    "built_in_scene",
    "generate",
]
