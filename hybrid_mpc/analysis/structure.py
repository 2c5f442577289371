"""Mode by mode: frequency, damping, how well inputs reach it and outputs show it; Hankel singular values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.analysis.properties import RANK_TOLERANCE
from hybrid_mpc.analysis.reduction import hankel_singular_values
from hybrid_mpc.analysis.toolbox import period

Array = NDArray[np.float64]


class Mode(NamedTuple):
    """One mode of a discrete system.

    Fields: ``pole``; ``frequency`` [rad/s] and ``damping`` of the continuous equivalent (infinite and 1 for a pole at
    zero); ``reach``, distance from being uncontrollable, and ``see``, from being unobservable: smallest singular value
    of the Popov-Belevitch-Hautus pencil over its largest, input and output units divided out.
    """

    pole: complex
    frequency: float
    damping: float
    reach: float
    see: float


@dataclass(frozen=True)
class Structure:
    """Modes and input-output weight of a discrete system.

    Args:
        dt: Period [s].
        modes: Largest pole first.
        hankel: Hankel singular values ``(n,)`` of the stable part, largest first, inputs and outputs as they are
            given; infinite for each mode on or outside the unit circle.
        stabilisable: Every mode on or outside the unit circle is reached.
        detectable: Every such mode is seen.
    """

    dt: float
    modes: tuple[Mode, ...]
    hankel: Array
    stabilisable: bool
    detectable: bool

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON; complex as ``[re, im]``."""
        return {
            "dt": self.dt,
            "modes": [
                {**m._asdict(), "pole": [float(np.real(m.pole)), float(np.imag(m.pole))]} for m in self.modes
            ],
            "hankel": self.hankel.tolist(),
            "stabilisable": self.stabilisable,
            "detectable": self.detectable,
        }


def system_structure(sys: Any) -> Structure:
    """Modes of a discrete ``control.StateSpace`` with what PBH tests and Hankel singular values say of them.

    PBH asks whether a mode can be moved (seen) at all; a Hankel singular value how much of the way from past inputs
    to future outputs goes through a state. A hidden state of a network has mostly modes that pass the first and
    weigh nothing in the second.

    Args:
        sys: The system, with a period.

    Raises:
        InputError: If the system has no period.

    Example:
        >>> import control
        >>> found = system_structure(control.ss(np.diag([1.2, 0.5]), [[0.0], [1.0]], [[1.0, 1.0]], 0.0, 0.1,
        ...     remove_useless_states=False))
        >>> [round(m.reach, 3) for m in found.modes], found.stabilisable, found.detectable
        ([0.0, 0.538], False, True)
    """
    dt = period(sys)
    a, b, c = (np.asarray(m, dtype=float) for m in (sys.A, sys.B, sys.C))
    poles = np.linalg.eigvals(a).astype(np.complex128)
    poles = poles[np.argsort(-np.abs(poles), kind="stable")]
    modes = tuple(Mode(complex(z), *_shape(z, dt), _hautus(a, b, z), _hautus(a.T, c.T, z)) for z in poles)
    risky = [m for m in modes if abs(m.pole) >= 1.0 - RANK_TOLERANCE]
    return Structure(
        dt,
        modes,
        hankel_singular_values(sys),
        all(m.reach > RANK_TOLERANCE for m in risky),
        all(m.see > RANK_TOLERANCE for m in risky),
    )


def _shape(z: complex, dt: float) -> tuple[float, float]:
    """Natural frequency [rad/s] and damping of the continuous equivalent."""
    if z == 0:
        return float("inf"), 1.0
    s = complex(np.log(z)) / dt
    return abs(s), 1.0 if s == 0 else -s.real / abs(s)


def _hautus(a: Array, b: Array, z: complex) -> float:
    size = max(float(np.linalg.norm(a, 2)), 1.0)
    norms = np.linalg.norm(b, axis=0)
    scaled = b * np.where(norms > 0, size / np.where(norms > 0, norms, 1.0), 0.0)
    pencil = np.hstack([a - z * np.eye(len(a)), scaled])
    smallest = float(np.linalg.svd(pencil, compute_uv=False)[-1])
    return smallest / float(np.linalg.norm(np.hstack([a, scaled]), 2))
