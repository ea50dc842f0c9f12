"""Gaussian splatting in Dr.Jit: rasterizer, training, trained runs."""
