"""The metrics: of pictures, of shadows, of shape."""
