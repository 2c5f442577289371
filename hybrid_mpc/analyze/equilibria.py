"""Equilibria of a model within a region, and their stability."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.signals import nearest_turn
from hybrid_mpc.model.equilibrium import RESIDUAL, hidden_fixed_point, natural_sizes, residual_of, rest_search
from hybrid_mpc.model.limits import vector
from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
STARTS = 64
SAME = 1e-5
"""Distance, over the region's size, below which two solutions are the same equilibrium. The error of Newton's method is
far smaller: the residual of 1e-10 over the distance of the slowest mode from 1."""


@dataclass(frozen=True)
class Equilibrium:
    """An equilibrium under a held input.

    Args:
        x: State ``(n_x,)``.
        h: Hidden state ``(n_h,)``.
        u: Input ``(n_u,)``.
        residual: Largest change of a state in one step.
        poles: Eigenvalues of the step's Jacobian ``(n_x + n_h,)``, largest first.
        stability: ``"stable"``, ``"unstable"`` or ``"marginal"``. Marginal: an eigenvalue lies on the unit circle, so
            there is a continuum of equilibria, or the linearization does not determine the stability.
        hits: Number of starts that converged to this equilibrium.
    """

    x: Array
    h: Array
    u: Array
    residual: float
    poles: Complex
    stability: str
    hits: int


@dataclass(frozen=True)
class Equilibria:
    """Equilibria that Newton's method found from many starts.

    Args:
        points: The equilibria, sorted by their states.
        starts: Number of starts.
        converged: Number of starts that converged to an equilibrium inside the region.
        unseen: Estimated probability that one more start finds a new equilibrium (Good and Turing): number of
            equilibria with one hit over ``converged``; 1 if nothing was found.
    """

    points: tuple[Equilibrium, ...]
    starts: int
    converged: int
    unseen: float


def equilibria(
    model: HybridModel, u: ArrayLike, region: Sequence[tuple[float, float]], *, starts: int = STARTS
) -> Equilibria:
    """Search equilibria ``(x, h)`` under a held input with ``x`` in a region, by Newton's method from many starts.

    Starts fill the region evenly (a Sobol sequence, the same in every call). Each start has the hidden state that
    settles there. States that are ``periodic`` count modulo a turn. The search cannot prove that there are no other
    equilibria; ``unseen`` estimates their probability.

    Args:
        model: The model.
        u: Held input ``(n_u,)``.
        region: Lower and upper bound of each state, n_x pairs.
        starts: Number of starts; a power of two fills the region best. Default: 64.

    Raises:
        InputError: If a size is wrong or the region is empty.

    Source: I. J. Good, *The population frequencies of species and the estimation of population parameters*,
    Biometrika 40 (1953), for ``unseen``.

    Example:
        >>> from hybrid_mpc.machine.signals import Signal
        >>> import casadi as ca
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("cubic", 0.1, level, (Signal("u", "-"),), level,
        ...     x=x, u=u, x_next=x + 0.1 * (x - x**3), xdot=u, y=x)
        >>> found = equilibria(model, [0.0], [(-2.0, 2.0)])
        >>> [(round(float(p.x[0]), 6) + 0.0, p.stability) for p in found.points]
        [(-1.0, 'stable'), (0.0, 'unstable'), (1.0, 'stable')]
    """
    held = vector(u, model.n_u, "u")
    box = np.asarray(region, dtype=float)
    if box.shape != (model.n_x, 2) or not np.all(np.isfinite(box)) or not np.all(box[:, 0] < box[:, 1]):
        raise InputError(
            f"model {model.name}: region must be {model.n_x} pairs (lower, upper) of finite bounds, got {region}"
            " [HM-ANALYZE-008]"
        )
    if starts < 1:
        raise InputError(f"equilibria: give at least one start, got {starts} [HM-ANALYZE-009]")
    from scipy.stats import qmc  # importing it takes about a second, so only this function imports it

    size = box[:, 1] - box[:, 0]
    search = rest_search(model, np.concatenate([size, natural_sizes(model)[model.n_x :]]))
    n_z, none = model.n_x + model.n_h, np.zeros(model.n_y)
    unit = qmc.Sobol(model.n_x, scramble=False).random_base2(int(np.ceil(np.log2(starts))))[:starts]
    found: list[tuple[Array, float, int]] = []
    converged = 0
    for start in box[:, 0] + (unit + 0.5 / starts) % 1.0 * size:
        # maximum number of periods in which a hidden state settles before a search begins
        v = np.concatenate([start, hidden_fixed_point(model, start, held, limit=100), held])
        end = search.descend(v, none).v
        z, error = _move_by_turns(model, end[:n_z], box), residual_of(search, end)
        x = z[: model.n_x]
        edge = SAME * size
        if not error <= RESIDUAL or np.any(x < box[:, 0] - edge) or np.any(x > box[:, 1] + edge):
            continue
        converged += 1
        for i, (known, before, hits) in enumerate(found):
            if np.all(_apart(model, x - known[: model.n_x]) < edge):
                found[i] = (z, error, hits + 1) if error < before else (known, before, hits + 1)
                break
        else:
            found.append((z, error, 1))
    points = sorted((_point(model, *each, held) for each in found), key=lambda p: p.x.tolist())
    once = sum(p.hits == 1 for p in points)
    return Equilibria(tuple(points), starts, converged, once / converged if converged else 1.0)


def poles_of(a: Array) -> Complex:
    """Eigenvalues of a one-step map, largest magnitude first."""
    poles = np.linalg.eigvals(a).astype(np.complex128)
    return poles[np.argsort(-np.abs(poles), kind="stable")]


def _point(model: HybridModel, z: Array, error: float, hits: int, u: Array) -> Equilibrium:
    x, h = z[: model.n_x], z[model.n_x :]
    assert model.with_jacobian is not None
    poles = poles_of(model.with_jacobian(x, h, u, model.w, model.p)[2].full())
    over = float(np.abs(poles[0])) - 1.0
    # distance of an eigenvalue from the unit circle that is within rounding errors
    stability = "marginal" if abs(over) <= 1e-7 else "stable" if over < 0 else "unstable"
    return Equilibrium(x, h, u, error, poles, stability, hits)


def _move_by_turns(model: HybridModel, z: Array, box: Array) -> Array:
    """Move periodic states by whole turns into the region, if possible."""
    turned = z.copy()
    for i, signal in enumerate(model.states):
        if signal.periodic and np.isfinite(z[i]):
            turned[i] = box[i, 0] + (z[i] - box[i, 0]) % signal.period
    return turned


def _apart(model: HybridModel, difference: Array) -> Array:
    """Absolute difference of states ``(n_x,)``; periodic states modulo a turn."""
    turn = np.array([s.period for s in model.states])
    return np.abs(nearest_turn(difference, np.zeros(model.n_x), turn))
