"""p(m | d) by Hamiltonian Monte Carlo, and what it takes to trust the draws."""
