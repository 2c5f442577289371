"""Linear models from recordings, as baselines: ARX and subspace (N4SID, CVA). No torch in here."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from hybrid_mpc.data.differentiate import positive
from hybrid_mpc.data.excitation import is_constant
from hybrid_mpc.errors import InputError, named_extra, refuse
from hybrid_mpc.model.riccati import dare

Array = NDArray[np.float64]
RANK = 1e-6
"""Share of the largest singular value below which a value counts as zero: rounding of a file."""
Weighting: TypeAlias = Literal["cva", "n4sid"]
ORDERS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 25, 32)
"""Default orders to try: lags of an ARX model, states of a subspace model."""
MOST_STATES = 16
"""Largest of ``ORDERS`` for a subspace model."""
DELAYS = (1, 2, 3, 4, 6, 8, 12, 16)
"""Default input delays [samples] of an ARX model; 1 is no delay besides the sampling."""
DELAYED = 0.1
"""Largest delay over the length of the longest recording."""
HORIZONS = (5, 10, 20, 40)
"""Default numbers of past samples, and of future samples, of a subspace model."""
ROWS = 3
"""Minimum number of equations per unknown of a candidate; with fewer, a candidate fits the noise."""
STABLE = 1 + 1e-9
"""Largest spectral radius that counts as stable: 1 for an exact integrator, with rounding."""
ALIKE = 1.01
"""Ratio of free-run errors up to which two candidates count as equal; the smaller order is then used."""
ROUNDING = 1e-7
"""Free-run error, over a signal's spread, below which two candidates count as equal (data without noise). A regression
on normal equations has errors of about 1e-8, which accumulate in a free run."""
SMALLEST = 1e-20
"""Minimum variance of noise over a signal's variance: rounding in data without noise."""
ROUNDED = 1e-12
"""Minimum variance of noise in any direction over the sum of the variances: rounding in a covariance."""
LOST = 1e-10
"""Share of the largest singular value of past or future below which a direction is rounding."""
BLOCK = 20_000
"""Rows that are factorized together, and maximum samples of a free run for the fit of B."""


class Measured(Protocol):
    """A recording on a uniform grid; measured disturbances ``w`` ``(n, n_w)``, if any, are appended to the inputs."""

    @property
    def y(self) -> Array:
        """Measured outputs ``(n, n_y)``; NaN where a sample is missing."""

    @property
    def u(self) -> Array:
        """Inputs ``(n, n_u)``, held from their sample to the next."""


@dataclass(frozen=True)
class Candidate:
    """A candidate model: its orders, its free-run error and its stability.

    Args:
        order: Lags of an ARX model, states of a subspace model.
        delay: Input delay [samples] of an ARX model; 0 for a subspace model.
        horizon: Past samples, and future samples, of a subspace model; 0 for an ARX model.
        error: Root mean square error of free runs on the validation recordings, over each output's spread; about 1 for
            a constant mean. Infinite if a run diverges, or the model has no one-step predictor for its initial state.
        radius: Largest absolute eigenvalue.
    """

    order: int
    delay: int
    horizon: int
    error: float
    radius: float

    @property
    def stable(self) -> bool:
        """Whether no eigenvalue lies outside the unit circle, up to rounding."""
        return self.radius <= STABLE

    @property
    def text(self) -> str:
        """Order, delay and horizon as text: ``"order 2, delay 1"``."""
        own = {"order": self.order, "delay": self.delay, "horizon": self.horizon}
        return ", ".join(f"{key} {value}" for key, value in own.items() if value)


@dataclass(frozen=True)
class LinearModel:
    """A linear model ``x+ = A x + B u + K e + bias``, ``y = C x + D u + e``; e is its one-step error.

    The matrices act on centred and scaled signals, ``(u - u_centre) / u_scale`` and ``(y - y_centre) / y_scale``;
    :meth:`state_space` is in the signals' units. Inputs are those of the recordings, then their measured disturbances.

    Args:
        name: ``"ARX"`` or ``"N4SID"``.
        dt: Period [s].
        A: ``(n_x, n_x)``.
        B: ``(n_x, n_u)``.
        C: ``(n_y, n_x)``.
        D: ``(n_y, n_u)``; zero unless a direct path was requested.
        K: Gain of the one-step predictor ``(n_x, n_y)``; that of an ARX model has no memory beyond its lags.
        bias: ``(n_x,)``; the mean of the recordings need not be an equilibrium.
        noise: Covariance of e ``(n_y, n_y)``.
        spread: Covariance of x over the training recordings ``(n_x, n_x)``, for the initial state of a free run.
        u_centre: Means of the inputs ``(n_u,)`` over the training recordings.
        u_scale: Standard deviations of the inputs ``(n_u,)``.
        y_centre: Means of the outputs ``(n_y,)``.
        y_scale: Standard deviations of the outputs ``(n_y,)``.
        chosen: The candidate of this model.
        candidates: All candidates that were tried.
        warnings: Warnings about the recordings or the model. Default: none.
    """

    name: str
    dt: float
    A: Array
    B: Array
    C: Array
    D: Array
    K: Array
    bias: Array
    noise: Array
    spread: Array
    u_centre: Array
    u_scale: Array
    y_centre: Array
    y_scale: Array
    chosen: Candidate
    candidates: tuple[Candidate, ...]
    warnings: tuple[str, ...] = ()

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Eigenvalues of A ``(n_x,)``."""
        return np.asarray(np.linalg.eigvals(self.A), dtype=complex)

    def free_run(self, y_past: Array, u: Array) -> Array:
        """Compute free runs from the inputs alone after a measured warm-up; all windows at once.

        The state after the warm-up is the most likely one: the predictor runs over the warm-up, and its initial state
        minimizes the one-step errors, with ``spread`` as prior covariance. For an ARX model whose warm-up holds its
        lags, the state is these lags.

        Args:
            y_past: Outputs measured in the warm-up ``(..., warm, n_y)``; NaN where a sample is missing.
            u: Inputs ``(..., n, n_u)`` from the first sample of the warm-up on; n is at least ``warm``.

        Returns:
            ``(..., n - warm, n_y)``: the outputs from sample ``warm`` on.

        Raises:
            InputError: If shapes do not fit, or an input is not finite.

        Source: the predictor in innovations form; Ljung, *System Identification*, 2nd edition, 1999, section 4.3.
        """
        y, v = np.asarray(y_past, dtype=float), np.asarray(u, dtype=float)
        n_y, n_u = len(self.y_scale), len(self.u_scale)
        if (
            y.ndim < 2
            or v.ndim != y.ndim
            or y.shape[:-2] != v.shape[:-2]
            or (y.shape[-1], v.shape[-1]) != (n_y, n_u)
        ):
            raise InputError(
                f"free run: y_past has the shape {y.shape} and u {v.shape}; give (..., warm, {n_y}) and (..., n, "
                f"{n_u}) with equal leading dimensions (measured disturbances are the last columns of u) "
                "[HM-IDENTIFY-021]"
            )
        warm, n = y.shape[-2], v.shape[-2]
        if not 1 <= warm <= n:
            raise InputError(
                f"free run: y_past has {warm} samples and u has {n}; give at least one warm-up sample, and inputs of "
                "the warm-up and the free run [HM-IDENTIFY-022]"
            )
        if not np.isfinite(v).all():
            raise InputError(
                "free run: an input is not finite, but a free run needs all inputs. Fill the gap first "
                "[HM-IDENTIFY-023]"
            )
        y, v = (y - self.y_centre) / self.y_scale, (v - self.u_centre) / self.u_scale
        windows = math.prod(y.shape[:-2])
        x0 = self._start(y.reshape(windows, warm, n_y), v.reshape(windows, n, n_u)[:, :warm])
        v = v[..., warm:, :]
        x = _states(self.A, v @ self.B.T + self.bias, x0.reshape(*y.shape[:-2], len(self.A)))
        return np.asarray((x @ self.C.T + v @ self.D.T) * self.y_scale + self.y_centre)

    def free_runs(self, recordings: Sequence[Measured], warm: int) -> list[Array]:
        """:meth:`free_run` of recordings that may differ in length; their first ``warm`` samples are the warm-up.

        Args:
            recordings: The recordings.
            warm: Samples of the warm-up.

        Returns:
            For each recording the outputs from sample ``warm`` on ``(n - warm, n_y)``.
        """
        pairs = [_signals(r) for r in recordings]
        refuse([
            f"recording {i + 1}: {len(y)} samples are too few for a free run after a warm-up of {warm}. Give a longer "
            "one [HM-IDENTIFY-024]"
            for i, (y, _) in enumerate(pairs) if len(y) <= warm
        ])  # fmt: skip
        longest = max((len(y) for y, _ in pairs), default=0)
        if not pairs:
            return []
        u = np.stack([np.pad(u, ((0, longest - len(u)), (0, 0)), mode="edge") for _, u in pairs])
        y_hat = self.free_run(np.stack([y[:warm] for y, _ in pairs]), u)
        return [one[: len(y) - warm] for one, (y, _) in zip(y_hat, pairs, strict=True)]

    def state_space(self) -> Any:
        """``control.StateSpace`` of deviations of u and y, in their units, with period ``dt``.

        Raises:
            InputError: If python-control is not installed.
        """
        with named_extra("a state space"):
            import control
        scale = self.y_scale[:, None]
        return control.ss(
            self.A, self.B / self.u_scale, self.C * scale, self.D * scale / self.u_scale, self.dt,
            remove_useless_states=False, name=self.name,
        )  # fmt: skip

    def _start(self, y: Array, u: Array) -> Array:
        """Most likely states ``(windows, n_x)`` after warm-ups of scaled signals ``(windows, warm, ...)``."""
        x_end = np.empty((len(y), len(self.A)))
        seen = np.isfinite(y)
        patterns, which = np.unique(seen.reshape(len(y), -1), axis=0, return_inverse=True)
        whiten = np.linalg.inv(np.linalg.cholesky(self.noise))
        for i, pattern in enumerate(patterns.reshape(-1, *seen.shape[1:])):
            of = which.ravel() == i
            x, slope = np.zeros((int(of.sum()), len(self.A))), _root(self.spread)
            errors, slopes = [], []
            for k, there in enumerate(pattern):
                e = np.where(there, y[of, k] - x @ self.C.T - u[of, k] @ self.D.T, 0.0)
                by_start = there[:, None] * (self.C @ slope)
                errors.append(e @ whiten.T)
                slopes.append(whiten @ by_start)
                x = x @ self.A.T + u[of, k] @ self.B.T + self.bias + e @ self.K.T
                slope = self.A @ slope - self.K @ by_start
            n_z = slope.shape[1]
            rows = np.vstack([*slopes, np.eye(n_z)])
            right = np.hstack([*errors, np.zeros((len(x), n_z))])
            x_end[of] = x + np.linalg.lstsq(rows, right.T, rcond=None)[0].T @ slope.T
        return x_end


def fit_arx(
    train: Sequence[Measured],
    valid: Sequence[Measured],
    dt: float,
    *,
    warm: int,
    orders: Sequence[int] | None = None,
    delays: Sequence[int] | None = None,
) -> LinearModel:
    """Fit ARX models ``y_k = sum A_i y_(k-i) + sum B_j u_(k-d-j) + c + e_k`` and select by free runs.

    Each candidate is fitted by least squares on one-step errors, with as many lags of u as of y. The stable candidate
    with the least free-run error on the validation recordings is used; an unstable one only if no candidate is stable.

    Args:
        train: Training recordings, of any lengths.
        valid: Validation recordings, which select the order.
        dt: Period [s].
        warm: Samples of the warm-up of each validation recording.
        orders: Numbers of lags to try. Default: those of ``ORDERS`` for which the recordings have three equations
            per unknown.
        delays: Input delays d [samples] to try; 0 is a direct path. Default: those of ``DELAYS`` up to a tenth of the
            longest recording.

    Returns:
        The model; its state consists of its lags.

    Raises:
        InputError: If recordings are too short or have different numbers of columns, an input or an output is constant,
            an input is not finite, or an argument is out of range.

    Source: Ljung, *System Identification*, 2nd edition, 1999, sections 4.2 and 10.1.

    Example:
        >>> from types import SimpleNamespace
        >>> def tank(seed, n=200):
        ...     u = np.random.default_rng(seed).normal(size=(n, 1))
        ...     y = np.full((n, 1), 300.0)
        ...     for k in range(n - 1):
        ...         y[k + 1] = 30 + 0.9 * y[k] + 2 * u[k]
        ...     return SimpleNamespace(y=y, u=u)
        >>> model = fit_arx([tank(0), tank(1)], [tank(2)], 0.5, warm=5)
        >>> model.chosen.order, model.chosen.delay, model.poles.real.round(6).tolist()
        (1, 1, [0.9])
        >>> test = tank(3)
        >>> y_hat = model.free_run(test.y[:5], test.u)
        >>> y_hat.shape, bool(np.abs(y_hat - test.y[5:]).max() < 1e-9)
        ((195, 1), True)
    """
    data = _checked(train, valid, dt, warm)
    most = max(1.0, DELAYED * max(len(y) for y, _ in data.runs))
    shifts = _naturals(delays, [d for d in DELAYS if d <= most], "delays", 0)
    enough, short = [], []
    for order in _naturals(orders, ORDERS, "orders", 1):
        lags = max(order, order + max(shifts) - 1)
        needed = ROWS * (1 + order * (data.n_y + data.n_u))
        if (rows := _windows(data, lags + 1)) >= needed:
            enough.append(order)
        else:
            short.append(
                f"order {order} with delays up to {max(shifts)} needs {needed} runs of {lags + 1} samples, one "
                f"recording of {needed + lags}; there are {rows}"
            )
    _long_enough(enough, short, orders is None, data)

    def candidates() -> Iterator[LinearModel]:
        for order in enough:
            yield from _arx(data, dt, order, shifts)

    return _best(candidates(), valid, warm)


def fit_subspace(
    train: Sequence[Measured],
    valid: Sequence[Measured],
    dt: float,
    *,
    warm: int,
    orders: Sequence[int] | None = None,
    horizons: Sequence[int] | None = None,
    weighting: Weighting = "cva",
    direct: bool = False,
) -> LinearModel:
    """Fit state-space models by a subspace method and select by free runs.

    A and C follow from the shift of the extended observability matrix. B, D and the bias minimize the free-run error
    over the training recordings, with a free initial state for each recording. K solves the Riccati equation of the
    residuals. Windows with a missing sample are left out. Recordings in closed loop bias A.

    Args:
        train: Training recordings, of any lengths.
        valid: Validation recordings, which select order and horizon.
        dt: Period [s].
        warm: Samples of the warm-up of each validation recording.
        orders: Numbers of states to try. Default: ``ORDERS`` up to 16.
        horizons: Numbers of past samples, and of future samples, to try. Default: those of ``HORIZONS`` for which the
            recordings have three windows per unknown.
        weighting: ``"cva"`` (canonical variates) or ``"n4sid"``. Default: ``"cva"``.
        direct: True: with a direct path D. Default: False; an input acts from the next sample on.

    Returns:
        The model.

    Raises:
        InputError: As :func:`fit_arx`.

    Source: Van Overschee and De Moor, *Subspace Identification for Linear Systems*, 1996, chapter 4 and its table of
    weightings; Larimore, *Canonical variate analysis in identification, filtering, and adaptive control*, CDC 1990.

    Example:
        >>> from types import SimpleNamespace
        >>> def oven(seed, n=300):
        ...     u, x = np.random.default_rng(seed).normal(size=(n, 1)), np.zeros((n, 2))
        ...     for k in range(n - 1):
        ...         x[k + 1] = [0.9 * x[k, 0] + u[k, 0], 0.8 * x[k, 1] + 0.2 * x[k, 0]]
        ...     return SimpleNamespace(y=300 + x[:, 1:], u=u)
        >>> model = fit_subspace([oven(0), oven(1)], [oven(2)], 0.5, warm=10)
        >>> model.chosen.order, np.sort(model.poles.real).round(6).tolist()
        (2, [0.8, 0.9])
    """
    data = _checked(train, valid, dt, warm)
    if weighting not in ("cva", "n4sid"):
        raise InputError(
            f"fit_subspace: unknown weighting {weighting!r}; choose 'cva' or 'n4sid' [HM-IDENTIFY-025]"
        )
    states = _naturals(orders, [n for n in ORDERS if n <= MOST_STATES], "orders", 1)
    enough, short = [], []
    for horizon in _naturals(horizons, HORIZONS, "horizons", 2):
        needed = ROWS * (1 + 2 * horizon * (data.n_u + data.n_y))
        if min(states) > (horizon - 1) * data.n_y:
            short.append(f"horizon {horizon} is too short for {min(states)} states of {data.n_y} outputs")
        elif (rows := _windows(data, 2 * horizon)) < needed:
            short.append(
                f"horizon {horizon} (up to {(horizon - 1) * data.n_y} states) needs {needed} runs of {2 * horizon} "
                f"samples, one recording of {needed + 2 * horizon - 1}; there are {rows}"
            )
        else:
            enough.append(horizon)
    _long_enough(enough, short, horizons is None, data)

    def candidates() -> Iterator[LinearModel | Candidate]:
        for horizon in enough:
            yield from _subspace(data, dt, horizon, states, weighting, direct)

    return _best(candidates(), valid, warm)


@dataclass(frozen=True)
class _Data:
    """Training recordings ``(y, u)``, centred and scaled; ``still`` are the indices of constant inputs."""

    runs: tuple[tuple[Array, Array], ...]
    u_centre: Array
    u_scale: Array
    y_centre: Array
    y_scale: Array
    still: tuple[int, ...]

    @property
    def n_y(self) -> int:
        return len(self.y_scale)

    @property
    def n_u(self) -> int:
        return len(self.u_scale)


def _signals(recording: Measured) -> tuple[Array, Array]:
    """Outputs, and inputs with measured disturbances, as float arrays."""
    u, w = np.asarray(recording.u, dtype=float), getattr(recording, "w", None)
    if w is not None and u.ndim == 2 and np.ndim(w) == 2 and len(w) == len(u):
        u = np.hstack([u, np.asarray(w, dtype=float)])
    elif w is not None:
        raise InputError(
            f"measured disturbances w: shape {np.shape(w)}; give ({len(u)}, n_w), as many rows as u [HM-IDENTIFY-026]"
        )
    return np.asarray(recording.y, dtype=float), u


def _checked(train: Sequence[Measured], valid: Sequence[Measured], dt: float, warm: int) -> _Data:
    """Check and scale the training data; the error lists all problems together."""
    problems = []
    if not positive(dt):
        problems.append(f"dt: got {dt!r:.80}; give a period above 0 s [HM-IDENTIFY-027]")
    if isinstance(warm, bool) or not isinstance(warm, int | np.integer) or warm < 1:
        problems.append(f"warm: got {warm}; give a whole number of samples, at least 1 [HM-IDENTIFY-028]")
    for role, recordings in (("training", train), ("validation", valid)):
        if not len(recordings):
            problems.append(
                f"{role} recordings: none given; give training recordings and validation recordings"
                " [HM-IDENTIFY-029]"
            )
    refuse(problems)
    pairs = {
        f"{role} recording {i + 1}": _signals(r)
        for role, recordings in (("training", train), ("validation", valid)) for i, r in enumerate(recordings)
    }  # fmt: skip
    columns = [np.shape(v)[1:] for v in next(iter(pairs.values()))]
    for name, (y, u) in pairs.items():
        if y.ndim != 2 or u.ndim != 2 or len(y) != len(u) or not y.shape[1] or not u.shape[1]:
            problems.append(
                f"{name}: y has the shape {y.shape}, u {u.shape}; give (n, n_y) and (n, n_u), one row for each sample"
                " [HM-IDENTIFY-030]"
            )
        elif [len(shape) for shape in columns] == [1, 1] and [y.shape[1:], u.shape[1:]] != columns:
            problems.append(
                f"{name}: {y.shape[1]} outputs and {u.shape[1]} inputs (with measured disturbances); training "
                f"recording 1 has {columns[0][0]} and {columns[1][0]}; give all recordings the same columns"
                " [HM-IDENTIFY-031]"
            )
        elif not np.isfinite(u).all():
            problems.append(
                f"{name}: an input is not finite; cut the recording there or fill the gap [HM-IDENTIFY-032]"
            )
        elif np.isinf(y).any():
            problems.append(f"{name}: an output is infinite; a missing sample is NaN [HM-IDENTIFY-033]")
        elif name.startswith("valid") and not np.isfinite(y[warm:]).any(axis=0).all():
            problems.append(
                f"{name}: {len(y)} samples, but an output is never measured after the warm-up of {warm}. Record longer"
                " [HM-IDENTIFY-034]"
            )
    refuse(problems)
    runs = list(pairs.values())[: len(train)]
    y, u = np.concatenate([y for y, _ in runs]), np.concatenate([u for _, u in runs])
    n_commanded = np.asarray(train[0].u).shape[1]
    still = [j for j in range(u.shape[1]) if is_constant(u[:, j])]
    for j in range(y.shape[1]):
        seen = y[np.isfinite(y[:, j]), j]
        if not len(seen) or is_constant(seen):
            problems.append(
                f"output {j + 1}: constant in the training recordings. Remove this output, or record it in motion "
                "[HM-IDENTIFY-035]"
            )
    problems += [
        f"input {j + 1}: constant in the training recordings, so its effect is unknown. Remove this input, or give "
        "recordings in which it changes [HM-IDENTIFY-036]"
        for j in still if j < n_commanded
    ]  # fmt: skip
    refuse(problems)
    u_scale = np.array([1.0 if j in still else s for j, s in enumerate(u.std(axis=0))])
    u_centre, y_centre, y_scale = u.mean(axis=0), np.nanmean(y, axis=0), np.nanstd(y, axis=0)
    scaled = tuple(((y - y_centre) / y_scale, (u - u_centre) / u_scale) for y, u in runs)
    return _Data(scaled, u_centre, u_scale, y_centre, y_scale, tuple(still))


def _naturals(given: Sequence[int] | None, default: Sequence[int], name: str, least: int) -> list[int]:
    """Check whole numbers; return them sorted, without duplicates."""
    values = list(default if given is None else given)
    if not values or any(
        isinstance(v, bool) or not isinstance(v, int | np.integer) or v < least for v in values
    ):
        raise InputError(
            f"{name}: got {values}; give at least one number, all of them whole and at least {least}"
            " [HM-IDENTIFY-037]"
        )
    return sorted({int(v) for v in values})


def _windows(data: _Data, length: int) -> int:
    """Number of windows of ``length`` samples without a missing sample; windows may overlap."""
    return sum(
        int(sliding_window_view(np.isfinite(y).all(axis=1), length).all(axis=1).sum())
        for y, _ in data.runs
        if len(y) >= length
    )


def _long_enough(enough: Sequence[int], short: Sequence[str], default: bool, data: _Data) -> None:
    """Raise an error if no candidate, or not every requested candidate, has enough data."""
    if enough and (default or not short):
        return
    lengths = ", ".join(str(len(y)) for y, _ in data.runs[:5]) + (", ..." if len(data.runs) > 5 else "")
    named = short[:1] if default else short
    raise InputError(
        f"recordings too short: {'; '.join(named)} without a missing sample in the training recordings "
        f"(samples: {lengths}). Record longer ones, or use smaller orders [HM-IDENTIFY-038]"
    )


def _triangle(blocks: Iterable[Array]) -> tuple[Array, int]:
    """R of a QR factorization of all rows without NaN, and the number of these rows."""
    r: Array | None = None
    rows = 0
    for block in blocks:
        for start in range(0, len(block), BLOCK):
            part = block[start : start + BLOCK]
            part = part[np.isfinite(part).all(axis=1)]
            rows += len(part)
            r = np.asarray(np.linalg.qr(part if r is None else np.vstack([r, part]), mode="r"))
    assert r is not None
    return r, rows


def _arx(data: _Data, dt: float, order: int, delays: Sequence[int]) -> Iterator[LinearModel]:
    """ARX models of one order and several delays, from one factorization."""
    n_y, n_u = data.n_y, data.n_u
    first, last = min(1, *delays), max(order, order + max(delays) - 1)

    def rows() -> Iterator[Array]:
        for y, u in data.runs:
            n = len(y)
            if n > last:
                past = [y[last - k : n - k] for k in range(1, order + 1)]
                past += [u[last - k : n - k] for k in range(first, last + 1)]
                yield np.hstack([np.ones((n - last, 1)), *past, y[last:]])

    r, n_rows = _triangle(rows())
    of_y = 1 + np.arange(order * n_y).reshape(order, n_y)
    of_u = {k: 1 + order * n_y + (k - first) * n_u + np.arange(n_u) for k in range(first, last + 1)}
    for delay in delays:
        inputs = np.concatenate([of_u[k] for k in range(delay, delay + order)])
        columns = np.concatenate([[0], of_y.ravel(), inputs])
        theta = np.linalg.lstsq(r[:, columns], r[:, -n_y:], rcond=None)[0]
        residual = r[:, -n_y:] - r[:, columns] @ theta
        weights = np.zeros((r.shape[1], n_y))
        weights[columns] = theta
        # observer form: block i of the state is the past's contribution to y after i - 1 samples; A - K C is a shift
        blocks = max(order, delay + order - 1)
        by_y = np.zeros((blocks, n_y, n_y))
        by_u = np.zeros((blocks + 1, n_y, n_u))
        by_y[:order] = [weights[of_y[i]].T for i in range(order)]
        for k in range(delay, delay + order):
            by_u[k] = weights[of_u[k]].T
        gain, direct = by_y.reshape(-1, n_y), by_u[0]
        c = np.eye(n_y, blocks * n_y)
        from_past = np.zeros((blocks, n_y, r.shape[1]))
        for i in range(blocks):
            for k in range(i, blocks):
                if k < order:
                    from_past[i][:, of_y[k - i]] = by_y[k]
                from_past[i][:, of_u[k - i + 1]] = by_u[k + 1]
        x = r[1:] @ from_past.reshape(blocks * n_y, -1).T
        yield _model(
            "ARX", data, dt, np.eye(blocks * n_y, k=n_y) + gain @ c, by_u[1:].reshape(-1, n_u) + gain @ direct, c,
            direct, gain, np.concatenate([weights[0], np.zeros((blocks - 1) * n_y)]),
            _positive(residual.T @ residual / (n_rows - len(columns)), 1.0), x.T @ x / n_rows,
            (order, delay, 0), _doubts(data, r[1:, inputs], f"order {order}"),
        )  # fmt: skip


def _subspace(
    data: _Data, dt: float, horizon: int, orders: Sequence[int], weighting: Weighting, direct: bool
) -> Iterator[LinearModel | Candidate]:
    """Subspace models of one horizon and several orders, from one factorization."""
    n_y, n_u, i = data.n_y, data.n_u, horizon

    def rows() -> Iterator[Array]:
        for y, u in data.runs:
            for start in range(0, len(y) - 2 * i + 1, BLOCK):
                part = slice(start, start + BLOCK + 2 * i - 1)
                views = (sliding_window_view(a[part], 2 * i, axis=0) for a in (u, y))
                u_w, y_w = (np.moveaxis(v, 1, 2).reshape(len(v), -1) for v in views)
                (past_u, next_u), (past_y, next_y) = np.hsplit(u_w, 2), np.hsplit(y_w, 2)
                yield np.hstack([np.ones((len(u_w), 1)), next_u, past_u, past_y, next_y])

    r, n_rows = _triangle(rows())
    r = r / math.sqrt(n_rows)
    u_f, u_p, y_p, y_f = np.split(1 + np.arange(r.shape[1] - 1), np.cumsum([i * n_u, i * n_u, i * n_y]))
    past = np.concatenate([u_p, y_p])
    later = np.concatenate([u_p[n_u:], u_f[:n_u], y_p[n_y:], y_f[:n_y]])  # the past one sample on
    # regression of the future outputs on the past, with the future inputs projected out; rounding directions dropped
    left, size, right = np.linalg.svd(r[np.ix_(past, past)])
    keep = size > LOST * size[0]
    of_past = right[keep].T @ ((left[:, keep].T @ r[np.ix_(past, y_f)]) / size[keep, None])
    if weighting == "cva":
        _, spread, axes = np.linalg.svd(r[np.ix_([*past, *y_f], y_f)], full_matrices=False)
        keep = spread > LOST * spread[0]
        spread, axes = spread[keep], axes[keep]
        predicted = r[np.ix_(past, past)] @ of_past
    else:
        spread, axes = np.ones(len(y_f)), np.eye(len(y_f))
        predicted = r[1:, past] @ of_past
    _, sizes, variates = np.linalg.svd((predicted @ axes.T) / spread, full_matrices=False)
    ones, inputs, outputs = r[:, :1], r[:, u_f[:n_u]], r[:, y_f[:n_y]]
    for n in orders:
        if n > min((i - 1) * n_y, int(np.sum(sizes > LOST * sizes[0]))):
            break
        root = np.sqrt(sizes[:n])
        observability = ((variates[:n].T * root).T * spread) @ axes  # transposed: (n, horizon n_y)
        to_state = of_past @ axes.T @ (variates[:n] / spread).T / root
        c = observability[:, :n_y].T
        a = np.linalg.lstsq(observability[:, :-n_y].T, observability[:, n_y:].T, rcond=None)[0]
        x, x_next = r[:, past] @ to_state, r[:, later] @ to_state
        if _radius(a) <= STABLE:
            b, d, bias = _inputs_by_free_run(data, a, c, direct)
        else:  # free runs diverge, so B and D follow from one-step residuals
            known = np.hstack([inputs, ones])
            b_bias = np.linalg.lstsq(known, x_next - x @ a.T, rcond=None)[0].T
            d_rest = np.linalg.lstsq(known[:, 0 if direct else n_u :], outputs - x @ c.T, rcond=None)[0].T
            # shift of the state, so that the output needs no bias
            shift = np.linalg.lstsq(c, d_rest[:, -1], rcond=None)[0]
            b, bias = b_bias[:, :n_u], b_bias[:, n_u] + shift - a @ shift
            d = d_rest[:, :-1] if direct else np.zeros((n_y, n_u))
        residual = np.hstack([x_next - x @ a.T - inputs @ b.T, outputs - x @ c.T - inputs @ d.T])[1:]
        covariance, state = residual.T @ residual, x[1:].T @ x[1:]
        try:
            k, noise = _gain(a, c, covariance, float(np.trace(state)) / n)
        except InputError:  # A is far from stable; the table of candidates shows its radius
            yield Candidate(n, 0, horizon, math.inf, _radius(a))
            continue
        yield _model(
            "N4SID", data, dt, a, b, c, d, k, bias, noise, state, (n, 0, horizon),
            _doubts(data, r[1:, np.concatenate([u_p, u_f])], f"horizon {horizon}"),
        )  # fmt: skip


def _inputs_by_free_run(data: _Data, a: Array, c: Array, direct: bool) -> tuple[Array, Array, Array]:
    """B, D and bias that minimize the free-run error over the training data, with a free initial state for each run.

    A long recording is several runs. The response of output j to an input that enters state i is state i of the
    transposed system, driven through row j of C.
    """
    n, n_y, n_u = len(a), data.n_y, data.n_u

    def rows() -> Iterator[Array]:
        pieces = ((a[i : i + BLOCK] for a in run) for run in data.runs for i in range(0, len(run[0]), BLOCK))
        for y, u in pieces:
            v = np.hstack([u, np.ones((len(u), 1))])
            answers = _states(a.T, v.T[None, :, :, None] * c[:, None, None, :], np.zeros((n_y, n_u + 1, n)))
            by_b = np.moveaxis(answers, 2, 0).reshape(len(y), n_y, -1)
            by_d = np.zeros((len(y), n_y, n_y, n_u * direct))
            by_d[:, range(n_y), range(n_y)] = u[:, None, : n_u * direct]
            free = np.moveaxis(_states(a.T, np.zeros((n_y, len(y), n)), c), 0, 1)
            seen = np.isfinite(y)
            start, _ = np.linalg.qr(free[seen])
            rest = np.hstack([by_b[seen], by_d.reshape(*by_d.shape[:2], -1)[seen], y[seen][:, None]])
            yield rest - start @ (start.T @ rest)

    r, _ = _triangle(rows())
    theta = np.asarray(np.linalg.lstsq(r[:, :-1], r[:, -1], rcond=None)[0], dtype=float)
    b, d = theta[: n * (n_u + 1)].reshape(n_u + 1, n).T, np.zeros((n_y, n_u))
    if direct:
        d[:] = theta[n * (n_u + 1) :].reshape(n_y, n_u)
    return b[:, :n_u], d, b[:, n_u]


def _gain(a: Array, c: Array, covariance: Array, size: float) -> tuple[Array, Array]:
    """Gain of the one-step predictor and covariance of its errors, from the covariance of the residuals ``[x+; y]``."""
    n = len(a)
    r = _positive(covariance[n:, n:], 1.0)
    by_y = np.linalg.solve(r, covariance[n:, :n]).T  # regression of the state's noise on the output's noise
    q = _positive(covariance[:n, :n] - by_y @ covariance[n:, :n], size)
    unit = float(np.trace(r))
    p, gain = dare((a - by_y @ c).T, c.T, q / unit, r / unit)
    return gain.T + np.asarray(by_y), _positive(c @ p @ c.T * unit + r, 1.0)


def _positive(covariance: Array, size: float) -> Array:
    """Raise the eigenvalues of a covariance to rounding level; ``size`` is the signal's own variance."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    least = SMALLEST * size + ROUNDED * float(np.abs(values).sum())
    return np.asarray((vectors * np.maximum(values, least)) @ vectors.T)


def _states(a: Array, v: Array, x0: Array) -> Array:
    """States ``(..., n, n_x)`` of ``x_(k+1) = A x_k + v_k`` from ``x0`` ``(..., n_x)``, all samples at once.

    In the basis of A's Schur form, each state is a first-order filter driven by the states after it. The basis is
    unitary, so equal eigenvalues cause no loss of accuracy.
    """
    from scipy.linalg import schur
    from scipy.signal import lfilter

    t, q = schur(a, output="complex")
    start, drive = x0 @ q.conj(), v @ q.conj()
    z = np.empty(v.shape, dtype=complex)
    for i in reversed(range(len(a))):
        into = drive[..., i] + z[..., i + 1 :] @ t[i, i + 1 :]
        z[..., i], _ = lfilter([0, 1], [1, -t[i, i]], into, axis=-1, zi=start[..., i : i + 1])
    return np.asarray((z @ q.T).real)


def _radius(a: Array) -> float:
    return float(np.abs(np.linalg.eigvals(a)).max())


def _root(covariance: Array) -> Array:
    """``F`` ``(n, rank)`` with ``F F' = covariance``."""
    values, vectors = np.linalg.eigh(covariance)
    keep = values > SMALLEST * max(float(values[-1]), SMALLEST)
    return np.asarray(vectors[:, keep] * np.sqrt(values[keep]))


def _doubts(data: _Data, inputs: Array, what: str) -> tuple[str, ...]:
    """Warnings about insufficient excitation, from the R factor of the lagged inputs."""
    doubts = [
        f"measured disturbance (input {j + 1}) never changes in the training recordings, so the model lacks its effect"
        for j in data.still
    ]
    size = np.linalg.svd(inputs[:, np.abs(inputs).max(axis=0) > 0], compute_uv=False)
    rank = int(np.sum(size > RANK * size[0]))
    if rank < len(size):
        doubts.append(
            f"the inputs excite {rank} of the {len(size)} directions of {what}: other models explain the recordings "
            "equally well. Excite more frequencies, each input independently"
        )
    return tuple(doubts)


def _model(
    name: str, data: _Data, dt: float, a: Array, b: Array, c: Array, d: Array, k: Array, bias: Array, noise: Array,
    spread: Array, tried: tuple[int, int, int], doubts: tuple[str, ...],
) -> LinearModel:  # fmt: skip
    scales = data.u_centre, data.u_scale, data.y_centre, data.y_scale
    chosen = Candidate(*tried, math.nan, _radius(a))
    return LinearModel(name, float(dt), a, b, c, d, k, bias, noise, spread, *scales, chosen, (), doubts)


def _error(model: LinearModel, recordings: Sequence[Measured], warm: int) -> float:
    """Root mean square error of free runs over each output's spread; infinite if a run diverges."""
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable candidate
        errors = np.concatenate([
            (y_hat - _signals(r)[0][warm:]) / model.y_scale
            for y_hat, r in zip(model.free_runs(recordings, warm), recordings, strict=True)
        ])  # fmt: skip
        seen = np.concatenate([np.isfinite(_signals(r)[0][warm:]) for r in recordings])
        error = math.sqrt(float(np.mean(np.sum(errors**2, axis=0, where=seen) / seen.sum(axis=0))))
    return error if math.isfinite(error) else math.inf


def _best(tried: Iterable[LinearModel | Candidate], valid: Sequence[Measured], warm: int) -> LinearModel:
    """Select the stable model with the least free-run error on validation recordings; of equal ones the smallest."""
    candidates, models = [], []
    for one in tried:
        if isinstance(one, LinearModel):
            models.append(replace(one, chosen=replace(one.chosen, error=_error(one, valid, warm))))
        candidates.append(one if isinstance(one, Candidate) else models[-1].chosen)
    if not models:
        raise InputError(
            "orders: no candidate gave a model, because the recordings do not excite so many states. Give smaller "
            "orders, or recordings with more excitation [HM-IDENTIFY-039]"
        )
    stable = [m for m in models if m.chosen.stable]
    able = stable or models
    limit = ALIKE * min(m.chosen.error for m in able) + ROUNDING
    best = min((m for m in able if m.chosen.error <= limit), key=lambda m: (m.chosen.order, m.chosen.error))
    doubts = (
        ()
        if stable
        else (
            f"no candidate is stable: the selected one has an eigenvalue of magnitude {best.chosen.radius:.6g}",
        )
    )
    return replace(best, candidates=tuple(candidates), warnings=best.warnings + doubts)


BASELINES: Mapping[str, Callable[..., LinearModel]] = {"ARX": fit_arx, "N4SID": fit_subspace}
"""Linear input-output models by name."""
