"""The interactive viewer: runs and composed scenes in the browser, drawn by our own rasterizer (thesis 3.3)."""
