"""The truth beside the models: stored, or path-traced in a process of its own."""
