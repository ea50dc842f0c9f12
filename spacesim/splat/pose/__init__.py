"""Where a camera stood: a pose refined from a picture and a trained model."""

from spacesim.splat.pose.motion import moved, twist_between
from spacesim.splat.pose.picture import checked_picture
from spacesim.splat.pose.refine import RefinedPose, refine_pose

__all__ = ["RefinedPose", "checked_picture", "moved", "refine_pose", "twist_between"]
