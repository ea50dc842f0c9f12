"""The slow twins of the kernels, in float64 numpy, sharing no code with them: what tests compare with."""
