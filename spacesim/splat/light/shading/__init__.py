"""How light becomes colour: the kernels of `spacesim.splat.light.model`, forward and backward.

Each kernel is recorded once for all Gaussians in columns of few sizes (`PaddedBatch`).
"""
