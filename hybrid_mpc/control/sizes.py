"""Sizes of states, outputs and bounded values of a control problem: the scales of solvers and targets in any units."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.equilibrium import hidden_fixed_point
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.model.stages import free_run

if TYPE_CHECKING:
    from hybrid_mpc.control.ocp import OCP

Array = NDArray[np.float64]
PERIODS, RUNS = 50, 4
"""Longest of the model's own runs [periods], and the number of runs with random inputs: without recordings and ranges
they show how far a state moves."""


class Sizes:
    """Sizes of a problem's signals; they scale with the units of the signals.

    The *natural* size of a state or output is its spread in the recordings, stored in the kit
    (``HybridModel.state_spread`` and ``output_spread``), else half the signal's range, else how far the model moves it
    from the operating point within the horizon, under inputs and disturbances over their whole range. A state's size is
    its natural size, but at most the deviation that its weight tolerates, ``1 / sqrt(q)``.

    Args:
        model: The model.
        ocp: The problem.

    Raises:
        InputError: If a state has no weight, no spread and no range, and nothing moves it.

    Example:
        >>> from hybrid_mpc.control.ocp import OCP
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "m", 0.0, 3.0),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> Sizes(model, OCP(5, [0.0], [1.0], [0.0], [-9.0], [9.0])).states
        array([1.5])
    """

    def __init__(self, model: HybridModel, ocp: OCP) -> None:
        self._model, self._ocp = model, ocp
        known = _known(model.state_spread, [s.upper - s.lower for s in model.states])
        size = np.fmin(known, _tolerated(ocp.q))
        if np.any(np.isnan(size)):
            size = np.where(np.isnan(size), self._moved, size)
        if np.any(np.isnan(size)):
            names = ", ".join(model.states[i].name for i in np.flatnonzero(np.isnan(size)))
            raise InputError(
                f"control problem: the size of {names} is unknown: no weight in q, no range, no recordings, and no "
                f"input affects it. Give the signal a range: Signal({names.split(',')[0]!r}, unit, lower, upper) "
                "[HM-CONTROL-043]"
            )
        self.states: Array = size
        """Sizes of the states ``(n_x,)``."""
        delayed = np.resize(ocp.input_scale, model.delay_states)
        self.hidden: Array = np.concatenate([delayed, np.ones(model.n_h - model.delay_states)])
        """Sizes of the hidden states ``(n_h,)``: delayed inputs have the inputs' sizes, those of a network are 1."""

    @cached_property
    def outputs(self) -> Array:
        """Sizes of the outputs ``(n_y,)``: natural ones, at most ``1 / sqrt(q_y)``; NaN for unknown ones."""
        return np.fmin(self.natural_outputs, _tolerated(self._ocp.q_y) if self._ocp.n_y else np.nan)

    def values(self, f: ca.Function) -> Array:
        """Sizes of the values of ``f(x, u, e)``, a column ``(n,)``: how far they move when states and inputs move by
        their natural sizes from the operating point, one at a time or all; NaN if they do not move.
        """
        m, around = self._model, np.zeros(f.numel_in(2))
        around[m.n_d : m.n_d + m.n_w] = m.w[: max(around.size - m.n_d, 0)]
        point = np.concatenate([m.x0, self._held])
        size = np.concatenate([np.fmax(self.natural, self.states), self._ocp.input_scale])
        steps = size * np.vstack(
            [np.eye(size.size), np.random.default_rng(0).uniform(0.5, 1.0, (RUNS, size.size))]
        )

        def at(v: Array) -> Array:
            return np.asarray(f(v[: m.n_x], v[m.n_x :], around)).ravel()

        with np.errstate(invalid="ignore", over="ignore"):  # values that are not finite are ignored
            moved = np.abs(np.array([at(point + step) for step in (*steps, *-steps)]) - at(point))
        return _largest(moved)

    @cached_property
    def cost(self) -> float:
        """Cost per second of a signal's deviation by its size: the largest of all signals, at least 1, the cost of a
        tolerated deviation.
        """
        ocp = self._ocp
        parts = [ocp.q * self.natural**2, (ocp.r + ocp.r_delta) * ocp.input_range**2]
        parts += [ocp.q_y * self.natural_outputs**2] if ocp.n_y else []
        return float(np.nanmax(np.concatenate([[1.0], *parts])))

    @cached_property
    def natural(self) -> Array:
        """Natural sizes of the states ``(n_x,)``; NaN for unknown ones."""
        m = self._model
        known = _known(m.state_spread, [s.upper - s.lower for s in m.states])
        return np.where(np.isnan(known), self._moved, known) if np.any(np.isnan(known)) else known

    @cached_property
    def natural_outputs(self) -> Array:
        """Natural sizes of the outputs ``(n_y,)``; NaN for unknown ones."""
        m = self._model
        known = _known(m.output_spread, [s.upper - s.lower for s in m.outputs])
        if not np.any(np.isnan(known)):
            return known
        x, u, e = ca.MX.sym("x", m.n_x), ca.MX.sym("u", m.n_u), ca.MX.sym("e", m.n_d + m.n_w)
        f = ca.Function("outputs", [x, u, e], [ca.densify(m.output(x, u, e[m.n_d :], m.p))])
        return np.where(np.isnan(known), self.values(f), known)

    @property
    def _held(self) -> Array:
        return np.clip(self._model.u0, self._ocp.u_min, self._ocp.u_max)

    @cached_property
    def _moved(self) -> Array:
        """Largest deviations ``(n_x,)`` of the states from the operating point in its runs; NaN for no motion."""
        m, ocp, rng = self._model, self._ocp, np.random.default_rng(0)
        n, u0, scale = min(ocp.horizon, PERIODS), self._held, ocp.input_scale
        run = free_run(m, n)
        z0 = np.concatenate([m.x0, hidden_fixed_point(m, m.x0, u0)])
        room = np.array([0.5 * (s.upper - s.lower) for s in m.disturbances])
        load, inflow = disturbance_sizes(m, ocp), np.where(np.isfinite(room), room, 0.0)
        plans = [np.tile(step, (n, 1)) for row in np.eye(m.n_u) for step in (row, -row)]
        plans += list(rng.uniform(-1.0, 1.0, (RUNS, n, m.n_u)))
        found = []
        for plan in plans:
            u = np.clip(u0 + scale * plan, ocp.u_min, ocp.u_max)
            d, w = (size * rng.uniform(-1.0, 1.0, size.size) for size in (load, inflow))
            with np.errstate(invalid="ignore", over="ignore"):  # a diverging run is finite at first
                found.append(np.abs(run(z0, m.acting(u, d, np.tile(m.w + w, (n, 1))))[:, : m.n_x] - m.x0))
        moved = _largest(np.vstack(found))
        rounding = 1e-12 * np.abs(m.x0)
        return np.where(moved > rounding, moved, np.nan)


def disturbance_sizes(model: HybridModel, ocp: OCP) -> Array:
    """Large values ``(n_d,)`` of the model's unmeasured disturbances: their own, or the input's range."""
    if model.disturbance_model is None:
        return ocp.input_range
    ranges = dict(zip([s.name for s in model.inputs], ocp.input_range, strict=True))
    return np.array([d.size or ranges[d.signal] for d in model.disturbance_model])


def _known(spread: tuple[float, ...], ranges: list[float]) -> Array:
    """The spread of signals in recordings, else half their range; NaN where there is neither."""
    half = np.array(ranges) / 2
    half = np.where(np.isfinite(half), half, np.nan)
    own = np.array(spread) if spread else np.zeros(half.size)
    return np.where(own > 0, own, half)


def _tolerated(weight: Array) -> Array:
    """Deviations that weights tolerate, ``1 / sqrt(weight)``; NaN for a weight of zero."""
    with np.errstate(divide="ignore"):
        return np.where(weight > 0, 1.0 / np.sqrt(weight), np.nan)


def _largest(rows: Array) -> Array:
    """Largest finite value of each column; NaN where there is none above zero."""
    most = np.max(np.where(np.isfinite(rows), rows, 0.0), axis=0, initial=0.0)
    return np.where(most > 0, most, np.nan)
