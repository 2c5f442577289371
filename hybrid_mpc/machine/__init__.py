"""The description of a machine: signals, the prior, friction, and the meaning of its recordings."""
