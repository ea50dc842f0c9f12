"""Differentiable simulation and reconstruction of spacecraft under the Sun."""

from spacesim.backend import name_llvm

__version__ = "0.1.0"

name_llvm()
