"""Training checkpoints: one safetensors file, written atomically, bound to its training."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from hybrid_mpc.errors import InputError


def save_checkpoint(path: Path, key: str, tensors: dict[str, Tensor], numbers: dict[str, Any]) -> None:
    """Write tensors and numbers to ``path``; a kill at any moment leaves the old file or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    own = {name: tensor.detach().clone().contiguous() for name, tensor in tensors.items()}
    save_file(own, part, metadata={"key": key, "numbers": json.dumps(numbers)})
    os.replace(part, path)


def load_checkpoint(path: Path, key: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and numbers of a checkpoint.

    Raises:
        InputError: If the file is damaged or belongs to a training with other settings or data.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise InputError(f"checkpoint {path} cannot be read ({error}); delete it to train anew") from error
    if metadata.get("key") != key:
        raise InputError(
            f"checkpoint {path} belongs to a training with other settings or data; "
            f"resume with the same ones or choose another output folder"
        )
    return tensors, json.loads(metadata["numbers"])
