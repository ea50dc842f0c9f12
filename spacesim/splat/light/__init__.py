"""Light: a Sun in, colours and visibility of the Gaussians out (thesis 4.1 to 4.3)."""
