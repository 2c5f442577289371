"""Jobs: closed loops from a specification to a row, the folder that a job works in, and the engine that runs it."""
