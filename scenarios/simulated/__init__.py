"""Six simulated machines of different kinds: each plant differs from its prior in parameters and by one effect."""
