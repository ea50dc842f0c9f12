"""Density and colour at points: grids, networks, the fields of a model."""
