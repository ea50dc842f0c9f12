"""SSIM's window and constants (Wang et al. 2004, data range 1)."""

import numpy as np

RADIUS = 5  #: 11 x 11 window
SIGMA = 1.5  #: pixels
C1, C2 = 0.01**2, 0.03**2
_OFFSETS = np.arange(-RADIUS, RADIUS + 1)
_WEIGHTS = np.exp(-0.5 * (_OFFSETS / SIGMA) ** 2)
WINDOW: list[float] = (_WEIGHTS / _WEIGHTS.sum()).tolist()
