"""The main job: its stages, their checkpoints and the folder they leave."""

from hybrid_mpc.pipeline.settings import RunSettings

__all__ = ["RunSettings"]
