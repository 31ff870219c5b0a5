"""Unknowns of instrument and sky, each marginalised into N or sampled."""
