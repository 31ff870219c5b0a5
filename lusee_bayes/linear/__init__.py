"""p(m | d) in closed form: the linear Gaussian model and its posterior."""
