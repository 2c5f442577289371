"""What a machine is written with: signals, the prior, friction, and what its recordings mean."""
