"""The stages of the main job, their checkpoints, and what they write."""
