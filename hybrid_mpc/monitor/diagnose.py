"""What broke: the residual force explained by changes of the prior's parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.model import HybridModel, changeable, incidence, prior_acceleration
from hybrid_mpc.monitor.energy import EnergyMonitor, MonitorState
from hybrid_mpc.monitor.energy_readings import inertia_of

Array = NDArray[np.float64]
LEAST = 0.01
"""Probability below which what a cause leaves over is something else."""
ALIKE = 4.0
"""Causes whose misfits differ by less (2 deviations) cannot be distinguished."""
BLIND = 1e-3
"""Share of the largest singular value below which a direction of causes cannot be seen."""
FEWEST = 3
"""Independent samples that an explanation needs."""
TOLERANCE = 0.15
"""Share of a fault's force that the monitor itself may get wrong: its window smooths the force, and the one step
starts from an estimate that has half followed it."""
ITERATIONS = 6
RANGE = (-0.9, 20.0)
"""Changes that are looked at: a parameter keeps its sign."""


@dataclass(frozen=True)
class Change:
    """A change of one cause with its standard deviation: as a share of the nominal value (0.5: half as much more), or,
    with a ``unit``, as a sum.
    """

    name: str
    value: float
    sigma: float
    unit: str = ""

    def __str__(self) -> str:
        if self.unit:
            return f"{self.name} {self.value:+.3g} ± {self.sigma:.2g} {self.unit}"
        return f"{self.name} {100 * self.value:+.0f} ± {100 * self.sigma:.0f} %"


@dataclass(frozen=True)
class Diagnosis:
    """What explains the residual force of the last seconds.

    Args:
        text: In words: ``"friction +95 ± 20 %"``, ``"none of the known causes"``, ``"nothing to explain"``.
        samples: Independent samples: those at speed over the length of the monitor's window.
        causes: One cause that explains all, or several that together do. Default: none does.
        alternatives: Other single causes that explain it as well.
        blind: Directions that the motion does not show, in words.
        p_value: Probability of what the causes leave over, if they are all there is. Default: not known.
    """

    text: str
    samples: float
    causes: tuple[Change, ...] = ()
    alternatives: tuple[Change, ...] = ()
    blind: tuple[str, ...] = ()
    p_value: float = math.nan


class Diagnoser:
    """Explains the residual force by changes of the prior's parameters, or says that none of them does.

    If parameters are off by the shares ``c``, the residual force is ``M (a(x, u, p (1 + c)) - a(x, u, p))``. A cause is
    a parameter, or several that change by the same share. Weighted Gauss-Newton over the monitor's history at speed
    gives the shares; the deviations are the detector's, and 15 % of the force itself. Residuals of one window overlap,
    so covariance and test count one sample a window. Every cause is tried alone first, since two rarely come together;
    if none passes the chi-square test, all of them at once. Directions that the motion does not excite are left at zero
    and named.

    Args:
        monitor: With ``history`` and a detector.
        causes: Names, and the parameters of each; an input's gain is ``"gain of <input>"``. Default: each by itself.
        prior: Model of the prior alone, whose parameters change. Default: the monitor's, where it has no network.

    Raises:
        InputError: If the monitor keeps no history or has no detector, the prior has no parameters, or one is unknown.

    Example: see ``tests/monitor/test_diagnosis.py``; with a monitor that has seen friction double::

        Diagnoser(monitor, {"friction": ("d", "mu"), "mass": ("m", "J")}, prior=prior).diagnose(state).text
    """

    def __init__(
        self,
        monitor: EnergyMonitor,
        causes: Mapping[str, Sequence[str]] | None = None,
        *,
        prior: HybridModel | None = None,
    ) -> None:
        model, detector = monitor.model, monitor.detector
        acceleration = prior_acceleration(model, prior)
        if not monitor.layout.history:
            raise InputError("diagnosis: the monitor keeps no history; make it with history=2.0 [s], say")
        if detector is None:
            raise InputError(
                "diagnosis: the monitor has no detector, so the residuals' own scatter is unknown"
            )
        chosen = {name: (name,) for name in changeable(model)} if causes is None else causes
        self._monitor, self._detector, self._names = monitor, detector, list(chosen)
        self._force = _force_function(model, acceleration, incidence(model, chosen, "diagnosis"))

    def diagnose(self, state: MonitorState, since: float = math.inf) -> Diagnosis:
        """What explains the residual force of the last ``since`` [s], e.g. since the alarm. Default: all history."""
        layout, detector = self._monitor.layout, self._detector
        rows = state.memory[layout.rows :].reshape(layout.history, layout.history_row)
        rows = rows[-min(layout.history, max(round(min(since, 1e6) / layout.model.dt), 1)) :]
        v = rows[:, layout.n_q : 2 * layout.n_q]
        moving = (np.abs(v) > 2 * np.array(self._monitor.rest_speed)).all(axis=1)
        used = np.isfinite(rows).all(axis=1) & moving
        x, u, residual = np.split(rows[used], [2 * layout.n_q, 2 * layout.n_q + layout.model.n_u], axis=1)
        sigma = detector.deviations(x[:, layout.n_q :] ** 2, (u**2).sum(axis=1))
        size = np.mean(residual**2, axis=0) if len(residual) else 0.0
        sigma = np.sqrt(sigma**2 + TOLERANCE**2 * size)

        def force(shares: Array) -> tuple[Array, Array]:
            predicted, slopes = (
                m.full() for m in self._force.map(len(x))(x.T, u.T, np.tile(shares[:, None], len(x)))
            )
            n, n_q = shares.size, layout.n_q
            slopes = slopes.reshape(n_q, len(x), n).transpose(1, 0, 2)
            return (predicted.T / sigma).ravel(), (slopes / sigma[:, :, None]).reshape(-1, n)

        return _explained(force, (residual / sigma).ravel(), self._names, float(layout.window))


def _force_function(model: HybridModel, acceleration: ca.Function, changed_by: Array) -> ca.Function:
    """``(x, u, shares) -> (force (n_q,), its slopes (n_q, causes))``."""
    values, n_p = ca.DM(model.p), model.n_p
    x, u = ca.MX.sym("x", model.n_x), ca.MX.sym("u", model.n_u)
    shares = ca.MX.sym("shares", changed_by.shape[1])
    factors = 1 + ca.DM(changed_by) @ shares
    changed = acceleration(x, factors[n_p:] * u, model.w, factors[:n_p] * values)
    force = inertia_of(model, x, u) @ (changed - acceleration(x, u, model.w, values))
    return ca.Function("force", [x, u, shares], [ca.densify(force), ca.densify(ca.jacobian(force, shares))])


def _explained(
    force: Callable[[Array], tuple[Array, Array]], b: Array, names: list[str], overlap: float
) -> Diagnosis:
    """Diagnosis from a scaled force ``shares -> (values (n,), slopes (n, causes))`` and scaled residuals ``b (n,)``.

    So many samples as ``overlap`` count as one.
    """
    samples = b.size / overlap
    if samples < FEWEST:
        return Diagnosis(
            f"too little motion to tell: {samples:.1f} independent samples, {FEWEST} needed", samples
        )
    every = np.arange(len(names))
    alone = [_fitted(force, b, every == i, overlap) for i in every]
    single = [
        Change(n, float(f[0][i]), float(np.sqrt(f[1][i, i])) if f[2][i] else math.inf)
        for i, (n, f) in enumerate(zip(names, alone, strict=True))
    ]
    misfits = np.array([f[3] for f in alone])
    shares, covariance, seen, left, directions = _fitted(force, b, every >= 0, overlap)
    blind = tuple(n for n, ok in zip(names, seen, strict=True) if not ok)
    blind += tuple(_words(row, names) for row in directions)
    sigma = np.sqrt(np.diag(covariance))
    joint = [
        Change(n, float(v), float(s)) for n, v, s, ok in zip(names, shares, sigma, seen, strict=True) if ok
    ]

    def result(
        text: str,
        misfit: float,
        freedom: float,
        causes: tuple[Change, ...] = (),
        others: tuple[Change, ...] = (),
    ) -> Diagnosis:
        return Diagnosis(text, samples, causes, others, blind, float(chdtrc(max(freedom, 1.0), misfit)))

    nothing = float(b @ b) / overlap
    if (quiet := result("nothing to explain", nothing, samples)).p_value > LEAST:
        return quiet
    best, *rest = np.argsort(misfits).tolist()
    others = tuple(
        single[i] for i in rest if misfits[i] - misfits[best] < ALIKE and math.isfinite(single[i].sigma)
    )
    text = " or ".join(str(change) for change in (single[best], *others))
    one = result(text, float(misfits[best]), samples - 1, (single[best],), others)
    if one.p_value > LEAST:
        return one
    causes = tuple(c for c in joint if abs(c.value) > 2 * c.sigma)
    several = result(" and ".join(map(str, causes)), left, samples - len(joint), causes)
    if causes and several.p_value > LEAST:
        return several
    share = misfits[best] / nothing
    nearest = f"none of the known causes (nearest: {single[best]}, which leaves {share:.0%} unexplained)"
    return replace(several, text=nearest, causes=())


def _fitted(
    force: Callable[[Array], tuple[Array, Array]], b: Array, free: NDArray[np.bool_], overlap: float
) -> tuple[Array, Array, NDArray[np.bool_], float, Array]:
    """Shares, covariance, which of them are seen, misfit, and directions ``(k, causes)`` that are not."""
    n, places = free.size, np.flatnonzero(free)
    shares = np.zeros(n)
    for _ in range(ITERATIONS):
        predicted, slopes = force(shares)
        size = np.linalg.norm(slopes, axis=0)
        used = places[size[places] > BLIND * max(float(size[places].max()), 1e-300)]
        _, s, directions = np.linalg.svd(slopes[:, used] / size[used], full_matrices=False)
        clear = s > BLIND * s[0] if s.size else np.zeros(0, dtype=bool)
        pseudo = (directions[clear].T / s[clear] ** 2) @ directions[clear]
        step = pseudo @ (slopes[:, used].T @ (b - predicted) / size[used]) / size[used]
        shares[used] = np.clip(shares[used] + step, *RANGE)
    covariance, blind = np.zeros((n, n)), np.zeros((int(np.sum(~clear)), n))
    covariance[np.ix_(used, used)] = overlap * pseudo / np.outer(size[used], size[used])
    blind[:, used] = directions[~clear]
    seen = np.zeros(n, dtype=bool)
    seen[used] = True
    left = float(np.sum((b - force(shares)[0]) ** 2)) / overlap
    return shares, covariance, seen, left, blind


def _words(direction: Array, names: list[str]) -> str:
    """Names of the causes that a direction mixes."""
    most = np.max(np.abs(direction))
    mixed = [(name, w) for name, w in zip(names, direction, strict=True) if abs(w) > 0.2 * most]
    sign = math.copysign(1.0, mixed[0][1])
    first, *others = mixed
    return first[0] + "".join((" with " if sign * w > 0 else " against ") + name for name, w in others)
