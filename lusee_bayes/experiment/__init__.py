"""A scenario in YAML, turned into A, S, N and data."""
