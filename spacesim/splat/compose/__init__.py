"""Trained runs in one scene: poses, pictures, scene files."""

from spacesim.splat.compose.path import CameraView, Keyframe, Orbit
from spacesim.splat.compose.pose import Pose
from spacesim.splat.compose.posed_scene import PosedScene, SceneFrame
from spacesim.splat.compose.run import ComposedRun
from spacesim.splat.compose.scene import ComposeConfig, ComposedPrediction, DrawnView, GaussianComposition, PlacedRun
from spacesim.splat.compose.scenefile import load_scene, save_scene

__all__ = [
    "CameraView",
    "ComposeConfig",
    "ComposedPrediction",
    "ComposedRun",
    "DrawnView",
    "GaussianComposition",
    "Keyframe",
    "Orbit",
    "PlacedRun",
    "Pose",
    "PosedScene",
    "SceneFrame",
    "load_scene",
    "save_scene",
]
