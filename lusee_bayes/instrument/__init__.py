"""A and d: beams, observation, pointing, coupling matrix, visibilities."""
