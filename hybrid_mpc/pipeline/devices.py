"""Where networks can be trained."""

from __future__ import annotations

from hybrid_mpc.errors import InputError


def check_device(device: str) -> None:
    """Refuse a device that this machine does not have, before a long job starts.

    Args:
        device: ``"cpu"``, or a name of torch's such as ``"cuda"`` or ``"cuda:1"``.

    Raises:
        InputError: If torch does not know the name, or cannot compute with 64-bit floats there.

    Example:
        >>> check_device("cpu")
        >>> check_device("toaster")
        Traceback (most recent call last):
        ...
        hybrid_mpc.errors.InputError: --device toaster: ...
    """
    if device == "cpu":
        return
    import torch

    try:
        torch.ones(1, dtype=torch.float64, device=device).sum().item()
    except (
        RuntimeError,
        AssertionError,
        NotImplementedError,
        TypeError,
        ImportError,
    ) as error:  # torch raises any of them
        reason = str(error).strip().splitlines()[0]
        raise InputError(
            f"--device {device}: torch cannot compute there ({reason}); leave it out to use cpu"
        ) from error
