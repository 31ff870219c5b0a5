"""The terms of N: covariances of the instrument's contributions to the visibilities."""
