"""SINDy with control: a sparse equation of motion, picked from libraries of terms (pysindy, an optional extra)."""

from __future__ import annotations

import importlib
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.dataset import Windows, check_rates, cut_windows
from hybrid_mpc.identify.evaluate import free_runs
from hybrid_mpc.identify.simulation import MAX_SUBSTEPS, rest_of
from hybrid_mpc.identify.step import Step, rk4
from hybrid_mpc.machine.mechanical import MechanicalPrior
from scenarios.paper.jobs import figures_of

# Libraries of candidate terms, and the model that a sparse regression over them gives, as a step (torch).

STEEPNESS = (5.0, 10.0, 20.0, 50.0, 100.0)
"""Slopes gamma [s/rad] of ``tanh(gamma v)`` that :func:`machine_libraries` offers: no regression finds gamma."""
DEGREE = 3
"""Highest degree of the polynomials that :func:`machine_libraries` offers."""
_FUNCTIONS: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "value": (lambda z: z, "{}"),
    "sin": (torch.sin, "sin({})"),
    "cos": (torch.cos, "cos({})"),
    "tanh": (torch.tanh, "tanh({})"),
    "abs": (torch.abs, "|{}|"),
    "abs_cos": (lambda z: torch.abs(torch.cos(z)), "|cos({})|"),
}


@dataclass(frozen=True)
class Factor:
    """``function(scale * signal) ** power``, a factor of a candidate term; the signal is a state or an input.

    Functions: ``"value"``, ``"sin"``, ``"cos"``, ``"tanh"``, ``"abs"``, ``"abs_cos"``.
    """

    signal: str
    function: str = "value"
    scale: float = 1.0
    power: int = 1

    def __post_init__(self) -> None:
        if self.function not in _FUNCTIONS:
            raise InputError(
                f"a term has no function {self.function!r}; there are: {', '.join(_FUNCTIONS)}"
                " [HM-SCENARIOS-030]"
            )
        if not isinstance(self.power, int) or self.power < 1:
            raise InputError(
                f"a power must be a whole number of at least 1, got {self.power} [HM-SCENARIOS-031]"
            )

    @property
    def label(self) -> str:
        """As an equation has it."""
        inner = self.signal if self.scale == 1.0 else f"{self.scale:g} {self.signal}"
        text = _FUNCTIONS[self.function][1].format(inner)
        return text if self.power == 1 else f"{text}^{self.power}"

    def __call__(self, signal: Tensor) -> Tensor:
        """Its value, any shape."""
        value = base = _FUNCTIONS[self.function][0](self.scale * signal if self.scale != 1.0 else signal)
        for _ in range(self.power - 1):
            value = value * base
        return value


Term = tuple[Factor, ...]
"""A candidate term: the product of its factors; none of them is the constant 1."""


@dataclass(frozen=True)
class Library:
    """Candidate terms of an acceleration, as plain data."""

    name: str
    terms: tuple[Term, ...]

    @property
    def labels(self) -> tuple[str, ...]:
        """Each term as an equation has it."""
        return tuple(" ".join(factor.label for factor in term) or "1" for term in self.terms)


class SindyStep(Step):
    """An identified equation as a step ``(x, h, u) -> (x_next, h_next)`` with an empty hidden state.

    Kinematics are exact, the acceleration is the sum of terms times coefficients, Runge-Kutta of order 4 integrates
    with the input held: as :class:`~hybrid_mpc.identify.step.PriorStep` does.
    ``coefficients`` are ``(n_terms, n_q)`` [SI]; leading axes are those of a batch, a model for each of its rows.
    """

    coefficients: Tensor

    def __init__(
        self,
        prior: MechanicalPrior,
        library: Library,
        coefficients: Tensor,
        dt: float,
        substeps: int | None = None,
        candidates: tuple[SindyCandidate, ...] = (),
    ) -> None:
        super().__init__(prior, dt)
        self.library, self.candidates, self.n_q = library, candidates, prior.n_q
        self._names = signal_names(prior, library)
        if coefficients.shape[-2:] != (len(library.terms), prior.n_q):
            raise InputError(
                f"library {library.name}: coefficients are {tuple(coefficients.shape)}, its terms and the "
                f"accelerations need {(len(library.terms), prior.n_q)} [HM-SCENARIOS-032]"
            )
        self.register_buffer("coefficients", coefficients)
        self.substeps = substeps or self._required_substeps()

    def _required_substeps(self) -> int:
        """Sub-steps a period that the fastest mode at rest asks for, as of a prior."""
        x, u, _ = (torch.tensor(v) for v in rest_of(self.prior))
        slope = torch.func.jacrev(lambda z: self._xdot(z, u))(x)
        rate = float(torch.linalg.eigvals(slope).abs().max())
        substeps = max(1, math.ceil(rate * self.dt)) if math.isfinite(rate) else MAX_SUBSTEPS + 1
        if substeps > MAX_SUBSTEPS:
            raise InputError(
                f"SINDy with the library {self.library.name}: the model's fastest mode at rest is {rate:.3g} 1/s, too "
                f"fast for a period of {self.dt} s [HM-SCENARIOS-033]"
            )
        return substeps

    def forward(
        self, x: Tensor, h: Tensor, u: Tensor, w: Tensor, p: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Next state ``(..., n_x)`` and the hidden state as it came."""
        return rk4(lambda z: self._xdot(z, u), x, self.dt, self.substeps), h

    def xdot(self, x: Tensor, h: Tensor, u: Tensor, w: Tensor, p: Tensor | None = None) -> Tensor:
        """Derivative of the state at the instant."""
        return self._xdot(x, u)

    def features(self, x: Tensor, u: Tensor) -> Tensor:
        """The terms ``(..., n_terms)`` at ``x`` ``(..., n_x)`` and ``u`` ``(..., n_u)``, which broadcast."""
        return evaluate(self.library, self._names, x, u)

    def text(self, digits: int = 4) -> tuple[str, ...]:
        """The identified equations, one an acceleration; terms whose coefficient is zero are left out."""
        n_q, made = self.n_q, []
        for i, signal in enumerate(self.prior.states[n_q : 2 * n_q]):
            pairs = zip(self.coefficients[:, i].tolist(), self.library.labels, strict=True)
            parts = [
                f"{'-' if c < 0 else '+'} {abs(c):.{digits}g}{'' if term == '1' else ' ' + term}"
                for c, term in pairs
                if c
            ]
            right = " ".join(parts).removeprefix("+ ") or "0"
            made.append(f"{signal.name}' = {right}")
        return tuple(made)

    def _xdot(self, x: Tensor, u: Tensor) -> Tensor:
        acceleration = (self.features(x, u).unsqueeze(-1) * self.coefficients).sum(-2)
        return torch.cat([x[..., self.n_q :], acceleration], dim=-1)


@dataclass(frozen=True)
class SindyCandidate:
    """One fit of a library with a threshold, a share of the acceleration's root mean square, and the terms that it
    keeps.

    ``training`` is the mean absolute error of the training accelerations [rad/s²], ``validation`` E_sim on the
    validation free runs (duration form, λ = 0), infinite if one diverges or the model is too stiff for the period.
    """

    library: str
    threshold: float
    terms: int
    training: float
    validation: float


def evaluate(library: Library, names: dict[str, int], x: Tensor, u: Tensor) -> Tensor:
    """Terms of a library ``(..., n_terms)``; ``names`` gives the column of each signal in ``[x, u]``."""
    n_x, made = x.shape[-1], {}
    shape = torch.broadcast_shapes(x.shape[:-1], u.shape[:-1])
    columns = []
    for term in library.terms:
        column = x.new_ones(()).expand(shape)
        for i, factor in enumerate(term):
            if factor not in made:  # terms share factors
                at = names[factor.signal]
                made[factor] = factor(x[..., at] if at < n_x else u[..., at - n_x])
            column = made[factor] if i == 0 else column * made[factor]
        columns.append(column.expand(shape))
    return torch.stack(columns, dim=-1)


def signal_names(prior: MechanicalPrior, library: Library) -> dict[str, int]:
    """Column of each state and input in ``[x, u]``."""
    names = {signal.name: i for i, signal in enumerate((*prior.states, *prior.inputs))}
    unknown = {factor.signal for term in library.terms for factor in term} - set(names)
    if unknown or not library.terms:
        what = f"names no signal {', '.join(sorted(unknown))}" if unknown else "has no term"
        raise InputError(
            f"library {library.name} {what}; {type(prior).__name__} has: {', '.join(names)}"
            " [HM-SCENARIOS-034]"
        )
    return names


def machine_libraries(prior: MechanicalPrior) -> tuple[Library, ...]:
    """Libraries for machines that turn or slide: polynomials, trigonometric terms, and friction of several slopes.

    With q, v, u of each axis: ``polynomial`` has all monomials of [q, v] up to degree 3 (an angle that turns is left
    out) and u; ``trigonometric`` has 1, sin q, cos q, v, v², v abs(v), u, u cos q; ``friction_20`` has those and
    ``tanh(20 v)`` alone and times cos q, abs(cos q) and v², which is the golf robot's friction where its load keeps
    its sign. Axes meet in the polynomials only: coupled ones need a library of their own.
    """
    n_q = prior.n_q
    q, v = prior.states[:n_q], [s.name for s in prior.states[n_q : 2 * n_q]]
    u = [s.name for s in prior.inputs]
    torque = [(Factor(j),) for j in u]
    variables = [s.name for s in q if not s.periodic] + v
    powers = [
        tuple(Factor(name, power=chosen.count(name)) for name in dict.fromkeys(chosen))
        for degree in range(DEGREE + 1)
        for chosen in combinations_with_replacement(variables, degree)
    ]
    sine: list[Term] = [()]
    for position, speed in zip(q, v, strict=True):
        sine += [(Factor(position.name, "sin"),), (Factor(position.name, "cos"),), (Factor(speed),)]
        sine += [(Factor(speed, power=2),), (Factor(speed), Factor(speed, "abs"))]
    sine += torque + [(Factor(j), Factor(position.name, "cos")) for j in u for position in q]
    libraries = [Library("polynomial", (*powers, *torque)), Library("trigonometric", tuple(sine))]
    for gamma in STEEPNESS:
        rubbing: list[Term] = []
        for position, speed in zip(q, v, strict=True):
            sign = Factor(speed, "tanh", gamma)
            loads = (Factor(position.name, "cos"), Factor(position.name, "abs_cos"), Factor(speed, power=2))
            rubbing += [(sign,), *((sign, load) for load in loads)]
        libraries.append(Library(f"friction_{gamma:g}", (*sine, *rubbing)))
    return tuple(libraries)


Array = NDArray[np.float64]
Target = Literal["mean_rate", "derivative"]
THRESHOLDS = (0.0, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1)
"""Shares of the acceleration's root mean square below which a term is dropped."""
SAME = 0.02, 1e-3
"""Validation errors this share of the best, or of the mean ``|xdot|_1``, above the best count as equal to it."""

ALIKE = 1e-10
"""Columns whose cosine is this near to 1 are one: no data of a machine tell them apart, and rounding is 1e-16."""


def fit_sindy(
    training: Sequence[Trajectory],
    prior: MechanicalPrior,
    dt: float,
    *,
    validation: Sequence[Trajectory],
    libraries: Sequence[Library] | None = None,
    thresholds: Sequence[float] = THRESHOLDS,
    target: Target = "mean_rate",
    warm: int = 0,
    ridge: float = 1e-5,
) -> SindyStep:
    """Identify the accelerations as sparse sums of candidate terms; kinematics are exact.

    The runs are stacked, each with its own inputs. Every library is fitted with every threshold by pysindy's
    sequentially thresholded least squares, on columns scaled to a root mean square of 1. The free runs over the
    validation trajectories choose among all of them: of those that are as good as the best (``SAME``) the one of
    fewest terms. A candidate that diverges or is too stiff has an infinite error and stays in ``step.candidates``.
    If all of them are, the one that fits the training data best is returned with its infinite error.

    ``validation`` alone chooses library and threshold; take
    :func:`~hybrid_mpc.identify.evaluate.evaluation_trajectories` of noisy ones. ``target`` is what is regressed:
    ``"mean_rate"``, the acceleration's mean over each period against the terms' mean over it with the input held
    (Simpson's rule, the state between two samples from the cubic through both), or ``"derivative"``, the recorded
    derivative at the samples. ``ridge`` is a share of the columns' squares while terms are dropped: it keeps two terms
    that are nearly one from growing against each other. The terms that stay are fitted without it.

    Source: Brunton, Proctor, Kutz, *Sparse identification of nonlinear dynamics with control (SINDYc)*, IFAC
    NOLCOS (2016); de Silva et al., *PySINDy*, Journal of Open Source Software 5 (2020).
    """
    pysindy = _pysindy()
    _check(training, validation, prior, dt)
    if target not in get_args(Target):
        raise InputError(
            f"target has no {target!r}; there are: {', '.join(get_args(Target))} [HM-SCENARIOS-035]"
        )
    if not thresholds or min(thresholds) < 0.0:
        raise InputError(
            f"thresholds must be at least one number, none below 0, got {tuple(thresholds)}"
            " [HM-SCENARIOS-036]"
        )
    windows = cut_windows(training, 0, 1, 1)
    if target == "derivative":
        check_rates(training)
    fits: list[_Fit] = []
    for library in libraries or machine_libraries(prior):
        theta, rate = _regression(library, prior, windows, dt, target)
        found = _sparse(pysindy, theta, rate, thresholds, ridge)
        fits += _scored(prior, library, found, validation, dt, warm)
    best = _choice(fits, validation)
    return _pruned(prior, best, dt, tuple(fit.candidate for fit in fits))


@dataclass(frozen=True)
class _Fit:
    """A candidate with what makes it a model."""

    candidate: SindyCandidate
    library: Library
    coefficients: Array
    substeps: int


def _regression(
    library: Library, prior: MechanicalPrior, windows: Windows, dt: float, target: Target
) -> tuple[Array, Array]:
    """Terms ``(n, n_terms)`` and accelerations ``(n, n_q)`` of all periods of all runs."""
    names, n_q = signal_names(prior, library), prior.n_q
    x, x_next, u = windows.x[:, 0], windows.x[:, 1], windows.u[:, 0]
    if target == "derivative":
        return evaluate(library, names, x, u).numpy(), windows.xdot[:, 0, n_q : 2 * n_q].numpy()
    (q, v), (q_next, v_next) = (z.split(n_q, dim=-1) for z in (x, x_next))
    middle = torch.cat(
        [0.5 * (q + q_next) - dt / 8.0 * (v_next - v), 1.5 / dt * (q_next - q) - 0.25 * (v + v_next)], -1
    )
    first, half, last = (evaluate(library, names, z, u) for z in (x, middle, x_next))
    return ((first + 4.0 * half + last) / 6.0).numpy(), ((v_next - v) / dt).numpy()


def _sparse(
    pysindy: Any, theta: Array, rate: Array, thresholds: Sequence[float], ridge: float
) -> list[tuple[float, Array, float]]:
    """Threshold, coefficients ``(n_terms, n_q)`` [SI] and training error of each fit that differs from the others."""
    scale, size = _rms(theta), _rms(rate)
    columns = _distinct(theta / scale)
    found: dict[bytes, tuple[float, Array, float]] = {}
    for threshold in thresholds:
        optimizer = pysindy.STLSQ(threshold=threshold, alpha=ridge * len(theta))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that a threshold leaves nothing: its free run will tell
            optimizer.fit((theta / scale)[:, columns], rate / size)
        coefficients = np.zeros((theta.shape[1], rate.shape[1]))
        coefficients[columns] = np.asarray(optimizer.coef_).T / scale[columns, None] * size
        error = float(np.abs(theta @ coefficients - rate).mean())
        found.setdefault((coefficients != 0).tobytes(), (float(threshold), coefficients, error))
    return list(found.values())


def _scored(
    prior: MechanicalPrior,
    library: Library,
    found: list[tuple[float, Array, float]],
    validation: Sequence[Trajectory],
    dt: float,
    warm: int,
) -> list[_Fit]:
    """E_sim of each fit's validation free runs; those of one library run at once."""
    substeps = []
    for _, coefficients, _ in found:
        try:
            substeps.append(SindyStep(prior, library, torch.tensor(coefficients), dt).substeps)
        except InputError:  # too stiff
            substeps.append(0)
    stable = [i for i, n in enumerate(substeps) if n]
    errors = np.full(len(found), np.inf)
    if stable:
        stacked = torch.tensor(np.repeat([found[i][1] for i in stable], len(validation), axis=0))
        step = SindyStep(prior, library, stacked, dt, max(substeps))
        with np.errstate(over="ignore", invalid="ignore"):  # a run that diverges is scored as infinite
            runs = free_runs(step, prior, list(validation) * len(stable), warm)
            for k, i in enumerate(stable):
                errors[i] = figures_of(runs[k * len(validation) : (k + 1) * len(validation)])["e_sim_s"]
    return [
        _Fit(
            SindyCandidate(library.name, threshold, int(np.count_nonzero(c)), error, float(errors[i])),
            library,
            c,
            max(substeps) or MAX_SUBSTEPS,
        )
        for i, (threshold, c, error) in enumerate(found)
    ]


def _choice(fits: list[_Fit], validation: Sequence[Trajectory]) -> _Fit:
    """The fewest terms among those as good as the best on validation; if none runs, the best on training data."""
    least = min(fit.candidate.validation for fit in fits)
    if not np.isfinite(least):
        return min(fits, key=lambda fit: fit.candidate.training)
    size = np.mean([np.abs(np.diff(t.x, axis=0)).sum(1).mean() / t.dt for t in validation])
    equal = [fit for fit in fits if fit.candidate.validation <= least + max(SAME[0] * least, SAME[1] * size)]
    return min(equal, key=lambda fit: (fit.candidate.terms, fit.candidate.validation))


def _pruned(
    prior: MechanicalPrior, fit: _Fit, dt: float, candidates: tuple[SindyCandidate, ...]
) -> SindyStep:
    """The step without the terms that no acceleration has."""
    keep = np.flatnonzero((fit.coefficients != 0).any(axis=1))
    keep = keep if len(keep) else np.zeros(1, dtype=int)  # nothing was left: the acceleration is zero
    library = Library(fit.library.name, tuple(fit.library.terms[i] for i in keep))
    return SindyStep(prior, library, torch.tensor(fit.coefficients[keep]), dt, fit.substeps, candidates)


def _distinct(scaled: Array) -> NDArray[np.intp]:
    """Columns that are no multiple of an earlier one, such as abs(cos q) where no run goes beyond a right angle."""
    alike = np.abs(scaled.T @ scaled) / len(scaled) > 1.0 - ALIKE
    keep: list[int] = []
    for j in range(scaled.shape[1]):
        if not alike[j, keep].any():
            keep.append(j)
    return np.array(keep)


def _rms(values: Array) -> Array:
    size: Array = np.sqrt((values**2).mean(axis=0))
    return np.where(size > 0.0, size, 1.0)


def _check(
    training: Sequence[Trajectory], validation: Sequence[Trajectory], prior: MechanicalPrior, dt: float
) -> None:
    if not training or not validation:
        raise InputError(
            "SINDy: give at least one training trajectory and one validation trajectory [HM-SCENARIOS-037]"
        )
    sizes = {"x": len(prior.states), "u": len(prior.inputs)}
    for trajectory in (*training, *validation):
        for name, size in sizes.items():
            columns = getattr(trajectory, name).shape[1]
            if columns != size:
                raise InputError(
                    f"{trajectory.name}: {name} has {columns} columns, {type(prior).__name__} has {size}"
                    " [HM-SCENARIOS-038]"
                )
        if abs(trajectory.dt - dt) > 1e-9 * dt:
            raise InputError(
                f"{trajectory.name}: its period is {trajectory.dt} s, the model's {dt} s; resample it"
                " [HM-SCENARIOS-039]"
            )
    for j, signal in enumerate(prior.inputs):
        u = np.concatenate([t.u[:, j] for t in training])
        if np.ptp(u) == 0.0:
            raise InputError(
                f"input {signal.name}: constant ({u[0]:g} {signal.unit}) in all training runs, so its effect is "
                "unknown. Record runs that excite it [HM-SCENARIOS-040]"
            )


def _pysindy() -> Any:
    try:
        return importlib.import_module("pysindy")
    except ImportError as missing:
        raise InputError(
            "SINDy needs pysindy, which is not installed: pip install 'hybrid-mpc[sindy]' [HM-SCENARIOS-041]"
        ) from missing
