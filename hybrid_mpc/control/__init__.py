"""Model predictive control: the problem, its solvers behind one interface, the safeguard."""
