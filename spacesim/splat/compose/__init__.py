"""Trained runs in one scene: poses, pictures, scene files."""

from spacesim.splat.compose.path import Keyframe, Orbit, PosedScene, Shot, View
from spacesim.splat.compose.pose import Pose
from spacesim.splat.compose.scene import ComposeConfig, ComposedPrediction, Composition, Drawn, Placed
from spacesim.splat.compose.scenefile import load_scene, save_scene

__all__ = [
    "ComposeConfig",
    "ComposedPrediction",
    "Composition",
    "Drawn",
    "Keyframe",
    "Orbit",
    "Placed",
    "Pose",
    "PosedScene",
    "Shot",
    "View",
    "load_scene",
    "save_scene",
]
