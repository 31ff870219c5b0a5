"""Results of runs, as objects and as files."""
