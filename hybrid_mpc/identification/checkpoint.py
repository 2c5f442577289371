"""Training checkpoints: one safetensors file, written atomically, bound to its training."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import MOST_ARRAYS, read_bytes, replacing


def save_checkpoint(path: Path, key: str, tensors: dict[str, Tensor], numbers: dict[str, Any]) -> None:
    """Write tensors and numbers to ``path``; a kill at any moment leaves the old file or the new one."""
    own = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in tensors.items()}
    text = json.dumps(numbers)
    metadata = {"key": key, "numbers": text, "sha256": _content_hash(own, text)}
    with replacing(path) as file:
        file.write(save(own, metadata=metadata))


def load_checkpoint(path: Path, key: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and numbers of a checkpoint.

    Raises:
        InputError: If the file is damaged or belongs to a training with other settings or data.
    """
    read_bytes(path, MOST_ARRAYS)  # a regular file of a size that can be
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise InputError(f"checkpoint {path} cannot be read ({error}); delete it to train anew") from error
    numbers = metadata.get("numbers", "")
    if metadata.get("sha256") != _content_hash(tensors, numbers):
        raise InputError(f"checkpoint {path} is damaged; delete it to train anew")
    if metadata.get("key") != key:
        raise InputError(
            f"checkpoint {path} belongs to a training with other settings or data; "
            f"resume with the same ones or choose another output folder"
        )
    return tensors, json.loads(numbers)


def _content_hash(tensors: dict[str, Tensor], numbers: str) -> str:
    """SHA-256 of what a training goes on with."""
    whole = hashlib.sha256(numbers.encode())
    for name in sorted(tensors):
        array = tensors[name].numpy()
        whole.update(f"{name} {array.dtype} {array.shape}".encode())
        whole.update(array.tobytes())
    return whole.hexdigest()
