"""What the Sun sees: light cameras and the raw occlusion of every Gaussian (thesis 4.3)."""
