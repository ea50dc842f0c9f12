"""How gradients move parameters: Adam, where its moments lie, and a step of all Gaussians."""
