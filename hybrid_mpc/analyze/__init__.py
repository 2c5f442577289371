"""Analysis of a model with the instruments of control engineering (python-control), on exact Jacobians."""
