"""Jobs: closed loops from a specification to a row, and the engine that runs them."""
