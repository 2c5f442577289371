"""All equilibria of a region, and their stability."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.equilibrium import (
    RESIDUAL,
    hidden_fixed_point,
    natural_sizes,
    residual_of,
    rest_search,
)
from hybrid_mpc.model.limits import vector
from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
STARTS = 64
SETTLES = 100
"""Periods in which a hidden state settles at most before a search begins."""
SAME = 1e-5
"""Distance, over the region's size, below which two solutions are one: Newton's own error is the residual of 1e-10
over the slowest mode's distance from 1, far below it."""
MARGINAL = 1e-7
"""Eigenvalues closer to the unit circle than this are on it as far as rounding can tell."""


@dataclass(frozen=True)
class Equilibrium:
    """A point of rest: its residual is the largest change in one step, its poles are those of the step, largest first.

    ``stability`` is ``"stable"``, ``"unstable"`` or ``"marginal"`` (an eigenvalue on the unit circle: a continuum of
    points of rest, or a stability that no linearization tells). ``hits`` counts the starts that ended here.
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
    """What Newton's method found from many starts: points in order of their states.

    ``converged`` starts ended at a point of rest inside the region. ``unseen`` is the estimated probability that a
    further one finds a new point: the share of points that were hit only once (Good and Turing); 1 where nothing was
    found.
    """

    points: tuple[Equilibrium, ...]
    starts: int
    converged: int
    unseen: float


def equilibria(
    model: HybridModel,
    u: ArrayLike,
    region: Sequence[tuple[float, float]],
    *,
    starts: int = STARTS,
) -> Equilibria:
    """Points of rest ``(x, h)`` under a held input with ``x`` in a region, by Newton's method from many starts.

    Starts fill the region evenly (a Sobol sequence, the same in every call), each with the hidden state that settles
    there. Points of signals that are ``periodic`` count modulo a turn. No such search can prove that there are no
    others; ``unseen`` says how likely one is to turn up.

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
    from scipy.stats import qmc  # a second of start-up that few need

    size = box[:, 1] - box[:, 0]
    search = rest_search(model, np.concatenate([size, natural_sizes(model)[model.n_x :]]))
    n_z, none = model.n_x + model.n_h, np.zeros(model.n_y)
    unit = qmc.Sobol(model.n_x, scramble=False).random_base2(int(np.ceil(np.log2(starts))))[:starts]
    found: list[tuple[Array, float, int]] = []
    converged = 0
    for start in box[:, 0] + (unit + 0.5 / starts) % 1.0 * size:
        v = np.concatenate([start, hidden_fixed_point(model, start, held, limit=SETTLES), held])
        end = search.descend(v, none).v
        z, error = _turned(model, end[:n_z], box), residual_of(search, end)
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
    stability = "marginal" if abs(over) <= MARGINAL else "stable" if over < 0 else "unstable"
    return Equilibrium(x, h, u, error, poles, stability, hits)


def _turned(model: HybridModel, z: Array, box: Array) -> Array:
    """Periodic states moved by whole turns into the region, where they can be."""
    turned = z.copy()
    for i, signal in enumerate(model.states):
        if signal.periodic and np.isfinite(z[i]):
            turned[i] = box[i, 0] + (z[i] - box[i, 0]) % (2 * np.pi)
    return turned


def _apart(model: HybridModel, difference: Array) -> Array:
    turns = np.array([s.periodic for s in model.states])
    around = np.abs((difference + np.pi) % (2 * np.pi) - np.pi)
    return np.where(turns, around, np.abs(difference))
