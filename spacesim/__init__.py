"""Differentiable simulation and reconstruction of spacecraft under the Sun."""

__version__ = "0.1.0"
