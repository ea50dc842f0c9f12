"""From a scene to pictures, on the one thread that draws."""
