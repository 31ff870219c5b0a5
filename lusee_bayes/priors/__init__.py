"""S with unknown parameters: families of priors, and how they are learned from data."""
