"""Shapes compared by few points: whether a program ends as it should, and what it writes, takes no more of them."""

from spacesim.eval.metrics.geometry import GeometryConfig

SAMPLES, VOXELS = 4_000, 48


def compare_coarsely() -> None:
    """From now on these are the defaults, in this process."""
    _, share, _, *rest = GeometryConfig.__init__.__defaults__
    GeometryConfig.__init__.__defaults__ = (SAMPLES, share, VOXELS, *rest)
