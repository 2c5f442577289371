"""Which physical terms a prior lacks: a search over a library of terms, judged by recordings that were left out.

Each step scores all candidates by one Gauss-Newton step from the present fit, with the parameters and first states, in
every fold; fits the best few in every fold; and keeps one only if it surely lowers the error of free runs over what was
left out. No torch in here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from hybrid_mpc.data.scales import periods as periods_of
from hybrid_mpc.data.scales import robust_spread
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.identifiable import Fitted
from hybrid_mpc.identify.output_fit import OutputFit
from hybrid_mpc.identify.shooting import Shooting
from hybrid_mpc.identify.simulation import Points, visited
from hybrid_mpc.identify.windows import OutputWindows, cut_outputs
from hybrid_mpc.machine import terms as laws
from hybrid_mpc.machine.mechanical import MechanicalPrior
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.signals import Parameter, Signal
from hybrid_mpc.machine.terms import Place, Term, extended
from hybrid_mpc.machine.units import parsed

Array = NDArray[np.float64]
Places = NDArray[np.int64]
FOLDS = 5
"""Groups of recordings that are left out in turn at most."""
BLOCKS = 8
"""Parts of a single recording that count as pieces of evidence."""
WINDOWS = 48
"""Windows of the search at most, shared evenly by the recordings."""
TRIED = 3
"""Candidates of a step that are fitted in every fold."""
STEPS = 8
"""Terms that are added at most."""
ITERATIONS = 12
"""Gauss-Newton steps of a fit that starts near its end."""
WORTH = 0.98
"""Ratio of errors that a term has to reach at least: a parameter that takes off less is not worth its name."""
DOUBT = 0.1
"""Probability that a term that is kept does harm on the next recording, shared by the candidates that were fitted."""
EQUAL = 1.02
"""Ratio of two candidates' errors up to which the data do not tell them apart."""
REACH = 3.0
"""Bound of a term's weight: what it does at most, over what the state's rate is in the recordings."""
FAR = 3.0
"""Errors of a free run count up to so many spreads of their output: one that runs away is as bad as that."""
RIDGE = 1e-6
"""Share that is added to the normal equations' diagonal: columns that are alike stay solvable."""
FEWEST, MANY = 3, 5
"""Pieces of evidence from which on their scatter is known; and recordings from which on each is one piece."""


@dataclass(frozen=True)
class Candidate:
    """A term in one or several forms (of an exponent, an edge), of which the best is taken."""

    name: str
    forms: tuple[Term, ...]


@dataclass(frozen=True)
class Added:
    """A step of the search.

    Args:
        term: The term that was added.
        ratio: Error of free runs over what was left out with the term, over that without [-]; the geometric mean of the
            pieces of evidence.
        upper: Upper bound of it; the chance of a larger one is ``DOUBT`` over the candidates that were fitted.
        error: Root mean square of these errors with the term, over the outputs' spreads [-].
        alternatives: Terms that the data do not tell from it.
    """

    term: Term
    ratio: float
    upper: float
    error: float
    alternatives: tuple[str, ...] = ()


@dataclass(frozen=True)
class Explanation:
    """A prior with the terms that its recordings ask for.

    Args:
        base: The prior's class.
        steps: The terms, in the order in which they were found.
        values: Fitted values [their units] of all parameters by name.
        standard_errors: Their standard errors.
        before: Error of free runs over what was left out without the terms, over the outputs' spreads [-].
        evidence: What pieces of evidence there were, e.g. ``"12 recordings in 5 groups"``.
        tried: Candidates.
        reason: Why the search ended.
    """

    base: type[Prior]
    steps: tuple[Added, ...]
    values: dict[str, float]
    standard_errors: dict[str, float]
    before: float
    evidence: str
    tried: int
    reason: str

    @property
    def terms(self) -> tuple[Term, ...]:
        """The terms."""
        return tuple(step.term for step in self.steps)

    @property
    def prior(self) -> type[Prior]:
        """The prior's class with the terms, its nominal values the fitted ones."""
        return extended(self.base, *self.terms)


def library(prior: Prior, points: Points, dt: float, length: float) -> tuple[Candidate, ...]:
    """Terms that a prior may lack, with bounds and scales from where its machine was.

    Which can apply follows from its structure and units: a state whose rate is another state is an axis' position;
    terms that touch forces need a :class:`~hybrid_mpc.machine.mechanical.MechanicalPrior`.

    Args:
        prior: The prior with fitted values.
        points: States ``(n, n_x)``, inputs ``(n, n_u)`` and disturbances ``(n, n_w)`` of the recordings.
        dt: Model period [s].
        length: Length [s] of the free runs that models are judged by: no lag is longer than a quarter.
    """
    return tuple(_Library(prior, points, dt, length).candidates())


class _Library:
    """Scales of the signals, and the terms that are made with them."""

    def __init__(self, prior: Prior, points: Points, dt: float, length: float) -> None:
        self.prior, self.dt, self.length = prior, dt, length
        self.x, self.u, self.w = points
        rates = prior.equations.xdot(self.x.T, self.u.T, self.w.T, prior.p).full().T
        self.rates = np.sqrt(np.mean(np.square(rates), axis=0))
        self.positions = {v: q for q, v in prior.kinematics}
        self.mechanical = isinstance(prior, MechanicalPrior)
        if isinstance(prior, MechanicalPrior):
            half = self.x.shape[1] // 2
            mass = prior.masses.map(len(self.x))(
                self.x[:, :half].T, np.tile(prior.p, (len(self.x), 1)).T
            ).full()
            mass = mass.reshape(half, len(self.x), half).swapaxes(0, 1)
            forces = np.einsum("nij,nj->ni", mass, rates[:, half:])
            self.rates = np.concatenate([self.rates[:half], np.sqrt(np.mean(np.square(forces), axis=0))])

    def candidates(self) -> Iterator[Candidate]:
        """All of them."""
        exact = set(self.positions.values())
        for i, state in enumerate(self.prior.states):
            if i in self.positions:
                yield from self._axis(i, state)
            elif i not in exact and i in self.prior.corrected:
                yield from self._process(i, state)
        for i, signal in enumerate(self.prior.inputs):
            yield from self._input(i, signal)
        for i, signal in enumerate(self.prior.outputs):
            yield from self._output(i, signal)

    def _weight(
        self, name: str, i: int, size: float, unit: str, *, positive: bool = False, words: str = ""
    ) -> Parameter:
        """A weight of what has this size on the rate of state ``i``."""
        most = REACH * self.rates[i] / max(size, 1e-12)
        return Parameter(name, 0.0, unit, 0.0 if positive else -most, most, words)

    def _axis(self, i: int, state: Signal) -> Iterator[Candidate]:
        own, q = state.name, self.positions[i]
        v, position = self.x[:, i], self.x[:, q]
        speed, turning = float(np.sqrt(np.mean(v**2))), self.prior.states[q].periodic
        if not speed > 0:
            return
        place: Place = "force" if self.mechanical else "rate"
        unit = _force_unit(state.unit) if self.mechanical else f"{state.unit}/s"
        width = 0.05 * speed

        def weight(
            key: str, size: float, per: str = "", positive: bool = False, words: str = ""
        ) -> Parameter:
            return self._weight(f"{key}_{own}", i, size, f"{unit}{per}", positive=positive, words=words)

        per_speed = f" s/{_base(state.unit)}"
        at: dict[str, Any] = {"width": width, "place": place}
        yield _one(laws.coulomb(own, weight("F_c", 1.0, positive=True, words="dry friction"), **at))
        yield _one(
            laws.asymmetric(own, weight("F_a", 1.0, words="dry friction forwards more than backwards"), **at)
        )
        yield _one(laws.viscous(own, weight("d", speed, per_speed, True, "viscous friction"), place=place))
        yield _one(
            laws.viscous_by_direction(
                own, weight("d_a", speed, per_speed, words="viscous friction by direction"), place=place
            )
        )
        yield _one(
            laws.quadratic(
                own, weight("c", speed**2, f" s^2/{_base(state.unit)}^2", True, "drag"), place=place
            )
        )
        yield Candidate(
            f"Stribeck friction of {own}",
            tuple(
                laws.stribeck(
                    own,
                    weight(f"F_s{k}", 0.3, positive=True, words="friction near rest"),
                    speed=share * speed,
                    **at,
                )
                for k, share in enumerate((0.1, 0.3, 1.0), 1)
            ),
        )
        for k, load in enumerate(("driven", "resting", "both"), 1):
            mu = Parameter(f"mu_{k}_{own}", 0.0, "-", 0.0, 2.0, f"friction by {load} load")
            yield _one(laws.loaded(own, mu, load=load, **at))
        centre, span = float(np.mean(position)), float(np.std(position)) or 1.0
        if turning:
            sizes, per = (0.7, 0.7), ("", "")
        else:
            sizes, per = (span, span**2), (f"/{_base(state.unit)}", f"/{_base(state.unit)}^2")
        names = [
            weight(f"F_{k}", size, p, words="dry friction along the way")
            for k, size, p in zip((1, 2), sizes, per, strict=True)
        ]
        yield _one(
            laws.coulomb_by_position(own, *names, turning=turning, centre=0.0 if turning else centre, **at)
        )
        yield _one(laws.offset(own, weight("F_0", 1.0, words="offset"), place=place))
        if not self.mechanical:
            return
        if turning:
            yield _one(
                laws.gravity_error(
                    own, weight("G_s", 0.7, words="gravity by sin q"), weight("G_c", 0.7, words="by cos q")
                )
            )
            yield Candidate(
                f"cogging of {own}",
                tuple(
                    laws.cogging(
                        own, weight(f"C_{n}s", 0.7, words="cogging by sin"), weight(f"C_{n}c", 0.7, words="by cos"),
                        periods=float(n),
                    )
                    for n in (2, 3, 4, 6, 8, 12)
                ),
            )  # fmt: skip
            return
        stiff = f"/{_base(state.unit)}"
        yield _one(laws.spring(own, weight("k", span, stiff, words="stiffness"), centre=centre))
        low, high = np.quantile(position, (0.02, 0.98))
        reach = 0.1 * (high - low)
        yield _one(
            laws.elastic_end(
                own, weight("k_u", reach, stiff, True, "upper end"), edge=float(high - reach), upper=True
            )
        )
        yield _one(
            laws.elastic_end(
                own, weight("k_l", reach, stiff, True, "lower end"), edge=float(low + reach), upper=False
            )
        )

    def _process(self, i: int, state: Signal) -> Iterator[Candidate]:
        own, values, unit = state.name, self.x[:, i], f"{state.unit}/s"
        low, high = float(values.min()), float(values.max())
        temperature = (parsed(state.unit) or (1.0, ()))[1] == (0, 0, 0, 0, 1, 0, 0)

        def weight(
            key: str, size: float, per: str = "", positive: bool = False, words: str = ""
        ) -> Parameter:
            return self._weight(f"{key}_{own}", i, size, f"{unit}{per}", positive=positive, words=words)

        yield _one(laws.offset(own, weight("r_0", 1.0, words="offset of the rate"), place="rate"))
        forms = []
        references: list[tuple[str | float, Array]] = (
            [(0.0, np.zeros(len(values)))]
            if low >= 0 and not temperature
            else [(low, np.full(len(values), low))]
        )
        references += [(s.name, c) for s, c in self._alike(i, state.unit)]
        for number, (reference, other) in enumerate(references, 1):
            far = float(np.sqrt(np.mean((values - other) ** 2))) or 1.0
            for exponent, key in ((1.0, "a"), (1.25, "b"), (0.5, "c"), (2.0, "d")):
                if (temperature and exponent == 0.5) or (exponent == 1.25 and not temperature):
                    continue
                k = weight(f"k_{number}{key}", far**exponent, f"/{state.unit}^{exponent:g}", True, "loss")
                forms.append(laws.loss(own, k, exponent=exponent, reference=reference))
        yield Candidate(f"loss of {own}", tuple(forms))
        if temperature:
            kelvin = 0.0 if state.unit == "K" else 273.15
            size = abs((np.mean(values) + kelvin) ** 4 - (low + kelvin) ** 4) / 1e8 or 1.0
            yield _one(
                laws.radiation(
                    own,
                    weight("e", float(size), " 1e8/K^4", True, "radiation"),
                    kelvin=kelvin,
                    surroundings=low,
                )
            )
        width = 0.02 * (high - low) or 1.0
        edges = [low + share * (high - low) for share in (0.6, 0.75, 0.9)]
        yield Candidate(
            f"overflow of {own}",
            tuple(
                laws.overflow(
                    own,
                    weight(f"s_{n}", high - edge, f"/{state.unit}", True, "overflow"),
                    edge=edge,
                    width=width,
                )
                for n, edge in enumerate(edges, 1)
            ),
        )
        signals = [(s, c) for s, c in self._signals() if s.name != own]
        for s, c in signals:
            scale, centre = float(np.std(c)), float(np.mean(c))
            if scale > 0:
                k = weight(f"k_{_short(s.name)}", scale, f"/{_per(s.unit)}", words=f"of {s.name}")
                yield _one(laws.coupling(own, k, source=s.name, centre=centre))
        everything = [(state, values), *signals]
        for a, (one, c) in enumerate(everything):
            for two, d in everything[a:]:
                size = float(np.std(c) * np.std(d))
                if size > 0:
                    key = f"k_{_short(one.name)}_{_short(two.name)}"
                    k = weight(
                        key,
                        size,
                        f"/{_per(one.unit)}/{_per(two.unit)}",
                        words=f"of {one.name} and {two.name}",
                    )
                    centres = float(np.mean(c)), float(np.mean(d))
                    yield _one(laws.product(own, k, one=one.name, two=two.name, centres=centres))

    def _signals(self) -> Iterator[tuple[Signal, Array]]:
        for group, values in (
            (self.prior.states, self.x),
            (self.prior.inputs, self.u),
            (self.prior.disturbances, self.w),
        ):
            yield from zip(group, values.T, strict=True)

    def _alike(self, i: int, unit: str) -> Iterator[tuple[Signal, Array]]:
        """States and disturbances of the same unit."""
        for k, (s, c) in enumerate(self._signals()):
            if s.unit == unit and k != i and s.name not in {one.name for one in self.prior.inputs}:
                yield s, c

    def _input(self, i: int, signal: Signal) -> Iterator[Candidate]:
        own, values = signal.name, self.u[:, i]
        spread, centre = float(np.std(values)), float(np.mean(values))
        if not spread > 1e-9 * max(abs(centre), 1e-300):
            return

        def of(key: str, most: float, unit: str = "-", words: str = "", positive: bool = False) -> Parameter:
            return Parameter(f"{key}_{own}", 0.0, unit, 0.0 if positive else -most, most, words)

        tau = Parameter(
            f"tau_{own}", 2 * self.dt, "s", self.dt, max(0.25 * self.length, 4 * self.dt), "lag of the input"
        )
        yield _one(laws.input_lag(own, tau, state=replace(signal, name=f"{own}_acting")))
        yield _one(laws.input_gain(own, of("g", 0.9, words="relative error of the gain")))
        yield _one(laws.input_offset(own, of("o", 2 * spread, signal.unit, "offset of the input")))
        if (values < 0).any() and (values > 0).any():
            yield _one(laws.gain_by_direction(own, of("g_a", 0.9, words="gain forwards more than backwards")))
            yield _one(
                laws.dead_zone(own, of("z", spread, signal.unit, "dead zone", True), width=0.05 * spread)
            )
        yield _one(
            laws.input_curve(
                own,
                of("g_c", 0.5, words="bend of the input"),
                centre=centre if centre > 2 * spread else 0.0,
                span=2 * spread,
            )
        )

    def _output(self, i: int, signal: Signal) -> Iterator[Candidate]:
        y = self.prior.equations.output(self.x.T, self.u.T, self.w.T, self.prior.p).full()[i]
        own, spread = signal.name, float(np.std(y))
        if not spread > 0:
            return
        unit = signal.unit

        def of(key: str, most: float, own_unit: str = "-", words: str = "") -> Parameter:
            return Parameter(f"{key}_{own}", 0.0, own_unit, -most, most, words)

        tau = Parameter(
            f"tau_{own}", 2 * self.dt, "s", self.dt, max(0.25 * self.length, 4 * self.dt), "lag of the sensor"
        )
        shown = Signal(f"{own}_shown", unit, signal.lower, signal.upper)
        yield _one(laws.output_lag(own, tau, state=shown))
        yield _one(laws.output_gain(own, of("s_g", 0.5, words="relative error of the sensor's gain")))
        yield _one(laws.output_offset(own, of("s_o", 2 * spread, unit, "offset of the sensor")))
        low, high = (float(v) for v in np.quantile(y, (0.0, 1.0)))
        bend = of("s_b", 0.9 / (high - low), f"1/{_per(unit)}", "bend of the sensor")
        yield _one(laws.output_curve(own, bend, lower=low, upper=high))


def _one(term: Term) -> Candidate:
    return Candidate(term.name, (term,))


def _short(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name)


def _per(unit: str) -> str:
    return unit if unit not in ("-", "") else "1"


def _base(unit: str) -> str:
    """The unit of a position, of that of its speed."""
    return unit.removesuffix("/s")


def _force_unit(unit: str) -> str:
    return "N" if unit.startswith("m") else "N m"


@dataclass(frozen=True)
class _Evidence:
    """Windows with the piece of evidence and the fold of each."""

    windows: OutputWindows
    pieces: Places
    folds: Places
    words: str

    def rows(self, keep: NDArray[np.bool_]) -> OutputWindows:
        """Some windows."""
        w = self.windows
        return replace(
            w, y=w.y[keep], u=w.u[keep], w=w.w[keep], x=w.x[keep], censored=w.censored[keep], known=w.known[keep],
            group=np.arange(int(keep.sum())),
        )  # fmt: skip


def _gathered(known: Sequence[Trajectory], prior: Prior, periods: int, most: int) -> _Evidence:
    """Windows of all recordings, shared evenly, with what is left out together: whole recordings that are alike in
    kind, or blocks of a single one.
    """
    files = sorted({t.file for t in known})
    share = max(2 if len(files) > 1 else most, most // len(files))
    parts, of = [], []
    for number, name in enumerate(files):
        own = [t for t in known if t.file == name and len(t.t) > periods]
        if own:
            parts.append(cut_outputs(own, periods, 0, share, prior.states))
            of += [number] * len(parts[-1].x)
    if not parts:
        raise InputError(
            f"no recording is as long as the free runs of {periods} periods that terms are judged by"
        )
    joined: dict[str, Any] = {
        key: np.concatenate([getattr(p, key) for p in parts])
        for key in ("y", "u", "w", "x", "censored", "known")
    }
    windows = replace(parts[0], **joined, group=np.arange(len(of)))
    recording, present = np.array(of), sorted(set(of))
    groups = min(FOLDS, len(present))
    folds = np.zeros(len(of), dtype=np.int64)
    if groups > 1:
        order = _by_kind(windows, recording, present)
        fold = dict(zip(order, np.arange(len(order)) * groups // len(order), strict=True))
        folds = np.array([fold[own] for own in of])
    if len(present) >= MANY:
        return _Evidence(windows, recording, folds, f"{len(present)} recordings in {groups} groups")
    pieces, count = np.zeros(len(of), dtype=np.int64), 0
    for recorded in present:  # a few recordings are pieces of evidence in parts
        at = np.flatnonzero(recording == recorded)
        blocks = min(len(at), math.ceil(BLOCKS / len(present)))
        pieces[at] = count + np.arange(len(at)) * blocks // len(at)
        count += blocks
    if groups == 1:
        groups = min(FOLDS, count)
        folds = pieces * groups // count
    what = "one recording" if len(present) == 1 else f"{len(present)} recordings"
    return _Evidence(windows, pieces, folds, f"{count} parts of {what} in {groups} groups")


def _by_kind(windows: OutputWindows, pieces: Places, present: Sequence[int]) -> list[int]:
    """Recordings in the order of what differs most between them: mean and size of inputs, outputs and disturbances.

    Neighbours are left out together, so that a group is of another kind than what is fitted: an inner choice flatters
    where it is not.
    """
    rows = []
    for piece in present:
        own = pieces == piece
        columns = np.concatenate([windows.y[own], windows.u[own][:, windows.lead :], windows.w[own]], axis=-1)
        columns = columns.reshape(-1, columns.shape[-1])
        with np.errstate(invalid="ignore"):
            rows.append(np.concatenate([np.nanmean(columns, axis=0), np.nanstd(columns, axis=0)]))
    table = np.nan_to_num(np.array(rows))
    scale = table.std(axis=0)
    table = (table - table.mean(axis=0)) / np.where(scale > 0, scale, 1.0)
    direction = np.linalg.svd(table, full_matrices=False)[2][0]
    return [present[k] for k in np.argsort(table @ direction, kind="stable")]


@dataclass
class _Search:
    """The search's recordings, and what it has computed."""

    base: type[Prior]
    dt: float
    evidence: _Evidence
    sizes: Array
    points: Points
    spread: Array
    fits: dict[tuple[Term, ...], OutputFit] = field(default_factory=dict)

    def fit(self, terms: tuple[Term, ...]) -> OutputFit:
        """The fit of the prior with terms."""
        if terms not in self.fits:
            own = OutputFit(extended(self.base, *terms), self.dt)
            x, u, w = self.points
            added = [
                u[:, self._place(t)] if t.place == "input" else self._shown(x, u, w)[:, self._place(t)]
                for t in _lags(terms)
            ]
            own.points = np.column_stack([x, *added]), u, w
            self.fits[terms] = own
        return self.fits[terms]

    def problem(self, terms: tuple[Term, ...], windows: OutputWindows) -> Shooting:
        """Windows that the prior with terms is fitted to."""
        fit, sizes, first, known = self.fit(terms), self.sizes, windows.x, windows.known
        for term in _lags(terms):
            k = self._place(term)
            own = windows.u[:, windows.lead, k] if term.place == "input" else windows.y[:, 0, k]
            size = float(np.std(self.points[1][:, k])) if term.place == "input" else float(self.spread[k])
            first = np.column_stack([first, np.where(np.isfinite(own), own, np.nanmean(own))])
            known = np.column_stack([known, np.zeros(len(own), dtype=bool)])
            sizes = np.append(sizes, size or 1.0)
        return Shooting(fit, replace(windows, x=first, known=known), sizes, self.spread)

    def _place(self, term: Term) -> int:
        """Place of the signal that a term lags behind."""
        group = self.base.inputs if term.place == "input" else self.base.outputs
        return [s.name for s in group].index(term.of)

    def _shown(self, x: Array, u: Array, w: Array) -> Array:
        prior = self.base()
        return np.asarray(prior.equations.output(x.T, u.T, w.T, prior.p).full().T)

    def left_out(self, terms: tuple[Term, ...], theta: Array) -> Array:
        """Squared errors ``(n,)`` of every window by a fit to the other folds, each from ``theta`` on."""
        squares = np.zeros(len(self.evidence.folds))
        for fold in sorted(set(self.evidence.folds.tolist())):
            held = self.evidence.folds == fold
            fitted = self.problem(terms, self.evidence.rows(~held)).solve(theta, ITERATIONS).theta
            squares[held] = _squares(self.problem(terms, self.evidence.rows(held)), fitted)
        return squares

    def begun(self, terms: tuple[Term, ...], theta: Array) -> tuple[Fitted, Shooting]:
        """A fit to all windows from ``theta`` of the terms but the last."""
        problem = self.problem(terms, self.evidence.windows)
        start = np.concatenate([theta, self.fit(terms).nominal[len(theta) :]])
        return problem.solve(start, ITERATIONS), problem

    def scores(self, terms: tuple[Term, ...], theta: Array, forms: Sequence[Term]) -> Array:
        """Logarithm of the ratio ``(len(forms),)`` of errors over what is left out that each term promises, to first
        order: by a Gauss-Newton step of all parameters and first states in every fold.
        """
        joint = (*terms, *forms)
        problem = self.problem(joint, self.evidence.windows)
        begun = self.problem(terms, self.evidence.windows).first_states(theta)
        own = self.fit(joint)
        start = np.concatenate([theta, np.zeros(len(own.nominal) - len(theta))])
        slopes, errors = problem.linear(start, begun)
        every = np.concatenate([slopes, errors[..., None]], axis=-1)
        normal = every.swapaxes(1, 2) @ every  # (n, k + 1, k + 1)
        low, high = own.lower - start, own.upper - start
        present = list(range(len(theta)))
        places, count = [], len(theta)
        for form in forms:
            free = [p for p in form.parameters if not p.fixed]
            places.append(list(range(count, count + len(free))))
            count += len(free)
        held = [
            normal[self.evidence.folds == f].sum(axis=0) for f in sorted(set(self.evidence.folds.tolist()))
        ]
        total = np.sum(held, axis=0)

        def left(columns: list[int]) -> float:
            cost = 0.0
            for own_held in held:
                step = _step(total - own_held, columns, low, high)
                moved = own_held[np.ix_(columns, columns)] @ step
                cost += own_held[-1, -1] + 2.0 * float(own_held[columns, -1] @ step) + float(step @ moved)
            return max(cost, 1e-300)

        plain = left(present)
        return np.array([0.5 * math.log(left(present + place) / plain) for place in places])


def _lags(terms: Sequence[Term]) -> list[Term]:
    """Those with a state of their own, in order."""
    return [term for term in terms if term.state is not None]


def _step(normal: Array, columns: list[int], low: Array, high: Array) -> Array:
    """The bounded Gauss-Newton step of some columns: those that would leave their bounds end there."""
    matrix, slope = normal[np.ix_(columns, columns)], normal[columns, -1]
    matrix = matrix + RIDGE * np.diag(np.diag(matrix) + 1e-300)
    step, free = np.zeros(len(columns)), np.ones(len(columns), dtype=bool)
    for _ in range(len(columns)):
        own = matrix[np.ix_(free, free)]
        step[free] = -np.linalg.lstsq(
            own, slope[free] + matrix[np.ix_(free, ~free)] @ step[~free], rcond=None
        )[0]
        clipped = np.clip(step, low[columns], high[columns])
        beyond = free & (clipped != step)
        if not beyond.any():
            break
        step, free = np.where(beyond, clipped, step), free & ~beyond
    return step


def _squares(problem: Shooting, theta: Array) -> Array:
    """Mean squared error ``(n,)`` of each window's free run over the outputs' spreads, from its best first state."""
    x = problem.first_states(theta)
    point = problem.start(theta, x, "")
    n = len(x)
    over = (
        np.clip(point.error / np.tile(problem.spread, problem.windows.y.shape[1]), -FAR, FAR) * problem.count
    )
    seen = (problem.seen.reshape(n, -1) * problem.count).sum(axis=1)
    return np.asarray(np.square(over).sum(axis=1) / np.maximum(seen, 1.0))


@dataclass(frozen=True)
class _Compared:
    """Squared errors of one model over another's, by pieces of evidence."""

    ratio: float
    upper: float
    error: float


def _compared(own: Array, other: Array, pieces: Places, doubt: float) -> _Compared:
    sums = [np.bincount(pieces, v) for v in (own, other)]
    sums = [s[np.bincount(pieces) > 0] for s in sums]
    each = 0.5 * np.log(np.maximum(sums[0], 1e-300) / np.maximum(sums[1], 1e-300))
    n, error = len(each), float(np.sqrt(own.mean()))
    upper = math.inf
    if n >= FEWEST:
        upper = float(each.mean() + student.ppf(1.0 - doubt, n - 1) * each.std(ddof=1) / math.sqrt(n))
    return _Compared(math.exp(float(each.mean())), math.exp(min(upper, 700.0)), error)


def explain(
    base: type[Prior],
    values: dict[str, float],
    known: Sequence[Trajectory],
    *,
    dt: float,
    length: float,
    candidates: Sequence[Candidate] | None = None,
    on_progress: Callable[[int, int, str], None] = lambda done, total, text: None,
) -> Explanation:
    """Search for the terms that a fitted prior lacks.

    Args:
        base: The prior's class.
        values: Its fitted values [their units] by name.
        known: Recordings with inputs that act and smoothed states (:func:`~hybrid_mpc.identify.fit.smoothed`).
        dt: Model period [s].
        length: Length [s] of the free runs that models are judged by.
        candidates: Terms to choose from. Default: :func:`library`.
        on_progress: ``(done, total, text)`` after every fit.

    Raises:
        InputError: If no recording is as long as that.
    """
    prior = base(values)
    longest = max(len(t.t) for t in known) - 1
    if len({t.file for t in known}) == 1:  # parts of a single recording are its evidence
        longest = max(sum(len(t.t) for t in known) // BLOCKS - 1, 2)
    periods = min(periods_of(length, dt, 2), longest)
    evidence = _gathered(known, prior, periods, WINDOWS)
    points = visited(known)
    columns = np.concatenate([t.x for t in known]).T
    sizes = np.array([robust_spread(c) or 1.0 for c in columns])
    y = evidence.windows.y
    spread = np.array([robust_spread(c) or 1.0 for c in y.reshape(-1, y.shape[-1]).T])
    search = _Search(base, dt, evidence, sizes, points, spread)
    pool = list(library(prior, points, dt, length) if candidates is None else candidates)
    tried = len(pool)
    terms: tuple[Term, ...] = ()
    theta = search.problem((), evidence.windows).solve(search.fit(()).scaled(values), ITERATIONS).theta
    present = search.left_out((), theta)
    before = float(np.sqrt(present.mean()))
    steps: list[Added] = []
    reason = f"{STEPS} terms were added"
    for number in range(STEPS):
        on_progress(number, STEPS, f"{len(pool)} candidates beside {len(terms)} terms")
        plain = [(k, form) for k, one in enumerate(pool) for form in one.forms if form.state is None]
        promised = search.scores(terms, theta, [form for _, form in plain])
        best = {
            k: min((score, i) for i, score in enumerate(promised) if plain[i][0] == k)
            for k in {k for k, _ in plain}
        }
        scored = [(score, k, plain[i][1]) for k, (score, i) in best.items()]
        now = math.log(float(_squares(search.problem(terms, evidence.windows), theta).mean()))
        for k, one in enumerate(pool):
            if one.forms[0].state is not None:  # at once a lag does what no slope tells
                own, problem = search.begun((*terms, one.forms[0]), theta)
                scored.append(
                    (0.5 * (math.log(float(_squares(problem, own.theta).mean())) - now), k, one.forms[0])
                )
        scored = sorted((one for one in scored if one[0] < math.log(WORTH)), key=lambda one: one[0])[:TRIED]
        if not scored:
            reason = "no other term promises to lower the error"
            break
        results = []
        for _, k, form in scored:
            with_it = (*terms, form)
            own, _ = search.begun(with_it, theta)
            squares = search.left_out(with_it, own.theta)
            results.append(
                (_compared(squares, present, evidence.pieces, DOUBT / len(scored)), form, own, squares, k)
            )
        results.sort(key=lambda r: r[0].ratio)
        sure = [
            r for r in results if r[0].ratio < WORTH and r[0].upper < 1.0 and r[3].mean() < present.mean()
        ]
        if not sure:
            found, form, *_ = results[0]
            reason = f"{form.name} has {found.ratio:.2f} of the error ({_bound(found.upper)}): not sure"
            break
        found, form, own, squares, k = sure[0]
        alike = tuple(r[1].name for r in results if r[1] is not form and r[0].ratio < EQUAL * found.ratio)
        steps.append(Added(form, found.ratio, found.upper, found.error, alike))
        terms, theta, present = (*terms, form), own.theta, squares
        pool.pop(k)
    fit = search.fit(terms)
    last = search.problem(terms, evidence.windows).solve(theta, ITERATIONS)
    errors = (
        np.sqrt(np.maximum(np.diag(last.covariance), 0.0)) * fit.unit if len(last.covariance) else np.zeros(0)
    )
    return Explanation(
        base, tuple(steps), fit.values(last.theta), dict(zip(fit.names, errors.tolist(), strict=True)), before,
        evidence.words, tried, reason,
    )  # fmt: skip


def _bound(upper: float) -> str:
    return f"at most {upper:.2f}" if math.isfinite(upper) and upper < 1e6 else "without a bound"
