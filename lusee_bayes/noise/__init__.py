"""The terms of N: covariances of what the instrument adds to the visibilities of the sky."""
