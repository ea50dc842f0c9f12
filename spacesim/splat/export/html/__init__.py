"""A run as one page that any browser opens from disk: orbit, and a Sun to drag."""
