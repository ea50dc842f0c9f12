"""Small fully connected networks over many items at once: by Dr.Jit, fused on a CPU, on tensor cores."""
