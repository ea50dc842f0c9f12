"""Trained runs in one scene: poses, pictures, scene files."""

from spacesim.splat.compose.pose import Pose
from spacesim.splat.compose.scene import ComposeConfig, ComposedPrediction, Composition, Drawn, Placed

__all__ = ["ComposeConfig", "ComposedPrediction", "Composition", "Drawn", "Placed", "Pose"]
