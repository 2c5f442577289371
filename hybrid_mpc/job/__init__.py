"""Jobs: the main job and its stages, closed loops compared, studies, and the engine that runs them."""
