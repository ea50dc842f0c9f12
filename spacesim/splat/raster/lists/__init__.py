"""Which splats each tile of a picture blends, front to back."""
