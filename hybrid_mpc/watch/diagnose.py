"""Diagnosis: the change of a parameter, an actuator or a sensor that best explains an alarm."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.scales import evenly
from hybrid_mpc.errors import InputError
from hybrid_mpc.model.model import HybridModel, changeable, incidence
from hybrid_mpc.watch.detector import WatchLimits
from hybrid_mpc.watch.lengths import SHORT_S, machine_second
from hybrid_mpc.watch.readings import Validity
from hybrid_mpc.watch.replay import Trace, TrajectoryLike
from hybrid_mpc.watch.residuals import free_run_of

Array = NDArray[np.float64]
BEFORE_S, AFTER_S = 2.0, 1.0
"""Window of the diagnosis before and after the alarm [time constants of the machine]: the first part determines the
initial state, the second shows the effect of the cause."""
FEWEST = 5
"""Smallest number of samples after the alarm."""
LEFT = 0.5
"""Largest share of the squared errors that a known cause may leave; otherwise the cause is unknown."""
ENOUGH, ORDINARY, SECOND = 0.15, 1 / 3, 0.5
"""A second cause is searched if the first leaves more than 15 % of the squared errors, or errors above a third of the
threshold; it is accepted if it halves the remaining squared errors."""
ALIKE = 4.0
"""Difference of misfits (2 standard deviations, squared) below which two causes cannot be distinguished."""
REFINED, ITERATIONS = 4, 3
"""Number of the best linear fits that are refined, and their number of Gauss-Newton steps."""
RANGE = (-0.98, 4.0)
"""Range of the relative change of a parameter or gain: it keeps its sign and at most becomes five times as large."""


BLIND = {
    Validity.WARM_UP: "no valid reading: the monitor's window is not full",
    Validity.MISSING: "no valid reading: samples are missing",
    Validity.NOT_FINITE: "no valid reading: model or estimator gives a non-finite value",
}
"""Diagnosis of an alarm without a valid reading."""


@dataclass(frozen=True)
class Change:
    """A change of one cause with its standard deviation: relative to the nominal value (0.5: 50 % larger), or absolute
    with a ``unit``.
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
    """Diagnosis of an alarm.

    Args:
        text: As text: ``"friction +95 ± 20 %, which leaves 2% unexplained"``, ``"none of the known causes ..."``.
        samples: Number of samples of the window.
        causes: The cause of the alarm, or two causes that together explain it. Default: unknown.
        alternatives: Other single causes that explain it equally well. Default: none.
    """

    text: str
    samples: float
    causes: tuple[Change, ...] = ()
    alternatives: tuple[Change, ...] = ()


@dataclass(frozen=True)
class Window:
    """Part of a recording around an alarm.

    Args:
        y: Measurements ``(n, n_y)``; NaN where missing.
        u: Inputs ``(n, n_u)``, each held over the period that it begins.
        w: Measured disturbances ``(n, n_w)``.
        x: Estimated state ``(n_x,)`` at the first sample; ``h`` ``(n_h,)`` the hidden state, ``d`` ``(n_d,)`` the
            unmeasured disturbance.
        alarm: Sample at which the alarm began.
    """

    y: Array
    u: Array
    w: Array
    x: Array
    h: Array
    d: Array
    alarm: int


class Diagnoser:
    """Finds the change of a parameter of the prior, of an actuator or of a sensor that best explains an alarm.

    It simulates a free run of the model over a window around the alarm. The initial state, a constant unmeasured
    disturbance and the onset of the change are free. Candidates are each parameter of the prior (or a group with the
    same relative change), and gain and offset of each input and output. One run gives the sensitivities to all of them.
    Each candidate is fitted alone by weighted least squares, the best ones by Gauss-Newton, and pairs of candidates if
    they explain much more than one. It works for any model.

    Args:
        model: The model that the monitor compares with the machine.
        limits: Limits of the model's residuals, which weight the outputs by their ordinary free-run errors. Default:
            weights by the errors in the window.
        causes: Groups of parameters with the same relative change, by name; gains and offsets of signals are always
            candidates. Default: each parameter alone.
        prior: Model of the prior alone, if the model has a network. Default: the model.

    Raises:
        InputError: If a cause's parameter is unknown, or the limits belong to another model.

    Example: ``Diagnoser(model, limits).diagnose(window).text`` says ``"offset of level +0.1 ± 0.01 m"``
    """

    def __init__(
        self,
        model: HybridModel,
        limits: WatchLimits | None = None,
        causes: Mapping[str, Sequence[str]] | None = None,
        *,
        prior: HybridModel | None = None,
    ) -> None:
        self.model, self._scale = model, np.full(model.n_y, math.nan)
        if limits is not None:
            of = [limits.of(free_run_of(s.name)) for s in model.outputs]
            if not all(of):
                raise InputError(
                    "diagnosis: limits without free runs of this model's outputs. Give limits of its residuals"
                    " [HM-WATCH-010]"
                )
            self._scale = np.array([shortest[0].threshold for shortest in of])
        gains = {f"gain of {s.name}" for s in model.inputs}
        named = {name: (name,) for name in changeable(model)} if not causes else dict(causes)
        groups = {name: tuple(of) for name, of in named.items() if not set(of) <= gains}
        shares = incidence(model, groups, "diagnosis")
        if np.any(shares[model.n_p :]):
            groups = {name: of for name, of in groups.items() if not set(of) & gains}
            shares = incidence(model, groups, "diagnosis")
        self.names = (
            *groups,
            *(f"gain of {s.name}" for s in model.inputs), *(f"offset of {s.name}" for s in model.inputs),
            *(f"gain of {s.name}" for s in model.outputs), *(f"offset of {s.name}" for s in model.outputs),
        )  # fmt: skip
        """Names of all candidates."""
        n_u, n_y = model.n_u, model.n_y
        added = [[s.unit for s in signals] for signals in (model.inputs, model.outputs)]
        self._units = (*[""] * (len(groups) + n_u), *added[0], *[""] * n_y, *added[1])
        self._is_share = np.repeat([True, False, True, False], [len(groups) + n_u, n_u, n_y, n_y])
        self._run = _sensitivities(model, shares[: model.n_p], prior)
        unit = machine_second(model.dt, model.time_unit)
        self.before, self.after, self.short = (
            max(1, round(length * unit / model.dt)) for length in (BEFORE_S, AFTER_S, SHORT_S)
        )

    def of_alarm(self, alarm: int, trace: Trace, recording: TrajectoryLike, estimates: Sequence[Any]) -> str:
        """Diagnosis of an alarm in a replayed recording, as text.

        Args:
            alarm: Index of the sample at which the alarm begins.
            trace: Trace of the recording.
            recording: With ``y``, ``u`` and, if the model has measured disturbances, ``w``.
            estimates: The estimates of all samples.
        """
        model = self.model
        frozen = np.atleast_1d(trace.frozen[alarm : alarm + self.after + 1].any(axis=0))
        stuck = [name for name, on in zip(trace.outputs, frozen, strict=True) if on]
        if stuck:
            return f"sensor of {', '.join(stuck)} frozen: its readings repeat although motion is predicted"
        on = [c.name for c, alarms in zip(trace.channels, trace.on[alarm], strict=True) if alarms]
        if not on:
            return BLIND.get(Validity(int(trace.validity[alarm])), "")
        if set(on) <= {s.name for s in model.disturbances}:
            return f"{', '.join(on)} is outside its range in the nominal data"
        first, end = max(alarm - self.before, 0), min(alarm + self.after + 1, len(recording.y))
        part, begin = slice(first, end), estimates[first]
        w: Array | None = getattr(recording, "w", None)
        known = w[part] if model.n_w and w is not None else np.tile(model.w, (end - first, 1))
        d = begin.d if np.size(begin.d) == model.n_d else np.zeros(model.n_d)
        return self.diagnose(
            Window(recording.y[part], recording.u[part], known, begin.x, begin.h, d, alarm - first)
        ).text

    def diagnose(self, window: Window) -> Diagnosis:
        """Diagnosis of the alarm in a window."""
        nuisance = self.model.n_x + self.model.n_d
        known = np.asarray(np.isfinite(window.y).all(axis=1))
        samples = float(known.sum())
        if known[window.alarm :].sum() < FEWEST or samples < FEWEST + nuisance:
            return Diagnosis(f"too few samples for a diagnosis: {samples:.0f}", samples)
        if not (
            np.isfinite(window.u[:-1]).all() and np.isfinite(window.x).all() and np.isfinite(window.h).all()
        ):
            return Diagnosis("inputs or estimates are missing around the alarm", samples)
        none, still, m = np.zeros(len(self.names)), np.zeros(nuisance), len(self.names)
        if not np.isfinite(self._scale).all():
            return self._weighed(window).diagnose(window)
        linear = {onset: self._linear(window, none, still, onset) for onset in self._onsets(window)}

        def fitted(tried: Iterable[tuple[int, ...]], refine: int) -> list[_Fit]:
            """The best onset's fit of each, the best of them refined; the best first."""
            found = [
                min(
                    (self._within(_fit(*at, nuisance, causes, onset)) for onset, at in linear.items()),
                    key=_misfit,
                )
                for causes in tried
            ]
            found.sort(key=_misfit)
            return sorted(
                [self._refined(window, f, nuisance) for f in found[:refine]] + found[refine:], key=_misfit
            )

        bare = _fit(*next(iter(linear.values())), nuisance, (), 0).misfit
        if not bare > 0:
            return Diagnosis("nothing to explain", samples)
        single = fitted(((i,) for i in range(m)), REFINED)
        best = single[0]
        ordinary = ORDINARY**2 * float(known.sum()) * self.model.n_y
        several = best.misfit > min(ENOUGH * bare, ordinary) and m > 1
        two = fitted(combinations(range(m), 2), REFINED)[0] if several else None
        independent = max(samples / self.short, 2.0)
        if two is not None and two.misfit < SECOND * best.misfit and two.misfit < LEFT * bare:
            changes = tuple(self._changes(two, independent))
            return Diagnosis(
                " and ".join(map(str, changes)) + f", which leave {two.misfit / bare:.0%} unexplained",
                samples,
                changes,
            )
        (first,) = self._changes(best, independent)
        left = best.misfit / bare
        if left > LEFT:
            return Diagnosis(
                f"none of the known causes (nearest: {first}, which leaves {left:.0%} unexplained)", samples
            )
        others = tuple(
            self._changes(f, independent)[0]
            for f in single[1:]
            if f.misfit - best.misfit < ALIKE * best.misfit / independent
        )
        text = " or ".join(str(change) for change in (first, *others))
        return Diagnosis(f"{text}, which leaves {left:.0%} unexplained", samples, (first,), others)

    def _weighed(self, window: Window) -> Diagnoser:
        """The same diagnoser with outputs weighted by their errors in the window."""
        found = copy.copy(self)
        found._scale = np.ones(self.model.n_y)
        errors, _ = found._linear(
            window, np.zeros(len(self.names)), np.zeros(self.model.n_x + self.model.n_d), window.alarm
        )
        size = np.sqrt(np.mean(errors.reshape(-1, self.model.n_y) ** 2, axis=0))
        found._scale = np.where(size > 0, size, 1.0)
        return found

    def _within(self, fit: _Fit) -> _Fit:
        """The fit; with infinite misfit if a relative change is out of range."""
        shares = fit.change[self._is_share[list(fit.causes)]]
        inside = bool(np.all((shares >= RANGE[0]) & (shares <= RANGE[1])))
        return fit if inside else replace(fit, misfit=np.inf)

    def _onsets(self, window: Window) -> list[int]:
        """Candidate onsets [sample] before the alarm, within the length of the averages and the window."""
        back = [*range(self.short + 1), 2 * self.short, self.before // 3, self.before // 2]
        # largest number of tested onsets
        chosen = [back[i] for i in evenly(len(back), 14)]
        return sorted({max(window.alarm - b, 1) for b in chosen})

    def _linear(self, window: Window, theta: Array, start: Array, onset: int) -> tuple[Array, Array]:
        """Scaled errors ``(m,)`` of a free run and their slopes ``(m, n_x + n_d + causes)``."""
        n, m = len(window.y), self.model
        on = (np.arange(n) >= onset).astype(float)
        given = np.vstack([window.u.T, window.w.T, on[None]])
        first = np.concatenate([window.x + start[: m.n_x], window.h])
        d = window.d + start[m.n_x :]
        slopes_0 = np.zeros((first.size, m.n_x + m.n_d + theta.size))
        slopes_0[: m.n_x, : m.n_x] = np.eye(m.n_x)
        state = np.concatenate([first, slopes_0.ravel(order="F"), np.zeros(m.n_u)])
        # the input before the first sample is unknown: its output is computed with the first input
        state[-m.n_u :] = window.u[0]
        _, outs = self._run.mapaccum(n)(
            state, np.nan_to_num(given), np.tile(d[:, None], n), np.tile(theta[:, None], n)
        )
        columns = 1 + slopes_0.shape[1]
        outs = np.array(outs.full()).reshape(m.n_y, columns, n, order="F")
        known = np.isfinite(window.y).all(axis=1)
        errors = ((window.y.T - outs[:, 0]) / self._scale[:, None])[:, known]
        slopes = (outs[:, 1:] / self._scale[:, None, None])[:, :, known]
        return errors.T.ravel(), slopes.transpose(2, 0, 1).reshape(errors.size, -1)

    def _refined(self, window: Window, fit: _Fit, nuisance: int) -> _Fit:
        """Gauss-Newton from a linear fit; the better of the two."""
        best, theta, start = fit, np.zeros(len(self.names)), np.zeros(nuisance)
        step = fit
        for _ in range(ITERATIONS):
            moved = theta.copy()
            moved[list(fit.causes)] += step.change
            moved = np.where(self._is_share, np.clip(moved, *RANGE), moved)
            errors, slopes = self._linear(window, moved, start + step.start, fit.onset)
            misfit = float(errors @ errors)
            if not np.isfinite(misfit) or misfit > 1.5 * best.misfit + 1e-12:
                break
            theta, start = moved, start + step.start
            step = _fit(errors, slopes, nuisance, fit.causes, fit.onset)
            found = theta[list(fit.causes)]
            best = _Fit(fit.causes, fit.onset, found, start, misfit, step.covariance)
        return best

    def _changes(self, fit: _Fit, independent: float) -> list[Change]:
        freedom = max(independent - len(fit.causes), 1.0)
        sigma = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0) * fit.misfit / freedom)
        return [
            Change(self.names[i], float(value), float(s), self._units[i])
            for i, value, s in zip(fit.causes, fit.change, sigma, strict=True)
        ]


@dataclass(frozen=True)
class _Fit:
    """Causes, the sample they set in at, their sizes, changes of first state and disturbance, and what is left."""

    causes: tuple[int, ...]
    onset: int
    change: Array
    start: Array
    misfit: float
    covariance: Array


def _misfit(fit: _Fit) -> float:
    return fit.misfit


def _fit(errors: Array, slopes: Array, nuisance: int, causes: tuple[int, ...], onset: int) -> _Fit:
    """Least squares of errors by first state, disturbance and some causes."""
    used = slopes[:, [*range(nuisance), *(nuisance + i for i in causes)]]
    size = np.linalg.norm(used, axis=0)
    size = np.where(size > 0, size, 1.0)
    scaled = used / size
    # regularization of the least squares, relative to the squared norm of the columns, for unobservable directions
    normal = scaled.T @ scaled + 1e-9 * np.eye(len(size))
    inverse = np.linalg.inv(normal)
    found = inverse @ (scaled.T @ errors) / size
    left = errors - used @ found
    covariance = (inverse / np.outer(size, size))[nuisance:, nuisance:]
    return _Fit(causes, onset, found[nuisance:], found[:nuisance], float(left @ left), covariance)


def _sensitivities(model: HybridModel, shares: Array, prior: HybridModel | None) -> ca.Function:
    """A period of a free run with its slopes.

    ``((x, h, slopes, u before), (u, w, on), d, causes) -> (the same a period on, outputs and their slopes now)``.
    """
    n_x, n_h, n_u, n_w, n_d, n_y = model.n_x, model.n_h, model.n_u, model.n_w, model.n_d, model.n_y
    n_g = shares.shape[1]
    n_c, n_z = n_g + 2 * n_u + 2 * n_y, n_x + n_h
    columns = n_x + n_d + n_c
    z, s, before = ca.MX.sym("z", n_z), ca.MX.sym("s", n_z, columns), ca.MX.sym("before", n_u)
    given, d, theta = ca.MX.sym("given", n_u + n_w + 1), ca.MX.sym("d", n_d), ca.MX.sym("theta", n_c)
    u, w, on = ca.vertsplit(given, [0, n_u, n_u + n_w, n_u + n_w + 1])
    cuts = np.cumsum([0, n_g, n_u, n_u, n_y, n_y]).tolist()
    group, gain, offset, sensor_gain, sensor_offset = ca.vertsplit(on * theta, cuts)
    on_u, on_x, on_y = (ca.DM(matrix) for matrix in model.disturbed)
    values = ca.DM(model.p)
    p = values * (1 + ca.DM(shares) @ group) if n_g else values

    def acting(command: ca.MX) -> ca.MX:
        return (1 + gain) * command + offset + on_u @ d

    x, h = z[:n_x], z[n_x:]
    if model.n_h == model.delay_states or prior is None:
        x_next, h_next = model.step(x, h, acting(u), w, p)
    else:
        # what a network adds does not depend on the prior's parameters
        x_next, h_next = model.step(x, h, acting(u), w, values)
        own = h[: prior.n_h]
        x_next += prior.step(x, own, acting(u), w, p)[0] - prior.step(x, own, acting(u), w, values)[0]
    x_next += on_x @ d
    y = (1 + sensor_gain) * (model.output(x, acting(before), w, p) + on_y @ d) + sensor_offset
    z_next = ca.vertcat(x_next, h_next)
    own_columns = ca.vertcat(d, theta)

    def slopes(of: ca.MX) -> ca.MX:
        direct = ca.horzcat(ca.MX.zeros(of.numel(), n_x), ca.jacobian(of, own_columns))
        return ca.jacobian(of, z) @ s + direct

    following = ca.vertcat(z_next, ca.vec(slopes(z_next)), u)
    outs = ca.vertcat(y, ca.vec(slopes(y)))
    flat = ca.MX.sym("state", n_z + n_z * columns + n_u)
    parts = ca.vertsplit(flat, [0, n_z, n_z + n_z * columns, flat.numel()])
    inner = ca.Function("inner", [z, s, before, given, d, theta], [ca.densify(following), ca.densify(outs)])
    results = inner(parts[0], ca.reshape(parts[1], n_z, columns), parts[2], given, d, theta)
    return ca.Function("run", [flat, given, d, theta], list(results))
