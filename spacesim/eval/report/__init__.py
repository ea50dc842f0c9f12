"""Evaluations side by side, as one page."""
