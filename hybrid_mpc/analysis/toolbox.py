"""python-control, imported only where it is used, and the names of a model's signals in its manner."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hybrid_mpc.errors import InputError
from hybrid_mpc.model import HybridModel


def control_toolbox() -> Any:
    """The module ``control``.

    Raises:
        InputError: If python-control is not installed.

    Example:
        >>> control_toolbox().__name__
        'control'
    """
    try:
        import control
    except ImportError as missing:
        raise InputError(
            f"linear analysis needs python-control ({missing}); install it with: pip install 'hybrid-mpc[analysis]'"
        ) from None
    return control


def signal_names(model: HybridModel) -> dict[str, Any]:
    """Names of system, states, inputs and outputs as keyword arguments of ``control.ss``."""
    return {
        "name": model.name,
        "states": [s.name for s in model.states] + [f"h{i}" for i in range(model.n_h)],
        "inputs": [s.name for s in model.inputs],
        "outputs": distinct([s.name for s in model.outputs]),
    }


def distinct(names: Sequence[str]) -> list[str]:
    """Names that occur several times, numbered.

    Example:
        >>> distinct(["phi", "phi", "u"])
        ['phi_0', 'phi_1', 'u']
    """
    return [n if names.count(n) == 1 else f"{n}_{i}" for i, n in enumerate(names)]


def period(sys: Any) -> float:
    """Period [s] of a discrete system.

    Raises:
        InputError: If it is continuous or has no period.
    """
    dt = sys.dt
    if dt is None or dt is True or not dt > 0:
        raise InputError(f"linear analysis: needs a discrete system with a period, its dt is {dt}")
    return float(dt)
