"""Pictures on disk and as numbers: PNG and EXR in and out, sRGB, lenses, and what a frame shows."""

from spacesim.data.images.color import linear_from_srgb, luminance, srgb_from_linear
from spacesim.data.images.exr import exr_bytes, exr_size, read_exr, walk_exr_header, write_exr
from spacesim.data.images.lens import BLIND, Resampling, Undistortion, check_lens, distort_points, undistort_points
from spacesim.data.images.load import check_size_of, load_image, read_labels, read_sized, resample, undistort
from spacesim.data.images.png import has_alpha, image_size, png_bytes, read_png, size_and_alpha, write_png

__all__ = [
    "BLIND",
    "Resampling",
    "Undistortion",
    "check_lens",
    "check_size_of",
    "distort_points",
    "exr_bytes",
    "exr_size",
    "has_alpha",
    "image_size",
    "linear_from_srgb",
    "load_image",
    "luminance",
    "png_bytes",
    "read_exr",
    "read_labels",
    "read_png",
    "read_sized",
    "resample",
    "size_and_alpha",
    "srgb_from_linear",
    "undistort",
    "undistort_points",
    "walk_exr_header",
    "write_exr",
    "write_png",
]
