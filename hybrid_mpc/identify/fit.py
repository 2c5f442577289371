"""Fit of a prior to measured outputs: multiple shooting with free first states, exact derivatives, a robust loss.

Recordings are cut into windows. The state at the start of each is an unknown that is eliminated from every
Gauss-Newton step, so that no measured state is taken for exact and states that no sensor sees need no measurement.
All windows and all directions are one batch of array operations (:mod:`~hybrid_mpc.identify.simulation`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Literal, Protocol, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.stats import qmc

from hybrid_mpc.data import scales
from hybrid_mpc.data.scales import evenly, robust_spread, within
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.identify.delay import NONE, shifted
from hybrid_mpc.identify.prior_result import ENOUGH, PREDICTIONS, Combination, PriorFit, winner
from hybrid_mpc.identify.simulation import (
    MAX_SUBSTEPS,
    Points,
    Simulation,
    flow_slope,
    growth_rate,
    required_substeps,
    rest_of,
    simulation_of,
    visited,
    with_unknown_rates,
)
from hybrid_mpc.identify.smooth import Smoother, fit_smoother, output_slope, rough_smoother, unseen_states
from hybrid_mpc.machine.prior import Equations, Prior
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.model.riccati import dare

Array = NDArray[np.float64]
LENGTHS = (0.5, 2.0, 5.0)
"""Lengths of the windows [the machine's seconds, :func:`~hybrid_mpc.data.scales.time_unit`], one after the other: short
ones have one optimum, long ones are what counts."""
FARTHEST = 3.0
"""Length of the longest windows at most, over the time in which small errors grow a hundredfold: first states would be
lost in rounding, and no digit of them would be found."""
APART = 4.0
"""Ratio of one length to the next at most."""
SLOWEST = 3.0
"""Length of the longest windows, over the largest time constant of the nominal prior."""
WINDOWS = 100
"""Windows of a length at most, evenly chosen. Where a prior lacks something, its parameters depend on which parts of
the recordings are fitted: with half of them errors on held-out recordings scatter by a tenth."""
FEW = 24
"""The same where starts are compared, where a delay is looked for, and of predictions."""
ITERATIONS = 25
"""Gauss-Newton steps of a length at most."""
FIRST = 4
"""Steps at most before outputs and outliers are weighed by what is left of them."""
STARTS = 6
"""Starts between the bounds that are tried over the shortest windows, beside the nominal values."""
START_ITERATIONS = 6
"""Gauss-Newton steps from each start before the best is taken on."""
POOR = 0.3
"""What is left of the outputs' spread from which on the longest windows are fitted from every start."""
FOLLOWED = 3
"""Starts at most that are followed from one length to the next, where the best alone may be a wrong optimum."""
PROMISING = 1.5
"""Ratio to the least error up to which another start is followed."""
DISTINCT, FACTOR = 0.1, 3.0
"""Share of a parameter's half range, or this many times that share of its value, by which starts that are followed
differ in one of them at least."""
GROWN = 10.0, 100.0
"""Growth of a small error over the two shortest windows of a machine that runs away."""
AWAY = 10.0
"""Time in which small errors grow a hundredfold, over the longest windows, up to which each length's fit smooths the
recordings anew: there the nominal prior's states are no start for longer windows."""
WHOLE = 1.2
"""Ratio of the longest recording to the windows before from which on whole recordings are fitted, where it pays."""
LONGEST = 20_000
"""Periods of a whole recording at most: longer ones are cut."""
QUIET = 3.0
"""Ratio of what is left to the sensors' noise up to which windows grow on beyond that."""
LOOSELY = 1e-2
"""Weight of a first state's distance from its guess, over its size, beside errors that are counted in spreads: a guess
by the nominal prior is far off where that is, and errors are a small share of the spread once first states fit."""
ROUNDING = 1e-12
"""Share that is added to the diagonal of the normal equations: first states that act alike stay solvable."""
STEEP = 1e8
"""Slopes beyond this many spreads of an output per size of a first state or parameter do not count: a run diverges."""
LOOSE = 30.0
"""Half ranges from its nominal value that cost a parameter as much as a single error of one standard deviation: what
the data tell moves by a thousandth of its standard error at most, what they do not tell stays."""
UNTOLD = 1.0
"""Standard error, in half ranges, from which on a combination of parameters counts as not told by the data."""
PUNCTUAL = 0.01
"""Share of a period by which one trajectory may begin late or early to be the next part of another."""
COMPARED_SAMPLES = 1000
"""First samples by which trajectories of the same length are put in order."""
CLUSTERS = 48
"""Parts of the windows at least whose scatter tells the standard errors."""
SHIFT, EXACT = 0.2, 1e-5
"""Shift of a parameter by half as long integration steps that is small enough: standard errors, and share of it."""
OUTLIERS = 3.0
"""Residuals beyond this many robust standard deviations count by their size, not by its square."""
COMMON = 0.7
"""Least robust standard deviation of an output's errors, over their root mean square without gross outliers: where a
prior is far off for a part of the time, that part is no outlier."""
GROSS = 10.0
"""Residuals beyond this many are no measurements at the end of a fit; what they weigh before would bias it."""
SCALINGS = 4
"""Times at most that outputs are weighed by what is left of them: outliers hide how little that is."""
SETTLED = 0.8
"""Share to which what is left must fall for another time."""
FAR = 3.0
"""Errors beyond this many spreads of the data are as bad as this one where candidates are compared."""
LARGEST = 1e3
"""Residuals beyond this many spreads of the data count as much: a free run that diverges stays finite."""
COMPARED = 10
"""Steps at most of the first states alone, where candidates are compared."""
FOLLOWING = 4
"""Steps at most of the first states after ``theta``, where it would be rejected without."""
ALIKE = 1e-3
"""They end when none takes off more than this share of a candidate's cost."""
DAMPING, WORST = 1e-3, 1e9
"""First damping of a step, and the one with which steps are given up."""
CONVERGED = 0.01
"""A step that takes off less than this share of a window's mean cost is the last of a fit: what would come after it is
far less than a standard error."""
CLOSELY = 1e-4
"""The same share at the end of a fit: steps along a narrow valley are short."""
SETTLING, DIGITS, SAME = 12, 1e-9, 1e-9
"""Steps at most at the end of a fit, which end where none moves a parameter by more than this share of its half range;
and the share by which rounding may raise the cost there."""
SHARES = 1.0, 0.5, 0.2, 0.05
"""Shares of such a step, of which the first that does not raise the cost is taken."""
AT_BOUND = 1e-3
"""Share of its range within which a parameter counts as at its bound."""
BEYOND = 0.05
"""Share of a state's own span by which it may leave its range: a smoother overshoots."""
HARDLY = 0.98
"""Share of the nominal values' error from which on a fit counts as none."""
LATE = 4.0
"""Longest delay of the inputs [model periods] that is looked for where none is fitted."""
SHORTEST = 0.01
"""Shortest delay that is told of [periods]. Exact data leave the integrator's error alone; a delay of 4e-5 periods
explained four fifths of that."""
TELLING = 0.9
"""Share of the error, of training and of validation, to which such a delay must bring it to be told; it must be twice
its standard error, too."""
HOPELESS = 0.98
"""Share of the error that a linear step with a delay must get below, over one without, for a delay to be fitted."""
PREDICTION_STEPS = 12
"""Gauss-Newton steps of a fit of predictions at most; it starts near its end."""
FORGETS = 2.0
"""Length of the windows of predictions [the machine's seconds]: an observer forgets where it began."""
GAIN = 1e3
"""Largest element of an observer's gain [sizes of a state a spread of an output]."""
QUIETLY = 0.01
"""Least noise of sensors and states that an observer's first gain counts with, over their spread and their size."""
PAST, ANSWERS = 10, 3
"""Samples of an input's own past, and of prediction errors, that are asked for feedback."""
MEMORY = 200
"""Lags up to which series are asked how far they hang together."""
CHANCE = 4.0
"""Standard deviations of a correlation by chance that count as 1: of some dozen, one in a thousand is larger."""
ROUNDED = 1e-11
"""Ratio of singular values of the slopes below which they are rounding errors."""
ALIKE_WEIGHTS = 0.8
"""Ratio of the weights from which on parameters of one unit are taken to add up, instead of to multiply."""
INVOLVED = 0.2
"""Share of the largest from which on a parameter counts as a part of a combination."""
Progress = Callable[[int, int, str], None]
Slopes: TypeAlias = Literal["", "x", "all"]
"""Which derivatives are asked for: none, by the first states, by the parameters too."""


@dataclass(frozen=True)
class FirstStates:
    """What is known of the first states of a fit's free runs.

    Args:
        kind: ``"free"``: nothing, they are found with the parameters. ``"known"``: ``values`` are those of a
            trajectory's own first sample, for example of a machine that rests before it is started; the others are
            free. ``"measured"``: outputs that are states, by their names, are exact wherever a run starts; the others
            are free.
            ``"shared"``: all trajectories start from one state, which is free. ``"warm_up"``: a run's first ``seconds``
            alone tell its first state, and what follows alone counts, as where models are evaluated.
        values: Values [their units] of the states that are known, by name.
        seconds: Length [s] of the warm-up.

    Raises:
        InputError: If ``values`` or ``seconds`` do not belong to the kind, or are missing.

    Example:
        >>> FirstStates("known", {"phi_dot": 0.0}).values
        {'phi_dot': 0.0}
    """

    kind: Literal["free", "known", "measured", "shared", "warm_up"] = "free"
    values: Mapping[str, float] = field(default_factory=dict)
    seconds: float = 0.0

    def __post_init__(self) -> None:
        problems = []
        if self.kind not in (kinds := ("free", "known", "measured", "shared", "warm_up")):
            problems.append(f"first states: kind must be one of {', '.join(kinds)}, got {self.kind!r}")
        if (self.kind == "known") != bool(self.values):
            problems.append(
                f"first states: values by name belong to kind 'known' and to it alone, got {self.values}"
            )
        if not all(math.isfinite(value) for value in self.values.values()):
            problems.append(f"first states: values must be finite, got {self.values}")
        if (self.kind == "warm_up") != (0 < self.seconds < math.inf):
            problems.append(
                f"first states: a positive length [s] belongs to kind 'warm_up' and to it alone, got {self.seconds}"
            )
        refuse(problems)

    def samples(self, dt: float) -> int:
        """Samples of the warm-up, none without."""
        return scales.periods(self.seconds, dt, 2) if self.kind == "warm_up" else 0

    def check(self, prior: Prior, largest_delay: float) -> None:
        """Refuse what does not fit to a prior.

        Raises:
            InputError: With all that does not.
        """
        names, outputs = ([s.name for s in signals] for signals in (prior.states, prior.outputs))
        problems = [
            f"first states: {name!r} is no state of {type(prior).__name__} ({', '.join(names)})"
            for name in self.values
            if name not in names
        ]
        if self.kind == "measured" and not set(names) & set(outputs):
            problems.append(
                f"first states: no output of {type(prior).__name__} ({', '.join(outputs)}) is a state "
                f"({', '.join(names)}); leave them free"
            )
        if self.kind in ("known", "shared") and largest_delay:
            problems.append(
                f"first states: a delay costs the first samples of a trajectory, whose state is {self.kind}; leave "
                "largest_delay 0, or the first states free"
            )
        refuse(problems)


FREE = FirstStates()


@dataclass(frozen=True)
class OutputWindows:
    """Windows of recordings: ``y`` ``(n, T + 1, n_y)`` with NaN where nothing was measured, ``u`` ``(n, lead + T + 1,
    n_u)``, of which the first ``lead`` come before the window, ``w`` ``(n, T + 1, n_w)``, a guess ``x`` ``(n, n_x)`` of
    the first state, and which samples are censored ``(n, T + 1, n_y)``.

    Of the first states ``known`` ``(n, n_x)`` are as guessed. Windows of one group ``(n,)`` begin in the same state. Of
    a window the first ``warm`` samples alone tell its first state, and the others count; 0: all do both.
    """

    y: Array
    u: Array
    w: Array
    x: Array
    censored: Array
    lead: int
    known: NDArray[np.bool_]
    group: NDArray[np.int_]
    warm: int = 0

    def beginning(self, periods: int) -> OutputWindows:
        """The first so many periods of each."""
        y, w, censored = (v[:, : periods + 1] for v in (self.y, self.w, self.censored))
        return replace(self, y=y, u=self.u[:, : self.lead + periods + 1], w=w, censored=censored)

    def times(self, n: int) -> OutputWindows:
        """The same windows, ``n`` times one behind the other."""
        y, u, w, x, censored, known = (
            np.concatenate([v] * n) for v in (self.y, self.u, self.w, self.x, self.censored, self.known)
        )
        group = np.concatenate([self.group + i * (self.group.max() + 1) for i in range(n)])
        return OutputWindows(y, u, w, x, censored, self.lead, known, group, self.warm)


def cut_outputs(
    trajectories: Sequence[Trajectory],
    periods: int | None,
    lead: int,
    most: int,
    states: Sequence[Signal] = (),
    outputs: Sequence[Signal] = (),
    first: FirstStates = FREE,
) -> OutputWindows:
    """At most ``most`` windows of ``periods``, one behind the other, evenly chosen; or whole trajectories.

    Whole ones are cut where they are longer than ``LONGEST``, and filled up with missing samples to the longest.
    First states are guessed within the ranges of ``states``. Default: as the trajectories have them. What is known of
    them by their names, and by those of the ``outputs``, says ``first``; it needs ``states``.

    Raises:
        InputError: If no trajectory is long enough.
    """
    if periods is None:
        periods = min(LONGEST, _longest(trajectories) - lead - 1)
        chosen = [(t, k) for t in trajectories for k in range(lead, len(t.t) - 2, periods)]
    else:
        starts = [(t, k) for t in trajectories for k in range(lead, len(t.t) - periods, periods)]
        if not starts:
            longest = _longest(trajectories)
            raise InputError(
                f"no recording is long enough: the longest has {longest} samples, a free run of {periods} periods with "
                f"{lead} samples before it needs {periods + lead + 1}"
            )
        chosen = [starts[i] for i in evenly(len(starts), most)]
        if first.kind in ("known", "shared"):  # what is known is known of a recording's own first sample
            begins = [one for one in starts if one[1] == 0][:most]
            others = [one for one in starts if one[1] > 0]
            chosen = begins + [others[i] for i in evenly(len(others), most - len(begins))]

    def cut(key: str, before: int) -> Array:
        found = []
        for t, k in chosen:
            part = getattr(t, key)[k - before : k + periods + 1]
            more = before + periods + 1 - len(part)
            fill = (
                np.full((more, part.shape[1]), np.nan) if key == "y" else np.repeat(part[-1:], more, axis=0)
            )
            found.append(np.concatenate([part, fill]) if more else part)
        return np.stack(found)

    guesses = np.stack([t.x[k] for t, k in chosen])
    if states:
        guesses = np.clip(guesses, [s.lower for s in states], [s.upper for s in states])
    y, n = cut("y", 0), len(chosen)
    known, group = np.zeros(guesses.shape, dtype=bool), np.arange(n)
    begin = np.array([k == 0 for _, k in chosen])
    if first.kind == "shared" and begin.any():
        group[begin] = int(np.flatnonzero(begin)[0])
        guesses[begin] = guesses[begin].mean(axis=0)
        group = np.unique(group, return_inverse=True)[1]
    for j, state in enumerate(states):
        if first.kind == "known" and state.name in first.values:
            known[begin, j], guesses[begin, j] = True, first.values[state.name]
        for i, output in enumerate(outputs):
            if first.kind == "measured" and output.name == state.name:
                there = np.isfinite(y[:, 0, i])
                known[there, j], guesses[there, j] = True, y[there, 0, i]
    return OutputWindows(
        y, cut("u", lead), cut("w", 0), guesses,
        cut("censored", 0), lead, known, group,
        min(first.samples(trajectories[0].dt), periods - 1),
    )  # fmt: skip


class OutputFit:
    """A prior's free parameters and its input's delay ``theta``, each over its size, and their fit to windows.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        dt: Model period [s].
        largest_delay: Longest delay [s] of the inputs. Default 0: it is not fitted.
    """

    def __init__(self, make: Callable[..., Prior], dt: float, largest_delay: float = 0.0) -> None:
        self.make, self.prior, self.dt, self.largest = make, make(), dt, largest_delay
        self.free = [p for p in self.prior.parameters if not p.fixed]
        late = [dt] if largest_delay else []
        own = [abs(p.value) if p.value else (p.upper - p.lower) for p in self.free]
        self.unit = np.array([*own, *late])
        self._simulations: dict[tuple[int, ...], Simulation] = {}
        self.points: Points | None = None
        """Where the recordings go, once their states are known."""
        self.least = 1
        """Sub-steps a period at least."""
        self.nominal = (
            np.array([*(p.value for p in self.free), *(0.5 * largest_delay for _ in late)]) / self.unit
        )
        self.lower = np.array([*(p.lower for p in self.free), *(0.0 for _ in late)]) / self.unit
        self.upper = np.array([*(p.upper for p in self.free), *(largest_delay for _ in late)]) / self.unit

    def with_delay(self, largest: float) -> OutputFit:
        """The same fit, of a delay of up to ``largest`` [s], too."""
        other = OutputFit(self.make, self.dt, largest)
        other._simulations, other.points, other.least = self._simulations, self.points, self.least
        return other

    @property
    def half(self) -> Array:
        """Half ranges of ``theta``."""
        return 0.5 * (self.upper - self.lower)

    @property
    def pull(self) -> Array:
        """Root of the weights that hold ``theta`` at the nominal values."""
        return 1.0 / (LOOSE * self.half)

    @property
    def names(self) -> list[str]:
        """Names of what is fitted."""
        return [*(p.name for p in self.free), *(["delay"] if self.largest else [])]

    @property
    def lead(self) -> int:
        """Samples before a window that its delayed inputs may need."""
        return math.ceil(self.largest / self.dt) + 1 if self.largest else 0

    def values(self, theta: Array) -> dict[str, float]:
        """Values [their units] of all parameters by name, fixed ones included."""
        fitted = {p.name: float(v) for p, v in zip(self.free, theta * self.unit, strict=False)}
        return {**self.prior.values, **fitted}

    def scaled(self, values: Mapping[str, float], delay: float = 0.0) -> Array:
        """Values [their units] by name, and the delay [s], as ``theta``."""
        own = [values[p.name] for p in self.free]
        return np.array([*own, *([delay] if self.largest else [])]) / self.unit

    def delay(self, theta: Array) -> float:
        """Delay [s]; none where it is too short to count."""
        found = float(theta[-1] * self.unit[-1]) if self.largest else 0.0
        return found if found >= NONE * self.dt else 0.0

    def substeps(self, theta: Array) -> int:
        """Sub-steps a period that the stiffness at ``theta`` asks for, at rest and where the recordings go."""
        return max(self.least, required_substeps(self.make(self.values(theta)), self.dt, self.points))

    def most_substeps(self, thetas: Array) -> int:
        """As many as the stiffest of several ``thetas`` ``(m, k)`` needs."""
        return max(self.substeps(one) for one in thetas)

    def reach(self, theta: Array) -> float:
        """Time [s] over which a small error grows by the larger of ``GROWN`` at ``theta``, where the recordings go."""
        rate = 0.0 if self.points is None else growth_rate(self.make(self.values(theta)), self.points)
        return math.log(GROWN[-1]) / rate if rate > 0 else math.inf

    def outputs(
        self, theta: Array, x: Array, windows: OutputWindows, substeps: int, slopes: Slopes
    ) -> tuple[Array, Array]:
        """Outputs ``(n, T + 1, n_y)`` of free runs from ``x``, and their derivatives ``(n, T + 1, n_y, columns)``.

        Columns are those by ``theta`` and, behind these, by ``x``; by ``x`` alone; or none (``slopes``). Several
        ``theta`` ``(m, k)`` share the windows evenly, the first ones to the first.
        """
        thetas, n = np.atleast_2d(theta), len(x)
        each = n // len(thetas)
        p = np.repeat(self._every(thetas), each, axis=0)
        acting = [self._acting(one, windows.u[i * each :][:each], windows) for i, one in enumerate(thetas)]
        simulation = self._simulation(tuple(self._free) if slopes == "all" else ())
        given = x, np.concatenate(acting), windows.w, p, substeps
        if not slopes:
            return simulation.values(*given), np.zeros(0)
        y, by = simulation.by_all(*given)
        if slopes == "all":
            with np.errstate(over="ignore"):  # what runs away is left out where it is used
                by[..., : len(self.unit)] *= self.unit
        return y, by

    def _every(self, thetas: Array) -> list[list[float]]:
        """What a simulation has as its parameters with each of several ``thetas``."""
        return [self._constants(one) for one in thetas]

    def _constants(self, theta: Array) -> list[float]:
        """What a simulation has as its parameters: the prior's, and a small change of the delay."""
        return [*self.values(theta).values(), 0.0]

    @cached_property
    def _free(self) -> list[int]:
        """Places of what is fitted in :meth:`_constants`."""
        every = [*(p.name for p in self.prior.parameters), "delay"]
        return [every.index(name) for name in self.names]

    def _simulation(self, free: tuple[int, ...]) -> Simulation:
        if free not in self._simulations:
            xdot, output = (_delayed(f) for f in (self.prior.equations.xdot, self.prior.equations.output))
            self._simulations[free] = Simulation(xdot, self.dt, free, output)
        return self._simulations[free]

    def _acting(self, theta: Array, commanded: Array, windows: OutputWindows) -> Array:
        """Inputs ``(n, T + 1, 2 n_u)`` that act, means over each period, and their derivative by the delay."""
        n, first = windows.y.shape[1], windows.lead
        if not self.largest:
            u = commanded[:, first : first + n]
            return np.concatenate([u, np.zeros_like(u)], axis=-1)
        delay = float(theta[-1] * self.unit[-1]) / self.dt
        whole = min(math.floor(delay), first - 1)
        younger, older = (commanded[:, first - whole - k : first - whole - k + n] for k in (0, 1))
        share = delay - whole
        return np.concatenate([(1 - share) * younger + share * older, (older - younger) / self.dt], axis=-1)


class PredictionFit(OutputFit):
    """The same parameters beside the gain of an observer: predictions one period ahead instead of free runs.

    ``z+ = f(z + K (y - g(x, u)), u)`` with ``z = (x, d)``, of which ``d`` are the unknown rates of the states that the
    prior has corrected; ``theta`` has ``K`` ``(n_z, n_y)`` behind the parameters. The delay stays: inputs are those
    that act.

    Args:
        fit: The fit of free runs.
        smoother: Of a fitted prior. Its filter at rest has the first ``K``.
    """

    def __init__(self, fit: OutputFit, smoother: Smoother) -> None:
        super().__init__(fit.make, fit.dt)
        self.points, self.least, self.n = fit.points, fit.least, len(self.unit)
        self._corrected = smoother.prior.corrected
        self.sizes = np.concatenate([smoother.sizes.x, np.array(smoother.sizes.rate)[list(self._corrected)]])
        unit = np.outer(self.sizes, 1.0 / np.array(smoother.sizes.y)).ravel()
        self._gains = [f"gain {i}" for i in range(len(unit))]
        self.unit = np.concatenate([self.unit, unit])
        first = np.clip(_gain_at_rest(smoother, self.sizes).ravel() / unit, -GAIN, GAIN)
        self.nominal = np.concatenate([self.nominal, first])
        self.lower, self.upper = (
            np.concatenate([own, np.full(len(unit), limit)])
            for own, limit in ((self.lower, -GAIN), (self.upper, GAIN))
        )

    @property
    def names(self) -> list[str]:
        """Names of what is fitted."""
        return [*super().names, *self._gains]

    def of(self, windows: OutputWindows) -> OutputWindows:
        """Windows with first states ``z``, of which ``d`` begins at zero."""
        more = np.zeros((len(windows.x), len(self._corrected)))
        known = np.concatenate([windows.known, more > 0], axis=1)
        return replace(windows, x=np.concatenate([windows.x, more], axis=1), known=known)

    def _constants(self, theta: Array) -> list[float]:
        return [*super()._constants(theta), *(theta * self.unit)[self.n :].tolist()]

    @cached_property
    def _free(self) -> list[int]:
        every = [*(p.name for p in self.prior.parameters), "delay", *self._gains]
        return [every.index(name) for name in self.names]

    def _simulation(self, free: tuple[int, ...]) -> Simulation:
        if free not in self._simulations:
            xdot, output, correct = _observed(self.prior.equations, self._corrected)
            self._simulations[free] = Simulation(xdot, self.dt, free, output, correct)
        return self._simulations[free]

    def _acting(self, theta: Array, commanded: Array, windows: OutputWindows) -> Array:
        there = np.isfinite(windows.y)
        acting = super()._acting(theta, commanded, windows)
        return np.concatenate([acting, np.where(there, windows.y, 0.0), there], axis=-1)


@lru_cache(maxsize=32)
def _observed(
    equations: Equations, corrected: tuple[int, ...]
) -> tuple[ca.Function, ca.Function, ca.Function]:
    """Rates and outputs of ``z``, and ``z`` corrected by a measurement, as functions ``(z, u, w, p)``.

    Inputs are ``[u, slope by the delay, y, whether it is there]``, parameters ``[p, change of the delay, K]``.
    """
    rates, late = _delayed(with_unknown_rates(equations.xdot, corrected)), _delayed(equations.output)
    n_y, n_z, n_x = late.size1_out(0), rates.size1_in(0), late.size1_in(0)
    z, u, w, p = (ca.SX.sym(rates.name_in(i), rates.size1_in(i)) for i in range(4))
    y, there, gain = ca.SX.sym("y", n_y), ca.SX.sym("there", n_y), ca.SX.sym("K", n_z * n_y)
    given = [z, ca.vertcat(u, y, there), w, ca.vertcat(p, gain)]
    shown = late(z[:n_x], u, w, p)
    corrected_z = z + ca.reshape(gain, n_y, n_z).T @ (there * (y - shown))
    values = {"rates": rates(z, u, w, p), "shown": shown, "corrected": corrected_z}
    found = [ca.Function(name, given, [value]) for name, value in values.items()]
    return found[0], found[1], found[2]


def _gain_at_rest(smoother: Smoother, sizes: Array) -> Array:
    """Gain ``(n_z, n_y)`` of a smoother's filter at rest; none where the outputs do not tell of all states there."""
    prior, n_x = smoother.prior, len(smoother.prior.states)
    x, u, w = rest_of(prior)
    z = np.concatenate([x, np.zeros(len(prior.corrected))])
    a = expm(
        flow_slope(with_unknown_rates(prior.equations.xdot, prior.corrected))(z, u, w, prior.p).full()
        * smoother.dt
    )
    c = np.zeros((len(smoother.sigma), len(z)))
    c[:, :n_x] = output_slope(prior.equations)(x, u, w, prior.p)[1].full()
    walk = np.concatenate([QUIETLY * sizes[:n_x], smoother.walk]) / sizes
    spread = np.array(smoother.sizes.y)
    c, a = c * sizes / spread[:, None], a * sizes / sizes[:, None]
    noise = np.diag(np.square(np.maximum(smoother.sigma / spread, QUIETLY)))
    try:
        p, _ = dare(a.T, c.T, np.diag(np.square(np.maximum(walk, QUIETLY * smoother.dt))), noise)
    except InputError:  # the fit finds one by itself
        return np.zeros((len(z), len(spread)))
    return np.asarray(np.linalg.solve(c @ p @ c.T + noise, c @ p).T * np.outer(sizes, 1.0 / spread))


def fit_by_prediction(fit: OutputFit, theta: Array, windows: OutputWindows, smoother: Smoother) -> Fitted:
    """Fit ``theta`` to the errors of predictions one period ahead, with the gain of their observer; the delay stays.

    A machine that is unstable, or that was recorded under feedback with disturbances of its own, biases free runs:
    inputs then answer to what free runs take for their error. Predictions know the measured past.

    Args:
        fit: The fit of free runs.
        theta: What it found.
        windows: Windows of the recordings with inputs that act.
        smoother: That of the prior with ``theta``.

    Source: Ljung, *System Identification: Theory for the User*, 1999, sections 4.3 and 7.3.
    """
    n, own = len(fit.free), PredictionFit(fit, smoother)
    first = np.concatenate([theta[:n], own.nominal[n:]])
    found = Shooting(own, own.of(windows), own.sizes).solve(first, PREDICTION_STEPS)
    covariance = np.zeros((len(theta), len(theta)))
    covariance[:n, :n] = found.covariance[:n, :n]
    known = tuple(one for one in found.unidentified if set(one.parameters) <= set(fit.names))
    return Fitted(np.concatenate([found.theta[:n], theta[n:]]), covariance, known)


class Driven(Protocol):
    """A recording with its inputs ``(n, n_u)``."""

    @property
    def u(self) -> Array:
        """Inputs."""


def feedback(trajectories: Sequence[Driven], errors: Sequence[Array]) -> float:
    """How far inputs answer to earlier prediction errors: the largest correlation, over what chance makes of it.

    What an input's own past does not tell of it is compared with the prediction errors of the same sample and of those
    before; it is zero, but for chance, if the recordings were made in open loop. Several times 1 is feedback.

    Args:
        trajectories: Recordings.
        errors: Prediction errors ``(n, n_y)`` of each, NaN where nothing was measured.
    """
    largest = 0.0
    for j in range(trajectories[0].u.shape[1]):
        rows, answers = [], []
        for t, e in zip(trajectories, errors, strict=True):
            u = t.u[:, j]
            if len(u) <= 2 * PAST or not np.ptp(u) > 0:
                continue
            past = np.stack([u[PAST - k - 1 : len(u) - k - 1] for k in range(PAST)], axis=1)
            before = np.stack([np.nan_to_num(e[PAST - k : len(u) - k]) for k in range(ANSWERS)], axis=1)
            rows.append(np.column_stack([past, np.ones(len(past)), before.reshape(len(past), -1)]))
            answers.append(u[PAST:])
        if not rows:
            continue
        x, y = np.concatenate(rows), np.concatenate(answers)
        own = x[:, : PAST + 1]
        left = _without_jumps(y - own @ np.linalg.lstsq(own, y, rcond=None)[0])
        for column in x[:, PAST + 1 :].T:
            rest = _without_jumps(column - own @ np.linalg.lstsq(own, column, rcond=None)[0])
            size = float(np.linalg.norm(left) * np.linalg.norm(rest))
            if np.linalg.norm(left) > 1e-9 * np.linalg.norm(y) and size > 0:
                chance = math.sqrt(max(float(_memory(left) @ _memory(rest)), 1.0) / len(y))
                largest = max(largest, abs(float(left @ rest)) / size / chance)
    return largest / CHANCE


def _memory(values: Array) -> Array:
    """Correlations of a series with itself, at lags of up to ``MEMORY`` to either side.

    The correlation of two independent series has the variance of the sum of the products of theirs, over their length
    (Bartlett, *On the theoretical specification and sampling properties of autocorrelated time-series*, 1946).
    """
    n = len(values)
    power = np.square(np.abs(np.fft.rfft(values, 2 * n)))
    own = np.fft.irfft(power)[: min(MEMORY, n - 1) + 1]
    own = own / max(float(own[0]), 1e-300)
    return np.concatenate([own, own[1:]])


def _without_jumps(values: Array) -> Array:
    """Values within three robust standard deviations: the jumps of a reference hide the rest of an input."""
    limit = OUTLIERS * 1.4826 * float(np.median(np.abs(values)))
    return np.clip(values, -limit, limit)


@dataclass(frozen=True)
class Fitted:
    """What a fit to windows found: ``theta`` with its covariance, and what the windows do not tell."""

    theta: Array
    covariance: Array
    unidentified: tuple[Combination, ...]


@dataclass(frozen=True)
class Trial:
    """What a short fit found: the number of its start, ``theta``, and the error of the windows over the spread."""

    start: int
    theta: Array
    error: float


@dataclass(frozen=True)
class _Point:
    """Errors of the outputs at ``theta`` and first states ``x`` ``(n, n_x)``, and their slopes.

    ``error`` ``(n, (T + 1) n_y)`` is zero where nothing counts, ``slopes`` ``(n, (T + 1) n_y, columns)`` are by
    ``theta`` (or not) and by ``x`` in its sizes. ``scale`` ``(n_y,)`` is what an error of each output is counted in.
    Errors beyond ``far`` scales are no measurements: they cost the same wherever they are. ``held`` is the weight of
    what first states move from their guess, in their sizes, beside errors in scales.
    """

    theta: Array
    x: Array
    substeps: int
    scale: Array
    error: Array
    slopes: Array
    held: float
    far: float = math.inf

    @property
    def scales(self) -> Array:
        """Scale of each error of a window."""
        return np.tile(self.scale, self.error.shape[1] // len(self.scale))

    def where(self, better: NDArray[np.bool_], other: _Point) -> _Point:
        """Windows of the other one where it is better."""
        own, new = ((p.x, p.error, p.slopes) for p in (self, other))
        x, error, slopes = (
            np.where(better.reshape(-1, *(1 for _ in v.shape[1:])), n, v)
            for v, n in zip(own, new, strict=True)
        )
        return replace(self, x=x, error=error, slopes=slopes)


class Shooting:
    """Windows of outputs as a least-squares problem over ``theta`` and the first states.

    ``sizes`` ``(n_x,)`` are those of the states: first states keep to their guess as if it were known to that.
    """

    def __init__(
        self, fit: OutputFit, windows: OutputWindows, sizes: Array, spread: Array | None = None
    ) -> None:
        self.own, self.windows, self.sizes = fit, windows, sizes
        y = windows.y
        self.seen = np.isfinite(y)
        own = [robust_spread(c) or 1.0 for c in y.reshape(-1, y.shape[-1]).T]
        self.spread = np.array(own) if spread is None else spread
        warm = np.repeat(np.arange(y.shape[1]) < windows.warm, y.shape[2]).astype(float)
        self.tell: Array = warm if windows.warm else 1.0 - warm
        self.count: Array = 1.0 - warm
        members = np.bincount(windows.group)
        self.members, self.alone = members[windows.group].astype(float), bool((members == 1).all())
        self._known: dict[bytes, tuple[float, Array]] = {}

    def explained(self, thetas: Sequence[Array]) -> list[float]:
        """How far each ``theta`` explains the windows from the first states that are best for it.

        That is the root mean square of the errors over the outputs' spreads, each at most ``FAR``; infinite where the
        prior is too stiff for the period.
        """
        unknown: dict[int, list[Array]] = {}
        for theta in {one.tobytes(): one for one in thetas if one.tobytes() not in self._known}.values():
            try:
                unknown.setdefault(self.own.substeps(theta), []).append(theta)
            except InputError:
                self._known[theta.tobytes()] = math.inf, self.windows.x
        n = len(self.windows.x)
        share = max(1.0, float((self.seen.reshape(n, -1) * self.count).sum()))
        for some in unknown.values():  # all at once: windows do not know of each other
            problem = Shooting(self.own, self.windows.times(len(some)), self.sizes, self.spread)
            x = problem.windows.x
            for periods in self._growing(some):
                begun = Shooting(self.own, problem.windows.beginning(periods), self.sizes, self.spread)
                x = begun._states(begun.start(np.stack(some), x, "x")).x
            point = problem._states(problem.start(np.stack(some), x, "x"))
            over = (
                np.clip(point.error / np.tile(self.spread, problem.windows.y.shape[1]), -FAR, FAR)
                * self.count
            )
            for i, theta in enumerate(some):
                part = slice(i * n, (i + 1) * n)
                error = float(np.sqrt(np.square(over[part]).sum() / share))
                self._known[theta.tobytes()] = error, point.x[part]
        return [self._known[theta.tobytes()][0] for theta in thetas]

    def _growing(self, thetas: Sequence[Array]) -> list[int]:
        """Lengths [periods] over which first states are found one after the other before those of the windows, where
        small errors grow more than a hundredfold: what is found over one tells where the next half as much begins.
        """
        periods, dt = self.windows.y.shape[1] - 1, self.own.dt
        reach = min(self.own.reach(theta) for theta in thetas) / dt
        if self.windows.warm or 0.8 * periods <= reach:
            return []
        return [int(own) for own in np.arange(max(reach, 4.0), periods, max(0.5 * reach, 2.0))]

    def first_states(self, theta: Array) -> Array:
        """First states ``(n, n_x)`` that are best for ``theta``."""
        self.explained([theta])
        return self._known[theta.tobytes()][1]

    def solve(self, theta: Array, iterations: int = ITERATIONS) -> Fitted:
        """Fit ``theta`` with the first states, from the best of these on: by the spreads, then by what is left."""
        theta = np.clip(theta, self.own.lower, self.own.upper)
        point = self.start(theta, self.first_states(theta), "all")
        if len(theta):
            point = self._descend(point, min(iterations, FIRST))
            for k in range(SCALINGS):
                rescaled = replace(point, scale=self._left(point.error), held=1.0)
                if k and (rescaled.scale > SETTLED * point.scale).all():
                    break
                point = self._descend(rescaled, iterations)
            if (np.abs(point.error) > GROSS * point.scales).any():
                point = self._descend(replace(point, far=GROSS), iterations)
        return Fitted(point.theta, *self._covariance(point))

    def several(
        self,
        thetas: Array,
        each: Callable[[Sequence[int]], OutputFit],
        keep: Sequence[int],
        free: int | None = None,
    ) -> list[Trial]:
        """Short fits from several ``thetas`` ``(m, k)`` at once, one batch of free runs for all; the worst end early.

        Args:
            thetas: Starts.
            each: Fit for the starts of these numbers, whose windows lie one behind the other.
            keep: How many go on after each two steps.
            free: How many parameters are fitted, the first ones. Default: all.
        """
        alive, n = list(range(len(thetas))), len(self.windows.x)
        damping = np.full(len(thetas), DAMPING)
        share = max(1.0, float((self.seen.reshape(n, -1) * self.count).sum()))

        def many(numbers: Sequence[int]) -> Shooting:
            return Shooting(each(numbers), self.windows.times(len(numbers)), self.sizes, self.spread)

        def parts(point: _Point) -> list[_Point]:
            rows = [slice(i * n, (i + 1) * n) for i in range(len(point.theta))]
            return [
                replace(point, theta=theta, x=point.x[r], error=point.error[r], slopes=point.slopes[r])
                for theta, r in zip(point.theta, rows, strict=True)
            ]

        problem = many(alive)
        begun = problem._states(problem.start(thetas, problem.windows.x, "x"))
        point = problem._at(begun, thetas, begun.x, "all") if keep else begun
        found = dict(zip(alive, parts(point), strict=True))
        for left in keep:
            for _ in range(2):
                steps = []
                for k in alive:
                    xx, xt, tt, gx, gt = self._normal(found[k])
                    normal = xx, xt[..., :free], tt[:free, :free], gx, gt[:free]
                    step, moved, _ = self._step(normal, damping[k], found[k].theta[:free])
                    steps.append((np.pad(step, (0, thetas.shape[1] - len(step))), moved))
                theta = np.stack([
                    np.clip(found[k].theta + step, self.own.lower, self.own.upper)
                    for k, (step, _) in zip(alive, steps, strict=True)
                ])  # fmt: skip
                x = np.concatenate([
                    found[k].x + moved[self.windows.group] * self.sizes
                    for k, (_, moved) in zip(alive, steps, strict=True)
                ])  # fmt: skip
                trials = parts(many(alive)._at(begun, theta, x, "all"))
                for k, trial in zip(alive, trials, strict=True):
                    better = self._cost(trial) < self._cost(found[k])
                    found[k] = trial if better else found[k]
                    damping[k] *= 0.2 if better else 5.0
            alive = sorted(alive, key=lambda k: self._cost(found[k]))[:left]
        over = {
            k: np.clip(found[k].error / np.tile(self.spread, self.windows.y.shape[1]), -FAR, FAR)
            for k in alive
        }
        return [
            Trial(k, found[k].theta, math.sqrt(float(np.square(over[k] * self.count).sum()) / share))
            for k in alive
        ]

    def settled(self, theta: Array) -> Fitted:
        """The same fit from near its end on, to the last digits: neither start nor rounding is left in it."""
        point = self.start(theta, self.first_states(theta), "all")
        for _ in range(2):
            rescaled = replace(point, scale=self._left(point.error), held=1.0)
            point = self._descend(rescaled, ITERATIONS, CLOSELY)
        if (np.abs(point.error) > GROSS * point.scales).any():
            point = replace(point, far=GROSS)
        for _ in range(SETTLING):
            point = replace(point, scale=self._left(point.error))
            normal = self._behind(point) if self.windows.warm else self._normal(point)
            step, moved, _ = self._step(normal, 0.0, point.theta)
            for share in SHARES:
                trial = self._along(point, share * step, share * moved)
                if better := self._cost(trial) <= self._cost(point) * (1 + SAME):
                    break
            if not better:
                break
            far, point = np.abs(trial.theta - point.theta), trial
            if (far <= DIGITS * self.own.half).all():
                break
        return Fitted(point.theta, *self._covariance(point))

    def _along(self, point: _Point, step: Array, moved: Array) -> _Point:
        """The point a step of ``theta`` and first states further, these corrected where the cost would rise without."""
        theta = np.clip(point.theta + step, self.own.lower, self.own.upper)
        x = point.x + moved[self.windows.group] * self.sizes
        if self.windows.warm:
            x = self._states(self._at(point, theta, x, "x")).x
        trial, cost = self._at(point, theta, x, "all"), self._cost(point)
        if self._cost(trial) <= cost * (1 + SAME) or self.windows.warm:
            return trial
        own = self._followed(point, trial)
        return self._at(point, theta, own.x, "all") if self._cost(own) <= cost * (1 + SAME) else trial

    def forget(self) -> None:
        """Forget the first states that were found with other integration steps."""
        self._known.clear()

    def shift(self, theta: Array, substeps: int) -> Array:
        """How far a Gauss-Newton step moves ``theta`` where the outputs are those of so many sub-steps a period."""
        point = self.start(theta, self.first_states(theta), "all")
        point = replace(point, scale=self._left(point.error), held=1.0)
        finer = self._at(replace(point, substeps=substeps), theta, point.x, "")
        moved = [
            self._step(self._behind(p) if self.windows.warm else self._normal(p), 0.0, theta)[0]
            for p in (point, replace(point, error=finer.error))
        ]
        return np.abs(moved[1] - moved[0])

    def start(self, theta: Array, x: Array, slopes: Slopes) -> _Point:
        """Errors at ``theta`` from ``x``, each output's over its spread."""
        nothing = np.zeros(0)
        substeps = self.own.most_substeps(np.atleast_2d(theta))
        empty = _Point(theta, x, substeps, self.spread, nothing, nothing, LOOSELY**2)
        return self._at(empty, theta, x, slopes)

    def linear(self, theta: Array, x: Array) -> tuple[Array, Array]:
        """Slopes ``(n, m, k)`` by ``theta`` and errors ``(n, m)`` at ``theta`` and first states ``x``, these
        eliminated, over their scales, by the root of their robust weights.
        """
        point = self.start(theta, x, "all")
        return self._eliminated(replace(point, scale=self._left(point.error), held=1.0))[:2]

    def _at(self, before: _Point, theta: Array, x: Array, slopes: Slopes) -> _Point:
        """Another point."""
        windows, seen, n, limit = self.windows, self.seen, len(x), LARGEST * self.spread
        y, by = self.own.outputs(theta, x, windows, before.substeps, slopes)
        error = np.nan_to_num(y, nan=np.inf) - np.where(seen, windows.y, 0.0)
        beyond = np.where(windows.censored > 0, error > 0, error < 0)
        counts = seen & ~((windows.censored != 0) & beyond)
        inside = counts & (np.abs(error) < limit)
        error = np.where(counts, np.clip(error, -limit, limit), 0.0).reshape(n, -1)
        if slopes:
            with np.errstate(over="ignore", invalid="ignore"):
                by[..., -x.shape[1] :] *= np.where(self.windows.known, 0.0, self.sizes)[:, None, None]
                inside &= np.abs(by).max(axis=-1) < STEEP * self.spread  # not where it is NaN
            by[~inside] = 0.0
            by = by.reshape(n, error.shape[1], by.shape[-1])
        return replace(before, theta=theta, x=x, error=error, slopes=by)

    def _costs(self, point: _Point) -> Array:
        """Robust sum of squares of each group of windows that counts for its first state, with what this moved."""
        c2, moved = OUTLIERS**2, self._moved(point) / np.sqrt(self.members)[:, None]
        over = np.minimum(np.abs(point.error / point.scales), point.far)
        own = 2 * c2 * (np.sqrt(1 + np.square(over) / c2) - 1)
        return self._grouped((own * self.tell).sum(axis=1) + np.square(moved).sum(axis=1))

    def _cost(self, point: _Point) -> float:
        """What ``theta`` is fitted by: the same sum, or of a warm-up what comes behind it."""
        if not self.windows.warm:
            return float(self._costs(point).sum()) + self._pulled(point)
        c2 = OUTLIERS**2
        over = np.minimum(np.abs(point.error / point.scales), point.far)
        own = 2 * c2 * (np.sqrt(1 + np.square(over) / c2) - 1)
        return float((own * self.count).sum()) + self._pulled(point)

    def _pulled(self, point: _Point) -> float:
        """What parameters beside their nominal values cost."""
        return float(np.square(self.own.pull * (point.theta - self.own.nominal)).sum())

    def _moved(self, point: _Point) -> Array:
        """What first states moved from their guess, in their sizes, by the root of its weight."""
        return np.asarray(math.sqrt(point.held) * (point.x - self.windows.x) / self.sizes)

    def _grouped(self, values: Array) -> Array:
        """Sums over the windows of each group."""
        if self.alone:
            return values
        total = np.zeros((int(self.windows.group.max()) + 1, *values.shape[1:]))
        np.add.at(total, self.windows.group, values)
        return total

    def _left(self, error: Array) -> Array:
        """Size of what is left of each output: outputs of any unit count alike, outliers little."""
        own = error.reshape(self.windows.y.shape)
        left = [np.abs(own[..., j][self.seen[..., j]]) for j in range(len(self.spread))]
        robust = np.array([1.4826 * float(np.median(v)) if len(v) else 0.0 for v in left])
        whole = np.array([float(np.sqrt(np.mean(within(v) ** 2))) if len(v) else 0.0 for v in left])
        robust = np.maximum(robust, COMMON * whole)  # errors that are common are the prior's, and no outliers
        return np.maximum(robust, 1e-9 * self.spread)

    def _states(self, point: _Point, steps: int = COMPARED) -> _Point:
        """First states at a ``theta``, each window by itself: with a damping of its own, until all have settled."""
        cost, eye, group = self._costs(point), np.eye(point.x.shape[1]), self.windows.group
        damping, candidates = np.full((len(cost), 1, 1), DAMPING), len(np.atleast_2d(point.theta))
        for _ in range(steps):
            xx, _, _, gx, _ = self._normal(point)
            moved = -np.linalg.solve(xx * (1 + damping * eye), gx[..., None])[..., 0]
            trial = self._at(point, point.theta, point.x + moved[group] * self.sizes, "x")
            new = self._costs(trial)
            better, promised = new < cost, -2.0 * np.sum(gx * moved, axis=1)
            gain = np.where(better, cost - new, np.where(damping[:, 0, 0] < WORST, promised, 0.0))
            point = point.where(better[group], trial)
            cost = np.minimum(cost, new)
            damping = damping * np.where(better, 0.2, 5.0)[:, None, None]
            gains, costs = (v.reshape(candidates, -1).sum(axis=1) for v in (gain, cost))
            if (gains <= ALIKE * costs).all():
                break
        return point

    def _followed(self, point: _Point, trial: _Point) -> _Point:
        """Another ``theta`` with first states that suit it: from the trial's, or from those before, in each window."""
        moved = replace(trial, slopes=trial.slopes[..., -trial.x.shape[1] :])
        still = self._at(point, trial.theta, point.x, "x")
        better = self._costs(still) < self._costs(moved)
        return self._states(moved.where(better[self.windows.group], still), FOLLOWING)

    def _descend(self, point: _Point, iterations: int, enough: float = CONVERGED) -> _Point:
        """Steps of Levenberg and Marquardt, of ``theta`` with the first states, until one takes off less than a share
        ``enough`` of a window's mean cost.
        """
        damping, cost, n = DAMPING, self._cost(point), len(point.x)
        for _ in range(iterations):
            better = followed = False
            normal = self._behind(point) if self.windows.warm else self._normal(point)
            while not better and damping < WORST:
                step, moved, promised = self._step(normal, damping, point.theta)
                last = promised < enough * cost / n
                theta = np.clip(point.theta + step, self.own.lower, self.own.upper)
                x = point.x + moved[self.windows.group] * self.sizes
                if self.windows.warm:  # the warm-up tells the first states of every theta
                    x = self._states(self._at(point, theta, x, "x")).x
                trial = self._at(point, theta, x, "all")
                new = self._cost(trial)
                if not (
                    new < cost or last or followed or self.windows.warm
                ):  # first states may not have followed
                    followed = True
                    own = self._followed(point, trial)
                    if self._cost(own) < cost:
                        trial = self._at(point, theta, own.x, "all")
                        new = self._cost(trial)
                better = new < cost
                damping *= 0.2 if better else 5.0
                if last:
                    break
            if not better:
                break
            gain, point, cost = cost - new, trial, new
            if last or gain < enough * cost / n:
                break
        return point

    def _weighted(self, point: _Point) -> Array:
        """Slopes and, behind them, errors, over their scale and by the root of their robust weight."""
        error = point.error / point.scales
        root = np.where(np.abs(error) < point.far, (1 + np.square(error / OUTLIERS)) ** -0.25, 0.0)
        slopes = point.slopes * (root / point.scales)[..., None]
        return np.concatenate([slopes, (root * error)[..., None]], axis=-1)

    def _normal(self, point: _Point) -> tuple[Array, ...]:
        """Blocks of the normal equations: of ``x`` and of both by groups, of ``theta``, and the gradients."""
        rows, n_x = self._weighted(point) * np.sqrt(self.tell)[:, None], point.x.shape[1]
        every = rows.swapaxes(1, 2) @ rows
        t, x = slice(0, -1 - n_x), slice(-1 - n_x, -1)
        moved, n = self._moved(point) / self.members[:, None], rows.shape[-1] - 1 - n_x
        moved = math.sqrt(point.held) * moved
        pull, from_nominal = self._pull(point, n)
        return (
            _regular(self._grouped(every[:, x, x]), point.held), self._grouped(every[:, x, t]),
            every[:, t, t].sum(axis=0) + pull, self._grouped(every[:, x, -1] + moved),
            every[:, t, -1].sum(axis=0) + from_nominal,
        )  # fmt: skip

    def _pull(self, point: _Point, n: int) -> tuple[Array, Array]:
        """What holds ``theta`` at the nominal values: its part of the normal matrix, and of the gradient."""
        if not n:  # of the first states alone
            return np.zeros((0, 0)), np.zeros(0)
        weights = np.square(self.own.pull)
        return np.diag(weights), weights * (point.theta - self.own.nominal)

    def _eliminated(self, point: _Point) -> tuple[Array, Array, Array, float]:
        """Slopes by ``theta`` and errors of what counts, with first states that follow; by how much these do, and how
        many numbers of those that count they take for themselves.
        """
        rows, n_x = self._weighted(point), point.x.shape[1]
        b, a, error = rows[..., : -1 - n_x], rows[..., -1 - n_x : -1], rows[..., -1:]
        at = (a * self.tell[:, None]).swapaxes(1, 2)
        xx = _regular(self._grouped(at @ a), point.held)
        follow = np.linalg.solve(xx, self._grouped(at @ np.concatenate([b, error], axis=-1)))
        left = np.concatenate([b, error], axis=-1) - a @ follow[self.windows.group]
        left *= self.count[:, None]
        taken = (
            0.0
            if self.windows.warm
            else float(np.trace(np.eye(n_x) - point.held * np.linalg.inv(xx), axis1=1, axis2=2).sum())
        )
        return left[..., :-1], left[..., -1], np.asarray(follow, dtype=np.float64), taken

    def _behind(self, point: _Point) -> tuple[Array, ...]:
        """As :meth:`_normal`, of what comes behind the warm-up; first states follow from the warm-up alone."""
        b, error, follow, _ = self._eliminated(point)
        n_x = point.x.shape[1]
        pull, from_nominal = self._pull(point, b.shape[-1])
        return (
            np.broadcast_to(np.eye(n_x), (len(follow), n_x, n_x)), follow[..., :-1],
            (b.swapaxes(1, 2) @ b).sum(axis=0) + pull, follow[..., -1],
            (b.swapaxes(1, 2) @ error[..., None])[..., 0].sum(axis=0) + from_nominal,
        )  # fmt: skip

    def _step(self, normal: tuple[Array, ...], damping: float, theta: Array) -> tuple[Array, Array, float]:
        """Step of ``theta`` within its bounds, and of the first states by groups, which follow it; and how far it takes
        the cost down to first order.
        """
        xx, xt, tt, gx, gt = normal
        reduced, slope = tt, gt
        if not self.windows.warm:
            xx = xx * (1 + damping * np.eye(xx.shape[-1]))
        solved = np.linalg.solve(xx, np.concatenate([xt, gx[..., None]], axis=-1))
        by_theta, own = solved[..., :-1], solved[..., -1]
        if not self.windows.warm:
            reduced = tt - (xt.swapaxes(1, 2) @ by_theta).sum(axis=0)
            slope = gt - (xt.swapaxes(1, 2) @ own[..., None])[..., 0].sum(axis=0)
        step = _bounded(
            reduced + damping * np.diag(np.maximum(np.diag(tt), 1e-30)), slope,
            self.own.lower[: len(theta)] - theta, self.own.upper[: len(theta)] - theta,
        )  # fmt: skip
        moved = -own - (by_theta @ step[:, None])[..., 0]
        of_states = 0.0 if self.windows.warm else float(np.sum(gx * moved))
        return step, moved, -2.0 * (float(gt @ step) + of_states)

    def _covariance(self, point: _Point) -> tuple[Array, tuple[Combination, ...]]:
        """Covariance of ``theta``, and what the windows do not tell.

        It follows from the scatter of the slopes of ``CLUSTERS`` parts of the windows at least, since errors within one
        are no white noise, and from what holds ``theta`` at the nominal values; none is smaller than white noise of
        that size would make it, since so few parts tell their scatter roughly, and none is larger than a half range.

        Source: Liang and Zeger, *Longitudinal data analysis using generalized linear models* (1986), of clusters; Huber
        and Ronchetti, *Robust Statistics* (2009), section 7.6, of the robust loss.
        """
        b, error, _, taken = self._eliminated(point)
        n, k = len(b), b.shape[-1]
        if not k:
            return np.zeros((0, 0)), ()
        falling = 1.0 / (1.0 + np.square(point.error / point.scales / OUTLIERS))  # psi'(r) over psi(r) / r
        half = self.own.half
        rows = (b * np.sqrt(falling)[..., None]).reshape(-1, k) * half
        _, values, directions = np.linalg.svd(np.linalg.qr(rows, mode="r"))
        told = np.zeros(k)
        told[: len(values)] = np.where(values > ROUNDED * values[0], values, 0.0)
        back = directions.T * half[:, None]  # theta from coordinates in which the information is diag(told^2)
        outputs = len(self.spread)
        scores = (b * error[..., None]).reshape(n, -1, outputs, k).sum(axis=2)
        parts = min(math.ceil(CLUSTERS / n), scores.shape[1])
        begins = np.arange(parts) * scores.shape[1] // parts
        scores = np.add.reduceat(scores, begins, axis=1).reshape(-1, k)
        counted = float((self.seen.reshape(n, -1) * self.count).sum())
        left = max(counted - k - taken, 0.5 * counted)  # degrees of freedom
        scores = scores @ back * (told > 0)
        middle = scores.T @ scores * (counted / max(left, 1.0)) * len(scores) / max(len(scores) - 1, 1)
        inverse = 1.0 / (np.square(told) + LOOSE**-2)
        covariance = back @ ((middle + LOOSE**-2 * np.eye(k)) * np.outer(inverse, inverse)) @ back.T
        covariance = 0.5 * (covariance + covariance.T)
        white = float(np.square(error).sum()) / max(left, 1.0)  # variance of errors that are white, weighed
        least = np.square(back) @ (inverse * inverse * (white * np.square(told) + LOOSE**-2))
        short = np.sqrt(np.maximum(least / np.maximum(np.diag(covariance), 1e-300), 1.0))
        covariance = covariance * np.outer(short, short)
        values, directions = np.linalg.eigh(covariance / np.outer(half, half))
        untold = directions[:, values >= UNTOLD**2].T
        found = tuple(_combination(self.own, point.theta, covariance, one) for one in untold)
        bounded = directions * np.minimum(values, 1.0) @ directions.T * np.outer(half, half)
        return bounded, tuple({one.parameters: one for one in found}.values())


def _bounded(matrix: Array, slope: Array, low: Array, high: Array) -> Array:
    """Step ``(n,)`` to the least of ``s' matrix s / 2 + slope' s`` between ``low <= 0`` and ``high >= 0``.

    Of the components that would go beyond, the first one to meet its bound is held there, and the others are solved for
    anew: held together, two that lie along a valley would both rest in a corner. None is let go of again.
    """
    step, free = np.zeros(len(slope)), np.arange(len(slope))
    held = np.zeros(len(slope), dtype=bool)
    for _ in range(len(slope)):
        free = np.flatnonzero(~held)
        right = slope[free] + matrix[np.ix_(free, np.flatnonzero(held))] @ step[held]
        step[free] = -np.linalg.lstsq(matrix[np.ix_(free, free)], right, rcond=1e-14)[0]
        ends = np.clip(step, low, high)
        beyond = free[ends[free] != step[free]]
        if not len(beyond):
            break
        first = beyond[np.lexsort((-np.abs(step - ends)[beyond], (ends[beyond] / step[beyond])))[0]]
        held[first], step[first] = True, ends[first]
    return step


def _regular(xx: Array, held: float) -> Array:
    """Normal matrices of first states ``(n, n_x, n_x)`` with what holds these at their guess."""
    eye = np.eye(xx.shape[-1])
    return np.asarray(xx * (1.0 + ROUNDING * eye) + held * eye)


def _combination(fit: OutputFit, theta: Array, covariance: Array, direction: Array) -> Combination:
    """What the data do not tell along a direction [half ranges], and the best known combination of the same."""
    among = np.flatnonzero(np.abs(direction) > INVOLVED * np.abs(direction).max())
    names = tuple(fit.names[i] for i in among)
    if len(among) == 1:
        return Combination(names)
    sizes = fit.unit[among]

    def known(size: Array) -> tuple[Array, float]:
        """Weights of the parameters, each over its size, and what they add up to is known to."""
        own = covariance[np.ix_(among, among)] * np.outer(sizes, sizes) / np.outer(size, size)
        values, directions = np.linalg.eigh(own)
        weights = directions[:, 0] / size
        return weights, math.sqrt(max(float(values[0]), 0.0))

    weights, error = known(fit.half[among] * sizes)
    ratio = np.abs(weights / np.abs(weights).max())
    units = {fit.free[i].unit if i < len(fit.free) else "s" for i in among}
    value = theta[among] * sizes
    sign = np.sign(theta[among])
    one_sign = (sign * np.where(sign > 0, fit.lower[among], fit.upper[among]) >= 0).all() and sign.all()
    product = bool(one_sign) and not (len(units) == 1 and ratio.min() > ALIKE_WEIGHTS)
    if product:
        weights, error = known(value)
        weights = weights * value
    largest = float(weights[np.abs(weights).argmax()])
    return Combination(names, tuple((weights / largest).tolist()), product, error / abs(largest))


def fit_prior(
    make: Callable[..., Prior],
    train: Sequence[Trajectory],
    valid: Sequence[Trajectory],
    *,
    dt: float,
    length: float | None = None,
    largest_delay: float = 0.0,
    start: Mapping[str, float] | None = None,
    time_unit: float | None = None,
    first_states: FirstStates = FREE,
    on_progress: Progress = lambda done, total, text: None,
) -> PriorFit:
    """Fit parameters and delay to the measured outputs over longer and longer windows, and find what smooths states.

    Each length starts from what explains its windows best of what is known: the nominal values, the best of several
    starts between the bounds, and what shorter windows found; up to ``FOLLOWED`` of them are followed where they do
    about as well. A machine on which small errors grow gets windows no longer than these take to grow a hundredfold,
    unless little more than the sensors' noise is left; where that is all that is left, whole recordings come last. Of
    the nominal values and all lengths the one wins that explains the longest windows best, over training and validation
    recordings together: few parameters do not overfit, and where a machine drifts a short validation part alone
    misleads. A prior without free parameters stays as it is.

    Parameters are held loosely at their nominal values, so that what the data do not tell stays where it is. At the end
    integration steps are halved until that moves no parameter by what counts. The order of the recordings is no matter,
    and those that follow each other within a period count as one (:func:`continued`).

    Recordings whose inputs answer to the outputs (:func:`feedback`) warn, and the errors of predictions are fitted too.
    Inputs that seem to act late warn where parameters are fitted and no delay is, and first states are not known ones.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        train: Training trajectories.
        valid: Validation trajectories (chosen by, not fitted to).
        dt: Model period [s].
        length: Length [s] of the longest windows: that of the runs that the model will be evaluated by. Default: 5 of
            the machine's seconds, or 3 of the nominal prior's largest time constant where that is more.
        largest_delay: Longest delay [s] of the inputs. Default 0: they act at once.
        start: Values [their units] by name to try as a start besides the nominal ones, e.g. those of a global search;
            fixed parameters are left out. Default: none.
        time_unit: The machine's second [s]. Default: that of the training trajectories.
        first_states: What is known of the states that free runs start from. Default: nothing, they are free.
        on_progress: ``(done, total, text)`` after every stage.

    Raises:
        InputError: If a state is seen by no output, no trajectory is long enough, or the prior diverges with all
            parameters tried.

    Example:
        >>> from scenarios.pendulum.data import exact_runs
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> runs = exact_runs("train", 1)
        >>> fit = fit_prior(PendulumPrior, runs, runs, dt=0.01)
        >>> round(fit.values["l"], 3)
        0.045

    Source: Bock, *Recent advances in parameter identification techniques for O.D.E.* (1983).
    """
    if first_states.kind not in ("known", "shared"):  # which are those of each trajectory's first sample
        train, valid = continued(train), continued(valid)
    train, valid = (sorted(part, key=_place) for part in (train, valid))  # the order of files is no matter
    fit = OutputFit(make, dt, largest_delay)
    unit = scales.time_unit(train, dt) if time_unit is None else time_unit
    check_observable(fit.prior, dt, unit)
    first_states.check(fit.prior, largest_delay)
    if _longest(train) < fit.lead + 3:
        raise InputError(
            f"no recording is long enough to fit {type(fit.prior).__name__} to: the longest has {_longest(train)} "
            f"samples, {fit.lead + 3} are needed at least"
        )
    if length is None:
        length = max(LENGTHS[-1] * unit, SLOWEST * slowest(fit.prior))
    on_progress(0, 1, "smoothing by the nominal prior")
    smoother = rough_smoother(fit.prior, shifted(train, fit.delay(fit.nominal)), dt, time_unit=unit)
    noise = np.array(smoother.sizes.noise)
    every = with_states([*train, *valid], smoother, fit.delay(fit.nominal))
    fit.points = visited(every)
    if fit.substeps(fit.nominal) > smoother.substeps:  # stiff where the recordings go
        smoother = replace(smoother, substeps=fit.substeps(fit.nominal))
        every = with_states([*train, *valid], smoother, fit.delay(fit.nominal))
        fit.points = visited(every)
    guesses = every[: len(train)], every[len(train) :]
    moved = [robust_spread(column) for column in np.concatenate([t.x for t in guesses[0]]).T]
    sizes = np.maximum(smoother.sizes.x, moved)  # a rough guess is no measurement
    lengths = _lengths(train, dt, unit, length, fit.lead, fit.reach(fit.nominal))
    total = len(lengths) + 2

    def problem_of(part: Sequence[Trajectory], periods: int | None, most: int = WINDOWS) -> Shooting:
        known = fit.prior.states, fit.prior.outputs, first_states
        return Shooting(fit, cut_outputs(part, periods, fit.lead, most, *known), sizes)

    def parts_of(periods: int | None) -> list[Shooting]:
        """Training and validation windows by which candidates are compared, as far as recordings hold them."""
        return [problem_of(part, periods) for part in guesses if _longest(part) > (periods or 2) + fit.lead]

    periods, scoring = lengths[-1], parts_of(lengths[-1])
    found: list[tuple[str, list[Fitted], Shooting]] = []
    if len(fit.nominal):
        on_progress(1, total, "several starts")
        far = max(p for p in lengths if p == lengths[0] or 0.8 * p * dt <= fit.reach(fit.nominal))
        short, long = (problem_of(guesses[0], own, FEW) for own in (lengths[0], far))
        begun = _starts(fit, short, long, start)
        followed, problem = begun, short
        for i, own in enumerate(lengths):
            beyond = i > 0 and 0.8 * own * dt > fit.reach(followed[0])
            if beyond and not _quiet(problem, followed[0], noise):
                break
            name, longer = f"free runs of {own * dt:.3g} s", problem_of(guesses[0], own)
            on_progress(2 + i, total, name)
            every_start = [fit.nominal, *begun, *followed]  # short windows may have led astray
            solved = [longer.solve(one) for one in _promising(fit, longer, every_start)]
            if beyond and not any(_quiet(longer, one.theta, noise) for one in solved):
                break  # first states that explain so long windows were not found
            periods, problem = own, longer
            if own == lengths[-1]:
                solved += _further(fit, problem, solved)
            scoring = parts_of(own) or [problem]
            errors = _errors_of([one.theta for one in solved], scoring)
            solved = [solved[k] for k in np.argsort(errors, kind="stable")]
            found.append((name, solved, problem))
            followed = [one.theta for one in solved]
            if fit.reach(followed[0]) < AWAY * lengths[-1] * dt:
                again = rough_smoother(
                    make(fit.values(followed[0])), shifted(train, fit.delay(followed[0])), dt, time_unit=unit
                )
                again = replace(again, substeps=fit.substeps(followed[0]))
                every = with_states([*train, *valid], again, fit.delay(followed[0]))
                guesses = every[: len(train)], every[len(train) :]
        whole = _longest(guesses[0]) - fit.lead - 1
        more = whole > WHOLE * periods and 0.8 * min(whole, LONGEST) * dt < fit.reach(followed[0])
        if more and _quiet(problem, followed[0], noise):  # each window spends some numbers on its first state
            on_progress(total - 1, total, "whole recordings")
            longer = problem_of(guesses[0], None)
            solution = longer.solve(followed[0])
            if _quiet(longer, solution.theta, noise):
                problem, scoring = longer, parts_of(None)
                found.append(("whole recordings", [solution], longer))
    candidates = [("nominal", Fitted(fit.nominal, np.zeros((0, 0)), ()))]
    problems = {}
    for name, solved, problems[name] in found:  # of each length what is best over the longest windows
        errors = _errors_of([one.theta for one in solved], scoring)
        candidates.append((name, solved[int(np.argmin(errors))]))
    scores = _errors_of([c.theta for _, c in candidates], scoring)
    on_progress(total - 1, total, "smoothing by the fitted prior")

    if not np.isfinite(min(scores)):
        raise InputError("the prior diverges with every set of parameters tried; check its signs and units")

    def smoother_of(found: Fitted) -> Smoother:
        acting = shifted([*train, *valid], fit.delay(found.theta))
        fitted, substeps = make(fit.values(found.theta)), fit.substeps(found.theta)
        return fit_smoother(fitted, acting, dt, time_unit=unit, substeps=substeps)

    name, chosen = candidates[winner([name for name, _ in candidates], scores)]
    if len(chosen.covariance):
        chosen = _with_enough_substeps(fit, problems[name], chosen)
        settled = problems[name].settled(chosen.theta)
        before, after = problems[name].explained([chosen.theta, settled.theta])
        chosen = settled if after <= ENOUGH * before else chosen  # weights that follow may favour one output
    smoother = smoother_of(chosen)
    acting = shifted(train, fit.delay(chosen.theta))
    answered = feedback(acting, smoother.prediction_errors(acting, smoother.prior.p[None])[1])
    if fit.free and (answered > 1.0 or fit.reach(chosen.theta) < length):
        on_progress(total - 1, total, PREDICTIONS)
        known = [replace(t, x=s.x) for t, s in zip(acting, smoother.smooth(acting), strict=True)]
        forgotten = min(scales.periods(FORGETS * unit, dt, 2), lengths[-1], _longest(known) - 1)
        windows = cut_outputs(known, forgotten, 0, FEW, fit.prior.states)
        candidates.append((PREDICTIONS, fit_by_prediction(fit, chosen.theta, windows, smoother)))
        scores += _errors_of([candidates[-1][1].theta], scoring)
        if winner([name for name, _ in candidates], scores) == len(scores) - 1:
            chosen = candidates[-1][1]
            smoother = smoother_of(chosen)
    stages = tuple({"stage": c[0], "validation_error": s} for c, s in zip(candidates, scores, strict=True))
    warnings = _warnings(fit, chosen, answered, min(scores) / max(scores[0], 1e-300))
    if fit.free and not largest_delay and first_states.kind not in ("known", "shared"):
        warnings += _late(fit, chosen.theta, guesses, periods, sizes, first_states)
    on_progress(total, total, "done")
    return PriorFit(
        fit.values(chosen.theta), _errors(fit, chosen), warnings, stages,
        _correlations(fit, chosen), fit.delay(chosen.theta), smoother.sigma, smoother.walk, smoother.sizes,
        smoother.fading, smoother.substeps, chosen.unidentified,
    )  # fmt: skip


def refit(
    make: Callable[..., Prior],
    fit: PriorFit,
    trajectories: Sequence[Trajectory],
    *,
    dt: float,
    lengths: Sequence[float],
) -> PriorFit:
    """Parameters fitted anew to recordings of a machine that has changed, from those of an earlier fit on.

    The delay and what smooths states stay. ``lengths`` [s] are those of the windows, one after the other; none
    is longer than the longest recording.
    """
    known = smoothed(make, fit, trajectories, dt)
    own, sizes, stages = OutputFit(make, dt), np.array(fit.smoother(make(fit.values), dt).sizes.x), []
    own.points = visited(known)
    found = Fitted(own.scaled(fit.values), np.zeros((0, 0)), ())
    for length in lengths:
        periods = min(scales.periods(length, dt, 2), _longest(known) - 1)
        windows = cut_outputs(known, periods, 0, WINDOWS)
        problem = Shooting(own, windows, sizes)
        found = problem.solve(found.theta)
        (error,) = problem.explained([found.theta])
        stages.append({"stage": f"free runs of {length:g} s", "validation_error": error})
    return replace(
        fit, values=own.values(found.theta), standard_errors=_errors(own, found), warnings=_warnings(own, found),
        stages=tuple(stages), correlations=_correlations(own, found), substeps=own.substeps(found.theta),
    )  # fmt: skip


def smoothed(
    make: Callable[..., Prior], fit: PriorFit, trajectories: Sequence[Trajectory], dt: float
) -> list[Trajectory]:
    """Trajectories with the inputs that act and the states that the fitted prior smooths: what networks train on."""
    return fit.smoother(make(fit.values), dt).smooth(shifted(trajectories, fit.delay))


def beyond_ranges(prior: Prior, smoothed: Sequence[Trajectory]) -> tuple[str, ...]:
    """A warning for each state that leaves its declared range where the prior smooths recordings.

    Example:
        >>> from scenarios.pendulum.data import exact_runs
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> beyond_ranges(PendulumPrior(), exact_runs("train", 1))
        ()
    """
    x = np.concatenate([t.x for t in smoothed])
    return tuple(
        f"{s.label} goes from {low:.4g} to {high:.4g} with the fitted values, beyond its range [{s.lower:g}, "
        f"{s.upper:g}]: the range is wrong, or the prior lacks what keeps it within"
        for s, low, high in zip(prior.states, x.min(0), x.max(0), strict=True)
        if low < s.lower - BEYOND * (high - low) or high > s.upper + BEYOND * (high - low)
    )


def parameter_variance(
    prior: Prior, covariance: Array, x: Array, u: Array, w: Array, dt: float, substeps: int = 0
) -> Array:
    """Variance of the outputs of free runs by that of the parameters ``(b, n, n_y)`` [output units^2].

    Args:
        prior: The fitted prior.
        covariance: Covariance of its parameters ``(n_p, n_p)``; empty where it is not known, which counts as none.
        x: First states ``(b, n_x)``.
        u: Inputs ``(b, n, n_u)``.
        w: Disturbances ``(b, n, n_w)``.
        dt: Period [s].
        substeps: Runge-Kutta sub-steps a period. Default 0: as many as the prior needs at rest.
    """
    if not covariance.size:
        return np.zeros((*u.shape[:2], len(prior.outputs)))
    free = tuple(range(len(prior.parameters)))
    simulation = simulation_of(prior.equations.xdot, dt, free, prior.equations.output)
    with np.errstate(over="ignore", invalid="ignore"):  # a run that diverges is as uncertain as can be
        _, slope = simulation.by_parameters(x, u, w, prior.p, substeps or required_substeps(prior, dt))
        variance = np.sum((slope @ covariance) * slope, axis=-1)
    return np.asarray(np.nan_to_num(np.maximum(variance, 0.0), nan=np.inf))


def check_observable(prior: Prior, dt: float, time_unit: float) -> None:
    """Refuse a prior with states that no output tells of.

    Raises:
        InputError: Naming the states.
    """
    unseen = unseen_states(prior, dt, time_unit)
    if unseen:
        raise InputError(
            f"{type(prior).__name__}: no output tells of {', '.join(unseen)} (outputs: "
            f"{', '.join(s.name for s in prior.outputs)}): nothing that is measured changes with "
            f"{'them' if len(unseen) > 1 else 'it'}. Measure it, leave it out of the states, or check output()"
        )


def with_states(trajectories: Sequence[Trajectory], smoother: Smoother, delay: float) -> list[Trajectory]:
    """Trajectories with states smoothed roughly, inputs as commanded, and without the samples that a delay costs."""
    made = []
    for t, s in zip(trajectories, smoother.smooth(shifted(trajectories, delay)), strict=True):
        made.append(replace(t.part(slice(len(t.t) - len(s.t), None)), x=s.x, xdot=s.xdot))
    return made


def slowest(prior: Prior) -> float:
    """Largest time constant [s] of the prior at rest; that of an integrator or an unstable mode is none."""
    modes = np.linalg.eigvals(flow_slope(prior.equations.xdot)(*rest_of(prior), prior.p).full())
    rates = -modes.real[-modes.real > 1e-9 * np.abs(modes).max(initial=0.0)]
    return float(1.0 / rates.min()) if len(rates) else 0.0


def _place(trajectory: Trajectory) -> tuple[int, list[float]]:
    """Place of a trajectory among others, by what was measured alone."""
    first = np.hstack([trajectory.y, trajectory.u])[:COMPARED_SAMPLES]
    return len(trajectory.t), np.nan_to_num(first, nan=-math.inf).ravel().tolist()


def continued(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """Trajectories that follow each other within a period as one, as a logger that begins new files leaves them.

    Where outputs jump by more than they do within either one, the machine was moved in between: these stay apart.

    Example:
        >>> from scenarios.pendulum.data import exact_runs
        >>> (run,) = exact_runs("train", 1)
        >>> cut = [run.part(slice(100, None)), run.part(slice(0, 100))]
        >>> [len(t.t) for t in continued(cut)] == [len(run.t)]
        True
    """
    found: list[Trajectory] = []
    for t in sorted(trajectories, key=lambda t: float(t.t[0])):
        before = [i for i, one in enumerate(found) if _follows(one, t)]
        before = [i for i in before if found[i].file == t.file] or before
        if len(before) != 1:  # none, or several recordings of the same time
            found.append(t)
            continue
        one = found[before[0]]
        arrays = {
            key: np.concatenate([getattr(one, key), getattr(t, key)])
            for key in ("t", "u", "y", "x", "xdot", "w", "censored")
        }
        found[before[0]] = replace(one, **arrays)
    return found


def _follows(one: Trajectory, other: Trajectory) -> bool:
    """Whether the other trajectory begins a period after the end of the one, with outputs that do not jump."""
    if not abs(float(other.t[0] - one.t[-1]) / one.dt - 1.0) < PUNCTUAL:
        return False
    jump = np.abs(other.y[0] - one.y[-1])
    steps = np.abs(np.concatenate([np.diff(one.y, axis=0), np.diff(other.y, axis=0)]))
    return bool((jump <= np.nan_to_num(steps).max(axis=0)).all())


def _longest(trajectories: Sequence[Trajectory]) -> int:
    return max((len(t.t) for t in trajectories), default=0)


def _lengths(
    train: Sequence[Trajectory], dt: float, unit: float, length: float, lead: int, reach: float
) -> list[int]:
    """Periods of the windows, the longest last; what the recordings do not hold is cut to half of the longest.

    Of a machine on which a small error grows by the larger of ``GROWN`` over ``reach`` [s] two shorter ones come first.
    """
    longest = _longest(train) - 2 * lead - 1  # smoothing under a delay costs as many samples again
    length = min(length, longest * dt)
    wanted = [own for own in (unit * own for own in LENGTHS) if own < 0.7 * length]
    while wanted and length > 1.5 * APART * wanted[-1]:  # from one length to the next errors must stay small
        wanted.append(wanted[-1] * APART)
    wanted.append(length)
    grown = [reach * math.log(own) / math.log(GROWN[-1]) for own in GROWN]
    slow = sorted({min(own, FARTHEST * grown[-1]) for own in wanted if own > 1.5 * grown[-1]})
    if slow:
        wanted = [*grown, *slow]
    fitting = [p for p in (scales.periods(own, dt, 2) for own in wanted) if p <= longest]
    return sorted(dict.fromkeys(fitting)) or [max(2, longest // 2)]


def _starts(
    fit: OutputFit, short: Shooting, long: Shooting, start: Mapping[str, float] | None
) -> list[Array]:
    """What a few steps over short windows find from several starts, what explains long ones best first."""
    found = []
    for one in [fit.nominal, *([] if start is None else [fit.scaled(start)]), *_draws(fit)]:
        try:
            found.append(short.solve(one, START_ITERATIONS).theta)
        except InputError:  # too stiff for the period there
            continue
    return _promising(fit, long, found) if found else [fit.nominal]


def _draws(fit: OutputFit) -> list[Array]:
    """Starts between the bounds."""
    between = qmc.Sobol(len(fit.nominal), seed=0).random_base2(3)[:STARTS]
    return list(fit.lower + between * (fit.upper - fit.lower))


def _further(fit: OutputFit, problem: Shooting, solved: Sequence[Fitted]) -> list[Fitted]:
    """What is found from the nominal values and from draws, one after the other, as long as too much is left."""
    found = list(solved)
    for one in (fit.nominal, *_draws(fit)):
        if min(problem.explained([f.theta for f in found])) <= POOR:
            break
        try:
            found.append(problem.solve(one))
        except InputError:  # too stiff for the period there
            continue
    return found[len(solved) :]


def _promising(fit: OutputFit, problem: Shooting, thetas: Sequence[Array]) -> list[Array]:
    """What explains windows best, and others that do nearly as well and lie elsewhere, the best first."""
    errors = problem.explained(thetas)
    order = sorted(range(len(thetas)), key=errors.__getitem__)
    kept: list[Array] = []
    for i in order:
        far = all(_apart(fit, thetas[i], one) for one in kept)
        if far and errors[i] <= PROMISING * errors[order[0]] and len(kept) < FOLLOWED:
            kept.append(thetas[i])
    return kept


def _apart(fit: OutputFit, one: Array, other: Array) -> bool:
    """Whether two starts are not the same but for what a few steps leave."""
    off = np.abs(one - other)
    share = off / np.maximum(np.maximum(np.abs(one), np.abs(other)), DISTINCT * fit.half)
    return bool(np.max(np.maximum(off / fit.half, share / FACTOR)) > DISTINCT)


def _quiet(problem: Shooting, theta: Array, noise: Array) -> bool:
    """Whether of the windows little more is left than the sensors' noise ``(n_y,)``."""
    share = problem.seen.sum(axis=(0, 1)) / max(problem.seen.sum(), 1)
    least = math.sqrt(float(share @ np.square(noise / problem.spread)))
    return problem.explained([theta])[0] <= QUIET * least


def _with_enough_substeps(fit: OutputFit, problem: Shooting, found: Fitted) -> Fitted:
    """The same fit with integration steps so short that halving them moves no parameter by what counts.

    Their number stays the least of this fit. The move is that of a Gauss-Newton step by the change of the outputs.
    """
    while (substeps := fit.substeps(found.theta)) <= MAX_SUBSTEPS // 2:
        error = np.sqrt(np.diag(found.covariance))
        if (
            problem.shift(found.theta, 2 * substeps) <= np.maximum(SHIFT * error, EXACT * np.abs(found.theta))
        ).all():
            break
        fit.least = 2 * substeps
        problem.forget()
        found = problem.solve(found.theta)
    return found


def _errors_of(thetas: Sequence[Array], parts: Sequence[Shooting]) -> list[float]:
    """Root mean squares of the outputs' errors over their spread, with the first states free, over several parts."""
    squares = np.square([part.explained(thetas) for part in parts])
    return np.sqrt(np.average(squares, axis=0, weights=[part.windows.y.size for part in parts])).tolist()


def _errors(fit: OutputFit, chosen: Fitted) -> dict[str, float]:
    """Standard errors of the parameters that the data tell of."""
    if not len(chosen.covariance):
        return {}
    sizes = np.sqrt(np.maximum(np.diag(chosen.covariance), 0.0)) * fit.unit
    return {p.name: float(e) for p, e in zip(fit.free, sizes, strict=False) if math.isfinite(e)}


def _correlations(fit: OutputFit, chosen: Fitted) -> dict[str, float]:
    """Correlation of the errors of every two parameters that the data tell of, by ``"a, b"``."""
    c = chosen.covariance
    sigma = np.sqrt(np.maximum(np.diag(c), 1e-300)) if len(c) else np.zeros(0)
    told = [i for i in range(min(len(c), len(fit.free))) if math.isfinite(sigma[i])]
    return {
        f"{fit.names[i]}, {fit.names[j]}": float(c[i, j] / (sigma[i] * sigma[j]))
        for k, i in enumerate(told)
        for j in told[k + 1 :]
    }


def _warnings(fit: OutputFit, chosen: Fitted, answered: float = 0.0, gained: float = 0.0) -> tuple[str, ...]:
    """What is doubtful about a fit; ``gained`` is its error over that of the nominal values."""
    warnings = []
    if answered > 1.0:
        warnings.append(
            "inputs answer to the outputs, as in closed loop: parameters may be biased where the machine is disturbed; "
            "predictions were fitted too, and validation chose"
        )
    if not len(chosen.covariance):
        return (*warnings, "no fit improved on the nominal parameters") if fit.free else ()
    if gained > HARDLY:
        warnings.append(
            f"the fit hardly improves on the nominal parameters (its error is {gained:.3f} of theirs): they are right, "
            "or the prior lacks something that no parameter stands for"
        )
    warnings += [str(one) for one in chosen.unidentified]
    for p, value, low, high in zip(fit.free, chosen.theta, fit.lower, fit.upper, strict=False):
        if min(value - low, high - value) < AT_BOUND * (high - low):
            warnings.append(f"{p.label} ends at a bound ({value * (abs(p.value) or p.upper - p.lower):.4g})")
    return tuple(warnings)


def _late(
    fit: OutputFit,
    theta: Array,
    parts: Sequence[Sequence[Trajectory]],
    periods: int,
    sizes: Array,
    first_states: FirstStates,
) -> tuple[str, ...]:
    """A warning where inputs that act later than they are recorded explain the first of the parts, and each other one
    that is long enough, better than parameters alone; both are fitted to the same windows of the first part.
    """
    late = fit.with_delay(LATE * fit.dt)
    known = fit.prior.states, fit.prior.outputs, first_states
    problems: list[Shooting] = []
    for part in parts:
        if (longest := min(periods, _longest(part) - late.lead - 1)) >= 2:
            windows = cut_outputs(part, longest, late.lead, FEW, *known)
            problems.append(Shooting(late, windows, sizes))
        elif not problems:
            return ()
    at_once, no_delay = Shooting(fit, problems[0].windows, sizes), np.append(theta, 0.0)
    slopes, error = problems[0].linear(no_delay, at_once.first_states(theta))
    b, r = slopes.reshape(-1, len(no_delay)), error.ravel()
    without, with_one = (
        float(np.linalg.norm(r - some @ np.linalg.lstsq(some, r, rcond=None)[0])) for some in (b[:, :-1], b)
    )
    if with_one > HOPELESS * without:
        return ()
    at_once = at_once.solve(theta, START_ITERATIONS)
    found = problems[0].solve(np.append(theta, 0.5), START_ITERATIONS)
    both = np.array([problem.explained([np.append(at_once.theta, 0.0), found.theta]) for problem in problems])
    delay, error = found.theta[-1] * fit.dt, math.sqrt(max(found.covariance[-1, -1], 0.0)) * fit.dt
    if not ((both[:, 1] < TELLING * both[:, 0]).all() and delay > max(2.0 * error, SHORTEST * fit.dt)):
        return ()
    left = " and ".join(f"{then / before:.2f}" for before, then in both)
    least = "at least " if found.theta[-1] > (1.0 - AT_BOUND) * LATE else ""
    return (
        f"inputs seem to act {least}{delay:.2g} s later than they are recorded (standard error {error:.1g} s): of the "
        f"error over training and validation recordings this would leave {left}. Let the fit find the delay "
        "(largest_delay of the data), or write the lag of the actuator into the prior",
    )


@lru_cache(maxsize=64)
def _delayed(f: ca.Function) -> ca.Function:
    """``f(x, u, w, p)`` of inputs ``[u, slope by the delay]`` and parameters ``[p, change of the delay]``."""
    x, u, w, p = (ca.SX.sym(f.name_in(i), f.size1_in(i)) for i in range(4))
    slope, change = ca.SX.sym("slope", u.shape[0]), ca.SX.sym("change")
    given = [x, ca.vertcat(u, slope), w, ca.vertcat(p, change)]
    return ca.Function("late", given, [f(x, u + change * slope, w, p)])
