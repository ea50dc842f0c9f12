"""Where a camera stood: a pose refined from a picture and a trained model, or found without a guess."""

from spacesim.splat.pose.motion import moved, twist_between
from spacesim.splat.pose.picture import checked_picture
from spacesim.splat.pose.refine import RefinedPose, refine_pose
from spacesim.splat.pose.search import FoundPose, find_pose

__all__ = ["FoundPose", "RefinedPose", "checked_picture", "find_pose", "moved", "refine_pose", "twist_between"]
