"""Gaussians and radiance fields in one scene."""
