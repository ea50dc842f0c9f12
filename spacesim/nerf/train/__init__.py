"""Training: pixels, a step, the loop, a run on disk."""
