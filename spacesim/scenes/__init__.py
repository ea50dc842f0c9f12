"""Spacecraft under the Sun, path-traced with all their truth: `generation.generate` writes a dataset."""
