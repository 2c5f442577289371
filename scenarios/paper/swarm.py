"""Fit of a prior's parameters by particle swarm, as in the paper (pymoo, an optional extra).

:func:`~hybrid_mpc.identify.fit.fit_prior` takes what it finds as a ``start``.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import qmc

from hybrid_mpc.data import scales
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.dataset import Windows, cut_windows
from hybrid_mpc.identify.fit import ParameterFit
from hybrid_mpc.identify.step import required_substeps
from hybrid_mpc.machine.torch_prior import Prior

Array = NDArray[np.float64]
DIVERGED = 1e9
"""Error of parameters whose free runs diverge: the swarm computes with it, so it must be finite."""
SECONDS = 2.0
WINDOWS = 24
"""Every set of parameters is simulated over so many free runs of at most ``SECONDS`` [the machine's seconds]."""


@dataclass(frozen=True)
class SwarmSettings:
    """Effort of a particle swarm: sets of parameters, and how often all of them move."""

    particles: int = 24
    generations: int = 40
    seed: int = 0

    def __post_init__(self) -> None:
        if self.particles < 2 or self.generations < 1:
            raise InputError(
                f"particle swarm: needs 2 particles and 1 generation at least, got {self.particles} and "
                f"{self.generations}; the defaults are 24 and 40"
            )


def swarm_values(
    make: Callable[..., Prior],
    train: Sequence[Trajectory],
    dt: float,
    settings: SwarmSettings | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, float]:
    """Values [SI] of a prior's parameters that free runs of up to 2 s follow best, searched between the bounds."""
    fit, longest = ParameterFit(make, dt), max(len(t.t) for t in train) - 1
    n = max(1, min(scales.periods(scales.time_unit(train, dt) * SECONDS, dt), longest // 2))
    windows = cut_windows(train, 0, n, max(1, n // 4))
    chosen = torch.linspace(0, len(windows) - 1, min(WINDOWS, len(windows))).round().long()
    return fit.values(particle_swarm(fit, windows.take(chosen), settings or SwarmSettings(), on_progress))


def particle_swarm(
    fit: ParameterFit,
    windows: Windows,
    settings: SwarmSettings,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Array:
    """``theta`` of the least mean absolute error of free runs over the windows, searched between the bounds.

    The swarm starts from the nominal parameters and a Latin hypercube. All particles run at once. It needs no
    derivative and no good start, and many more simulations than a fit with derivatives.

    Source: Kennedy, Eberhart, *Particle swarm optimization* (1995), adaptive as pymoo has it: Blank, Deb, *pymoo:
    multi-objective optimization in Python*, IEEE Access 8 (2020).
    """
    pso, problems = _pymoo()
    n = len(fit.free)
    hypercube = qmc.LatinHypercube(n, rng=np.random.default_rng(settings.seed)).random(settings.particles - 1)
    first = np.vstack([fit.inside(fit.nominal), fit.lower + hypercube * (fit.upper - fit.lower)])
    found: list[tuple[float, Array]] = []

    class FreeRuns(problems.Problem):  # type: ignore[name-defined]
        def _evaluate(self, x: Array, out: dict[str, Any], *args: Any, **kwargs: Any) -> None:
            errors = errors_of(fit, x, windows)
            found.append((float(errors.min()), x[int(errors.argmin())].copy()))
            out["F"] = np.where(np.isfinite(errors), errors, DIVERGED)

    swarm = pso.PSO(pop_size=settings.particles, sampling=first)
    swarm.setup(
        FreeRuns(n_var=n, n_obj=1, xl=fit.lower, xu=fit.upper),
        termination=("n_gen", settings.generations), seed=settings.seed, verbose=False,
    )  # fmt: skip
    while swarm.has_next():
        swarm.next()
        on_progress(len(found), settings.generations)
    least, best = min(found, key=lambda pair: pair[0])
    if not np.isfinite(least):
        raise InputError(
            "particle swarm: free runs diverge with all parameters between the bounds; check the prior's signs "
            "and units, or narrow the bounds"
        )
    return best


def errors_of(fit: ParameterFit, thetas: Array, windows: Windows) -> Array:
    """Mean absolute error [spreads of the data] of each row of ``thetas`` ``(n, p)``, all at once.

    Infinite where free runs diverge, or where the prior is too stiff for the period.
    """
    errors = np.full(len(thetas), np.inf)
    groups: dict[int, list[int]] = {}
    for i, theta in enumerate(thetas):
        try:
            groups.setdefault(required_substeps(fit.make(fit.values(theta)), fit.dt), []).append(i)
        except InputError:
            continue
    for substeps, rows in groups.items():
        means = [np.abs(fit.residual(theta, windows, substeps)).mean() for theta in thetas[rows]]
        errors[rows] = np.where(np.isfinite(means), means, np.inf)
    return errors


def _pymoo() -> tuple[Any, Any]:
    try:
        return (
            importlib.import_module("pymoo.algorithms.soo.nonconvex.pso"),
            importlib.import_module("pymoo.core.problem"),
        )
    except ImportError as missing:
        raise InputError(
            "the fit by particle swarm needs pymoo, which is not installed: pip install 'hybrid-mpc[swarm]' (or "
            "pip install 'pymoo>=0.6.1')"
        ) from missing
