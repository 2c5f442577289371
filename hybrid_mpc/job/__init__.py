"""Jobs and the engine that runs them, beside each other on this machine or on a cluster."""
