"""Rays, where they are sampled, and what samples add up to."""
