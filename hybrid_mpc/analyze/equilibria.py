"""Equilibria: one near a guess, all of a region and their stability, and the input that holds a position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.stats import qmc

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.model import HybridModel, positions_of
from hybrid_mpc.model.riccati import hidden_fixed_point, vector

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
RUN = 5000
"""Periods of a run that leads to a rest where Newton's method does not."""
RESIDUAL = 1e-10
ITERATIONS = 50
STARTS = 64
SAME = 1e-5
"""Distance, over the region's size, below which two solutions are one: Newton's own error is the residual of 1e-10
over the slowest mode's distance from 1, far below it."""
MARGINAL = 1e-7
"""Eigenvalues closer to the unit circle than this are on it as far as rounding can tell."""


def fixed_point(model: HybridModel, u: ArrayLike, x_guess: ArrayLike) -> tuple[Array, Array]:
    """The equilibrium ``x`` ``(n_x,)``, ``h`` ``(n_h,)`` under a held input, by Newton's method from a guess of ``x``.

    Where it does not end there, it begins anew from where the model's own run has come to, which finds a rest that is
    stable.

    Raises:
        InputError: If a size is wrong or none is found (largest residual above 1e-10 in the units of the state).
    """
    x0, u0 = vector(x_guess, model.n_x, "x_guess"), vector(u, model.n_u, "u")
    start = np.concatenate([x0, _settled(model, x0, u0)])
    found, size = _newton(_change(model), start, u0)
    if size > RESIDUAL:
        found, size = _newton(_change(model), _run(model, start, u0), u0)
    if size > RESIDUAL:
        raise InputError(
            f"model {model.name}: no fixed point found from x = {x0.tolist()} under u = {u0.tolist()} "
            f"(residual {size:.2g}, needed {RESIDUAL:g}); give a nearer x_guess or an input it can rest under"
        )
    return found[: model.n_x], found[model.n_x :]


def _run(model: HybridModel, z: Array, u: Array) -> Array:
    """States and hidden states ``(n_z,)`` that the model's own run comes to; where it diverges, the start."""
    x, h = z[: model.n_x], z[model.n_x :]
    for _ in range(RUN):
        x, h = (v.full().ravel() for v in model.step(x, h, u, model.w, model.p))
    after = np.concatenate([x, h])
    return after if np.all(np.isfinite(after)) else z


def hidden_equilibrium(model: HybridModel, x: ArrayLike, u: ArrayLike) -> Array:
    """Hidden state ``(n_h,)`` at rest while ``x`` ``(n_x,)`` and ``u`` ``(n_u,)`` are held, by Newton's method."""
    x0, u0 = vector(x, model.n_x, "x"), vector(u, model.n_u, "u")
    if model.n_h == 0:
        return np.zeros(0)
    h = ca.MX.sym("h", model.n_h)
    p = ca.MX.sym("p", model.n_x + model.n_u)
    r = model.step(p[: model.n_x], h, p[model.n_x :], model.w, model.p)[1] - h
    residual = ca.Function("residual", [h, p], [r, ca.densify(ca.jacobian(r, h))])
    found, size = _newton(residual, _settled(model, x0, u0), np.concatenate([x0, u0]))
    if size > RESIDUAL:
        raise InputError(
            f"model {model.name}: the hidden state finds no rest at x = {x0.tolist()} (residual {size:.2g}); give h"
        )
    return found


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
        )
    if starts < 1:
        raise InputError(f"equilibria: at least one start is needed, got {starts}")
    residual, size = _change(model), box[:, 1] - box[:, 0]
    unit = qmc.Sobol(model.n_x, scramble=False).random_base2(int(np.ceil(np.log2(starts))))[:starts]
    found: list[tuple[Array, float, int]] = []
    converged = 0
    for start in box[:, 0] + (unit + 0.5 / starts) % 1.0 * size:
        z, error = _newton(residual, np.concatenate([start, _settled(model, start, held)]), held)
        z = _turned(model, z, box)
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


def holding_input(model: HybridModel, q: ArrayLike, *, u_guess: ArrayLike | None = None) -> Array:
    """Input ``(n_u,)`` that holds a machine at rest at positions ``q`` ``(n_x / 2,)``, with its hidden state settled.

    Args:
        model: The model, state ``[q, v]``, with as many inputs as positions.
        q: The positions.
        u_guess: Start ``(n_u,)``. Default: zero.

    Raises:
        InputError: If the numbers of inputs and positions differ, or no such input is found.

    Example:
        ``gain_schedule(model, [(np.append(q, 0.0), holding_input(model, [q])) for q in angles], weights, costs)``
    """
    n_q = positions_of(model)
    if model.n_u != n_q:
        raise InputError(
            f"model {model.name}: {model.n_u} inputs cannot be found from {n_q} positions; give them"
        )
    x = np.concatenate([vector(q, n_q, "q"), np.zeros(n_q)])
    start = np.zeros(model.n_u) if u_guess is None else vector(u_guess, model.n_u, "u_guess")
    h, u, v = ca.MX.sym("h", model.n_h), ca.MX.sym("u", model.n_u), ca.MX.sym("x", model.n_x)
    x_next, h_next = model.step(v, h, u, model.w, model.p)
    unknown, change = ca.vertcat(h, u), ca.vertcat(h_next - h, x_next[n_q:] - v[n_q:])
    residual = ca.Function("hold", [unknown, v], [change, ca.densify(ca.jacobian(change, unknown))])
    found, size = _newton(residual, np.concatenate([_settled(model, x, start), start]), x)
    if size > RESIDUAL and model.n_u == 1 and (near := _between(model, x, float(start[0]))) is not None:
        found, size = _newton(residual, np.concatenate([_settled(model, x, near), near]), x)
    if size > RESIDUAL:
        raise InputError(
            f"model {model.name}: no input found that holds q = {x[:n_q].tolist()} (residual {size:.2g})"
        )
    return found[model.n_h :]


def _between(model: HybridModel, x: Array, guess: float) -> Array | None:
    """An input near which the speed changes sign with the hidden state settled, if one is found around a guess."""
    n_q = model.n_x // 2

    def gained(u: float) -> float:
        held = np.array([u])
        return float(model.step(x, _settled(model, x, held), held, model.w, model.p)[0][n_q])

    for reach in 0.01 * 2.0 ** np.arange(12):
        low, high = guess - reach, guess + reach
        if gained(low) * gained(high) < 0:
            return np.array([brentq(gained, low, high, xtol=1e-9)])
    return None


def _change(model: HybridModel) -> ca.Function:
    """``(z, u)`` to what one step changes of ``z = (x, h)``, and its Jacobian by ``z``."""
    x, h = ca.MX.sym("x", model.n_x), ca.MX.sym("h", model.n_h)
    z, v = ca.vertcat(x, h), ca.MX.sym("u", model.n_u)
    r = ca.vertcat(*model.step(x, h, v, model.w, model.p)) - z
    return ca.Function("change", [z, v], [r, ca.densify(ca.jacobian(r, z))])


def _newton(residual: ca.Function, z: Array, p: Array) -> tuple[Array, float]:
    """Newton with step halving from ``z``; the best point and its largest residual (inf if it is not finite)."""
    r, jacobian = (np.asarray(m.full()) for m in residual(z, p))
    for _ in range(ITERATIONS):
        size = float(np.abs(r).max(initial=0.0))
        if not np.isfinite(size) or size <= 1e-3 * RESIDUAL:
            break
        step = np.linalg.lstsq(jacobian, -r.ravel(), rcond=None)[0]
        scale, improved = 1.0, False
        while scale > 1e-4 and not improved:
            trial = z + scale * step
            r_new, j_new = (np.asarray(m.full()) for m in residual(trial, p))
            improved = bool(np.linalg.norm(r_new) < np.linalg.norm(r))
            scale *= 0.5
        if not improved:
            break
        z, r, jacobian = trial, r_new, j_new
    size = float(np.abs(r).max(initial=0.0))
    return z, size if np.isfinite(size) else float("inf")


def _settled(model: HybridModel, x: Array, u: Array) -> Array:
    """Where Newton's method starts: the hidden state ``(n_h,)`` after 100 periods at held ``x`` and ``u``."""
    return hidden_fixed_point(model, x, u, limit=100)
