"""p(m | d) by Hamiltonian Monte Carlo, and validation of the draws."""
