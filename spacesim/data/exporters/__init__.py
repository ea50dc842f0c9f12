"""Datasets in the forms that pose estimation reads: SPEED+ and BOP."""

from spacesim.data.exporters.bop import Silhouette, write_bop
from spacesim.data.exporters.objects import Target, targets_of
from spacesim.data.exporters.speedplus import write_speedplus

__all__ = ["Silhouette", "Target", "targets_of", "write_bop", "write_speedplus"]
