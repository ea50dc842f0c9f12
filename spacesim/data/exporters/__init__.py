"""Datasets in the forms that pose estimation reads: SPEED+ and BOP."""

from spacesim.data.exporters.bop import Silhouette, write_bop
from spacesim.data.exporters.objects import LabelledObject, labelled_objects
from spacesim.data.exporters.speedplus import write_speedplus

__all__ = ["LabelledObject", "Silhouette", "labelled_objects", "write_bop", "write_speedplus"]
