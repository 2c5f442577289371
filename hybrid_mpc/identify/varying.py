"""Parameters that differ between recordings: a mixed-effects fit around the fitted prior.

Parameter j of recording r is ``theta_j + b_rj`` with ``b_rj ~ N(0, omega_j^2)``. Each recording has a Gauss-Newton
approximation of its own likelihood from free runs with free initial states; the deviations ``b`` and the means are
eliminated exactly, and the variances ``omega^2`` maximise what remains, the evidence. A parameter enters only if it
raises the evidence, so a parameter that the recordings do not identify stays fixed.

Source: Lindstrom and Bates, *Nonlinear mixed effects models for repeated measures data*, Biometrics 46 (1990); Self and
Liang, *Asymptotic properties of maximum likelihood estimators under nonstandard conditions*, JASA 82 (1987), of the
test of a variance at its bound; Patterson and Thompson, *Recovery of inter-block information*, Biometrika 58 (1971), of
the elimination of the means.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.tracking import DAY, TrackedParameter, is_relative
from hybrid_mpc.identify.fit import smoothed
from hybrid_mpc.identify.output_fit import OutputFit
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.shooting import Shooting
from hybrid_mpc.identify.windows import cut_outputs
from hybrid_mpc.machine.prior import Prior

Array = NDArray[np.float64]
WINDOWS_OF_EACH = 4
"""Windows of a recording at least: each has one free initial state, so a single window contains little information
about the parameters."""
BLOCKS = 4
"""Blocks into which a single recording is cut: their scatter replaces that between recordings."""
SHORTEST = 8
"""Periods of a window at least."""
WORTH = 2.0
"""Gain of log evidence by which a parameter counts as varying. Twice the gain of a fixed parameter is 0 in half of the
cases and chi-square with one degree of freedom in the others: it exceeds 4 in 2.3 % of the cases."""
WEAK = 1.0
"""Standard deviation of a mean's distance from its fitted value, in the scale of the deviations: the fit has used the
same recordings, so the means are nearly known."""
RANGE = (0.002, 1.0)
"""Smallest and largest standard deviation that is tried: of a relative deviation, or of one in half ranges."""
TRIED = 14
ITERATIONS, SETTLED = 200, 1e-3
"""Steps of the expectation-maximisation at most, and relative change of a variance that ends them."""
USUAL = 0.05
"""Standard deviation (relative, or in half ranges) of a parameter that the user declares as varying and that the
recordings do not identify."""


@dataclass(frozen=True)
class VaryingParameter:
    """Variation of one parameter between recordings.

    Args:
        name: Name of the parameter.
        unit: Its unit.
        value: Fitted value [unit].
        std: Standard deviation of its values over the recordings [unit]; 0: fixed.
        alone: The same if no other parameter varied [unit].
        gain: Log evidence by which ``alone`` exceeds a fixed parameter [-].
        relative: Whether the deviations are normal on a logarithmic scale; else on the parameter's own.
        declared: Whether the user has decided (``Parameter(..., varies=...)``).
        time: Declared time constant [s] of its drift within a recording. Default: none was declared.
    """

    name: str
    unit: str
    value: float
    std: float
    alone: float
    gain: float
    relative: bool
    declared: bool = False
    time: float | None = None

    @property
    def varies(self) -> bool:
        """Whether the parameter differs between recordings."""
        return self.std > 0

    def tracked(self, std: float | None = None) -> TrackedParameter:
        """The parameter as an observer tracks it, with :attr:`std` or another standard deviation [unit]."""
        own = self.std if std is None else std
        size = own / abs(self.value) if self.relative else own
        return TrackedParameter(self.name, size, self.relative, self.time or DAY)


@dataclass(frozen=True)
class Varying:
    """Which parameters vary between recordings.

    Args:
        parameters: One entry for each free parameter, in the order of the prior.
        pieces: Number of recordings, or of blocks of a single recording.
        blocks: Whether the pieces are blocks of a single recording. They show the variation within it, not that between
            days.
        reason: Why there is no result; empty if there is one.
    """

    parameters: tuple[VaryingParameter, ...]
    pieces: int
    blocks: bool = False
    reason: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the varying parameters."""
        return tuple(p.name for p in self.parameters if p.varies)

    def rows(self) -> list[dict[str, Any]]:
        """One row a parameter: name, unit, value, standard deviations, gain of log evidence."""
        return [
            {"parameter": p.name, "unit": p.unit, "fitted": p.value, "std": p.std, "alone": p.alone,
             "gain": p.gain, "varies": p.varies}
            for p in self.parameters
        ]  # fmt: skip


def find_varying(
    make: Callable[..., Prior], fit: PriorFit, recordings: Sequence[Trajectory], *, dt: float, length: float
) -> Varying:
    """Find the parameters that differ between recordings, with the standard deviations of their differences.

    Pieces of one file are one recording. A single recording is cut into blocks, which are compared. The errors of free
    runs are correlated; their likelihood is tempered by their correlation time.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        fit: The fit to all these recordings.
        recordings: The recordings that it was fitted to, inputs as commanded.
        dt: Model period [s].
        length: Longest length [s] of the free runs; shorter ones are used if a recording holds fewer than four.

    Raises:
        InputError: If the recordings are too short.

    Example:
        ``find_varying(make, fit, [*train, *valid], dt=0.02, length=2.0).names``
    """
    of = OutputFit(make, dt)
    of.least = max(1, fit.substeps)
    if not of.free:
        return Varying((), 0, reason="the prior has no free parameter")
    known = smoothed(make, fit, recordings, dt)
    pieces, blocks = pieces_of(known)
    longest = [max(len(t.t) for t in part) for part in pieces]
    periods = min(round(length / dt), min(longest) // WINDOWS_OF_EACH)
    if periods < SHORTEST:
        raise InputError(
            f"varying parameters: the shortest recording has {min(longest)} samples, but at least "
            f"{WINDOWS_OF_EACH * SHORTEST} are needed. Remove this recording [HM-IDENTIFY-078]"
        )
    theta = of.scaled(fit.values)
    relative = np.array([is_relative(p) for p in of.free])
    scale = np.where(relative, np.abs(theta), of.half)  # of a deviation: the value, or half of the range
    sizes = np.array(fit.smoother(of.prior, dt).sizes.x)

    def problem(part: Sequence[Trajectory], spread: Array | None = None) -> Shooting:
        # windows of a recording at most, evenly chosen
        windows = cut_outputs(part, periods, 0, 48, of.prior.states, of.prior.outputs)
        return Shooting(of, windows, sizes, spread)

    parts = [problem(part) for part in pieces]
    spread = np.mean([p.spread for p in parts], axis=0)
    parts = [problem(part, spread) for part in pieces]
    linear = [p.scaled_slopes(theta) for p in parts]
    unit = np.sqrt(np.mean([s**2 for _, _, s in linear], axis=0))
    times = _correlation_times([e for _, e, _ in linear], len(unit))
    quadratics = []
    for slopes, error, _ in linear:
        weight = 1.0 / (unit * np.sqrt(times))
        j = (slopes * scale * np.tile(weight, slopes.shape[1] // len(unit))[:, None]).reshape(-1, len(scale))
        e = (error * np.tile(weight, error.shape[1] // len(unit))).ravel()
        quadratics.append((j.T @ j, -j.T @ e))
    evidence = _Evidence(np.array([a for a, _ in quadratics]), np.array([c for _, c in quadratics]))
    unit_of = scale * of.unit  # from deviations to the parameters' units
    wanted = [p.varies[0] if isinstance(p.varies, tuple) else p.varies for p in of.free]
    given = np.array([math.nan if v is None or isinstance(v, bool) else v for v in wanted]) / unit_of
    std, alone, gain = _chosen(evidence, [v is False for v in wanted], [v is True for v in wanted], given)
    found = tuple(
        VaryingParameter(
            p.name, p.unit, fit.values[p.name], float(s * u), float(a * u), float(g), bool(r),
            p.varies is not None, p.varies[1] if isinstance(p.varies, tuple) else None,
        )
        for p, s, a, g, u, r in zip(of.free, std, alone, gain, unit_of, relative, strict=True)
    )  # fmt: skip
    return Varying(found, len(pieces), blocks)


def pieces_of(known: Sequence[Trajectory]) -> tuple[list[list[Trajectory]], bool]:
    """The trajectories of each recording; or the blocks of a single one, and True."""
    files: dict[str, list[Trajectory]] = {}
    for t in known:
        files.setdefault(t.file, []).append(t)
    if len(files) > 1:
        return [files[name] for name in sorted(files)], False
    (longest,) = [max(part, key=lambda t: len(t.t)) for part in files.values()]
    edges = np.linspace(0, len(longest.t), BLOCKS + 1).astype(int)
    return [[longest.part(slice(a, b))] for a, b in pairwise(edges)], True


def _correlation_times(errors: Sequence[Array], n_y: int) -> Array:
    """Correlation time [samples] of the errors of each output ``(n_y,)``: ``1 + 2 sum_l rho_l``.

    Source: Sokal, *Monte Carlo methods in statistical mechanics* (1997), section 3.
    """
    every = np.concatenate([e.reshape(len(e), -1, n_y) for e in errors])
    samples = every.shape[1]
    found = np.ones(n_y)
    for j in range(n_y):
        e, power = every[..., j], float(np.square(every[..., j]).mean())
        for lag in range(1, samples):
            rho = float((e[:, lag:] * e[:, :-lag]).mean()) / max(power, 1e-300)
            # autocorrelation of the errors below which the sum of the correlations ends
            if rho < 0.05:
                break
            found[j] += 2.0 * rho * (1.0 - lag / samples)
    return found


@dataclass(frozen=True)
class _Evidence:
    """Log likelihoods ``c_r' s - s' A_r s / 2`` of the pieces in deviations ``s`` from the fit, ``A`` ``(n, k, k)``."""

    a: Array
    c: Array

    def log(self, variances: Array) -> float:
        """Log evidence of variances ``(k,)``: deviations and means eliminated, without its constant."""
        return self._eliminated(variances)[0]

    def _eliminated(self, variances: Array) -> tuple[float, Array, Array, Array]:
        """Log evidence, the means ``(k,)``, their covariance, and the inverse of ``I + V^1/2 A V^1/2``."""
        root, eye = np.sqrt(variances), np.eye(len(variances))
        inner = eye + root[:, None] * self.a * root
        inverse: Array = np.asarray(np.linalg.inv(inner), dtype=np.float64)
        left = (self.a * root) @ inverse
        k = self.a - left @ np.swapaxes(self.a * root, 1, 2)  # (A^-1 + V)^-1
        shown = self.c - np.einsum("rij,rj->ri", left, root * self.c)
        both, total = k.sum(axis=0) + WEAK**-2 * eye, shown.sum(axis=0)
        covariance: Array = np.asarray(np.linalg.inv(both), dtype=np.float64)
        mean: Array = np.asarray(covariance @ total, dtype=np.float64)
        own = np.einsum("ri,rij,rj->", root * self.c, inverse, root * self.c)
        size = np.linalg.slogdet(inner)[1].sum() + np.linalg.slogdet(both)[1]
        return float(0.5 * (own + total @ mean - size)), mean, covariance, inverse

    def maximised(self, variances: Array) -> Array:
        """Variances of the largest evidence, from a start; zeros stay zero.

        Source: Dempster, Laird, Rubin, *Maximum likelihood from incomplete data via the EM algorithm* (1977).
        """
        for _ in range(ITERATIONS):
            _, mean, covariance, inverse = self._eliminated(variances)
            root = np.sqrt(variances)
            left = root[:, None] * inverse * root  # covariance of b_r for given means
            b = np.einsum("rij,rj->ri", left, self.c - self.a @ mean)
            moved = left @ self.a
            spread = left + moved @ covariance @ np.swapaxes(moved, 1, 2)
            new = np.where(variances > 0, (b**2 + np.diagonal(spread, axis1=1, axis2=2)).mean(axis=0), 0.0)
            new = np.minimum(new, RANGE[1] ** 2)
            on = variances > 0
            still = np.abs(np.log(new[on] / variances[on])) < SETTLED
            variances = new
            if still.all():
                break
        return variances

    def best_of_one(self, variances: Array, j: int) -> tuple[float, float]:
        """Gain of log evidence by variance j beside the others, and its standard deviation; the best on a grid."""
        base = self.log(np.where(np.arange(len(variances)) == j, 0.0, variances))
        tried = []
        for std in np.geomspace(*RANGE, TRIED):
            trial = variances.copy()
            trial[j] = std**2
            tried.append((self.log(trial) - base, float(std)))
        return max(tried)


def _chosen(
    evidence: _Evidence, never: Sequence[bool], always: Sequence[bool], given: Array
) -> tuple[Array, Array, Array]:
    """Standard deviations ``(k,)`` of the parameters that vary, those of each alone, and the gains of each alone.

    Parameters enter one after the other, the largest gain of evidence first, until no gain reaches ``WORTH``.
    """
    k = len(given)
    alone, gain = np.zeros(k), np.zeros(k)
    for j in range(k):
        gain[j], alone[j] = evidence.best_of_one(np.zeros(k), j)
    alone, gain = np.where(gain > 0, alone, 0.0), np.maximum(gain, 0.0)
    declared = np.isfinite(given)
    fixed = np.where(declared, np.square(given), 0.0)
    variances = fixed.copy()
    open_ = [j for j in range(k) if not never[j] and not declared[j]]
    for j in (j for j in open_ if always[j]):
        worth, std = evidence.best_of_one(variances, j)
        variances[j] = (std if worth > 0 else USUAL) ** 2
    while rest := [j for j in open_ if not variances[j]]:
        trials = [(*evidence.best_of_one(variances, j), j) for j in rest]
        worth, std, best = max(trials)
        if worth < WORTH:
            break
        trial = variances.copy()
        trial[best] = std**2
        variances = np.where(declared, fixed, evidence.maximised(trial))
    return np.sqrt(variances), alone, gain
