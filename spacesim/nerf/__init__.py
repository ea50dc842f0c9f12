"""Radiance fields (thesis 2.1 and 3.1): rays, samples, fields, volume rendering, training, several on one ray."""
