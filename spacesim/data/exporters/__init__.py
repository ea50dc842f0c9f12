"""Datasets in the forms that pose estimation reads: SPEED+, BOP, COCO, YOLO, WebDataset."""

from spacesim.data.exporters.bop import Silhouette, write_bop
from spacesim.data.exporters.coco import write_coco
from spacesim.data.exporters.objects import LabelledObject, labelled_objects
from spacesim.data.exporters.speedplus import write_speedplus
from spacesim.data.exporters.webdataset import write_webdataset
from spacesim.data.exporters.yolo import write_yolo

__all__ = [
    "LabelledObject",
    "Silhouette",
    "labelled_objects",
    "write_bop",
    "write_coco",
    "write_speedplus",
    "write_webdataset",
    "write_yolo",
]
