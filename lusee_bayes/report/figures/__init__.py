"""Figures: each function takes a result and returns a matplotlib Figure."""
