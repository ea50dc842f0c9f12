"""The rasterizer: Gaussians and a camera to pictures and back (thesis 2.2). It knows nothing of training."""
