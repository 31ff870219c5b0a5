"""The posterior of a positive sky: its mode, coordinates in which it is round, draws, evidence."""
