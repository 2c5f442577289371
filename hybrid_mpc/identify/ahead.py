"""Predictions over a horizon, from the observer's estimates along a recording.

A free run uses the samples of its warm-up alone. An observer uses all samples so far, and also estimates disturbances
and tracked parameters. At each start, the model predicts the horizon from the observer's estimate, with the measured
inputs and disturbances. Unmeasured disturbances and tracked parameters are held constant.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.scales import evenly
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimate
from hybrid_mpc.estimate.switching import Filter
from hybrid_mpc.estimate.tracking import (
    DAY,
    TrackedEstimate,
    TrackedParameter,
    TrackingFilter,
    shown_parameters,
)
from hybrid_mpc.estimate.tuning import log_likelihood
from hybrid_mpc.identify.varying import WORTH, Varying
from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]
STARTS = 4
"""Number of predictions that start within one horizon."""
BETTER = 0.97
"""Ratio of errors below which a further tracked parameter is used."""
HARM = 1.02
"""Ratio of an output's error with tracking to that without, up to which tracking does no harm."""
WATCHED, RECORDINGS = 1500, 12
"""Largest number of periods of a recording, and of evenly chosen recordings, over which observers are compared."""
TIMES = 6
"""Time constants of a parameter's drift that are tried: from a day to the horizon, on a logarithmic scale."""
UNLEARNED = 0.5
"""The recordings do not separate load and parameter if two ratios exceed this value: a parameter's standard deviation
late in a recording over that at its start, and the load with tracking over the load without. In an example the ratios
are 0.87 and 0.75 if the prior lacks a lag, and 0.2 and 0.3 if it has the lag."""
LATE_ESTIMATES = 8
"""Number of estimates in the second half of a recording, over which loads and standard deviations are compared."""
FAR = 1e6
"""Largest ratio of an error to that without tracking; predictions that diverge have this ratio."""


@dataclass(frozen=True)
class AheadErrors:
    """Errors of predictions from an observer's state.

    Args:
        rmse: Root mean square by recording and output ``(r, n_y)`` [output units], over starts and horizons.
        starts: Number of predictions of each recording ``(r,)``.
        names: Names of the recordings.
    """

    rmse: Array
    starts: tuple[int, ...]
    names: tuple[str, ...]

    @property
    def pooled(self) -> Array:
        """Root mean square by output ``(n_y,)`` over all predictions."""
        weights = np.array(self.starts, dtype=float)
        return np.asarray(np.sqrt(weights @ np.square(self.rmse) / weights.sum()))


def errors_ahead(
    observer: Filter | TrackingFilter,
    recordings: Sequence[Trajectory],
    horizon: float,
    *,
    warm_up: float = 0.0,
    every: int = 0,
) -> AheadErrors:
    """Errors of predictions over ``horizon`` from the observer's estimates along recordings.

    Args:
        observer: The observer; its model predicts.
        recordings: Recordings on the model's grid, inputs as commanded. Recordings that are too short for a
            prediction are left out.
        horizon: Length [s] of each prediction.
        warm_up: Time [s] that the observer runs before the first prediction. Default: none.
        every: Periods between two starts. Default: a quarter of the horizon.

    Raises:
        InputError: If no recording is long enough.

    Example:
        ``errors_ahead(kit.observer(), recordings, horizon=2.0, warm_up=1.0).pooled``
    """
    model = observer.model
    periods, warm = max(1, round(horizon / model.dt)), round(warm_up / model.dt)
    every = every or max(1, periods // STARTS)
    found, starts, names = [], [], []
    for t in recordings:
        ks = list(range(max(warm, 1), len(t.t) - periods, every))
        if ks:
            found.append(_rmse(model, t, _watched(observer, t, ks), ks, periods))
            starts.append(len(ks))
            names.append(t.name)
    if not found:
        raise InputError(
            f"predictions from the observer's state: no recording has {warm + periods + 1} samples, for a warm-up of "
            f"{warm_up:g} s and a horizon of {horizon:g} s. Give longer recordings [HM-IDENTIFY-079]"
        )
    return AheadErrors(np.array(found), tuple(starts), tuple(names))


def _watched(observer: Filter | TrackingFilter, t: Trajectory, ks: Sequence[int]) -> list[Estimate]:
    """Estimates after the samples ``ks``."""
    w = t.w if t.w.size else np.zeros((len(t.t), 0))
    estimate, found = observer.start(t.y[0], w=w[0] if w.shape[1] else None), []
    wanted = set(ks)
    for k in range(1, ks[-1] + 1):
        estimate = observer.update(estimate, t.y[k], t.u[k - 1], w=w[k] if w.shape[1] else None)
        if k in wanted:
            found.append(estimate)
    return found


def _rmse(
    model: HybridModel, t: Trajectory, estimates: Sequence[Estimate], ks: Sequence[int], periods: int
) -> Array:
    """Root mean square errors ``(n_y,)`` of all predictions, computed at once; infinite if one diverges."""
    m, (on_u, on_x, on_y) = len(ks), model.disturbed
    step, output = model.step.map(m), model.output.map(m)
    x, h, d = (np.array([getattr(e, key) for e in estimates]).reshape(m, -1) for key in "xhd")
    n_w = t.w.shape[1] if t.w.size else 0
    held = np.array([e.w[n_w:] for e in estimates]).reshape(m, -1)  # tracked parameters
    p, places = np.tile(model.p[:, None], m), np.array(ks)
    z, hidden = x.T, h.T
    squares = np.zeros(model.n_y)
    counts = np.zeros(model.n_y)
    for i in range(periods):
        now, u = places + i, t.u[places + i] + d @ on_u.T
        z, hidden = (v.full() for v in step(z, hidden, u.T, _with(t, now, n_w, held).T, p))
        z = z + on_x @ d.T
        shown = output(z, u.T, _with(t, now + 1, n_w, held).T, p).full().T + d @ on_y.T
        error = t.y[now + 1] - shown
        seen = np.isfinite(t.y[now + 1])
        with np.errstate(over="ignore", invalid="ignore"):
            squares += np.where(seen, np.nan_to_num(np.square(error), nan=np.inf), 0.0).sum(axis=0)
        counts += seen.sum(axis=0)
    return np.asarray(np.sqrt(squares / np.maximum(counts, 1)))


def _with(t: Trajectory, places: NDArray[np.intp], n_w: int, held: Array) -> Array:
    """Disturbances ``(m, n_w + n_t)`` at samples, the tracked parameters held."""
    return np.hstack([t.w[places] if n_w else np.zeros((len(places), 0)), held])


@dataclass(frozen=True)
class Tracking:
    """The parameters to track, and how tracking changes predictions of the recordings that they were chosen by.

    Args:
        tracked: The parameters; empty if tracking does not improve predictions.
        ratio: Error of predictions over that without tracking, by output [-]; 1 without tracked parameters.
        horizon: Length [s] of the predictions.
        tried: Mean ratio of errors of each set of parameters that was tried, by their names, ``"a, b"``; of parameters
            that drift by names and time constants, ``"a (600 s), b"``.
        doubts: Reasons why something other than the tracked parameters may change. Default: none.
    """

    tracked: tuple[TrackedParameter, ...]
    ratio: Mapping[str, float]
    horizon: float
    tried: Mapping[str, float]
    doubts: tuple[str, ...] = ()


def choose_tracked(
    watched: Sequence[Sequence[tuple[Filter, Sequence[Trajectory]]]],
    varying: Varying,
    horizon: float,
    *,
    warm_up: float = 0.0,
) -> Tracking:
    """Choose the parameters whose tracking improves predictions from the observer's state.

    Candidates are the parameters for whose variation between recordings there is evidence
    (:func:`~hybrid_mpc.identify.varying.find_varying`), except parameters in the output equation. The best candidate is
    added, one after the other, as long as the error falls by 3 % and no output's error rises by 2 % in each set of
    evidence. All varying parameters together and all candidates together are also tried. A parameter that the user
    declares as varying is always tracked.

    Each parameter is a candidate without drift (time constant of a day), and with the drift for which the observer's
    innovations are most likely, if their log-likelihood is clearly larger. A declared time constant is kept.

    Two sets are needed, because each alone is biased. A prior fitted to the same recordings predicts them better than
    new ones, so the gain by tracking is too small. A prior fitted to fewer recordings is worse than the deployed prior,
    so the gain is too large.

    Args:
        watched: Sets of evidence: observers without tracking, each with the recordings that evaluate it. At most 12
            recordings of an observer are used, and at most 1500 periods of each.
        varying: Variation of the parameters.
        horizon: Length [s] of the predictions.
        warm_up: Time [s] that the observer runs before the first prediction. Default: none.
    """
    sets = [
        [(o, [own[i].part(slice(WATCHED)) for i in evenly(len(own), RECORDINGS)]) for o, own in one]
        for one in watched
    ]
    model = watched[0][0][0].model
    names, shown = [s.name for s in model.outputs], shown_parameters(model)

    def errors(
        evidence: Sequence[tuple[Filter, Sequence[Trajectory]]], chosen: Sequence[TrackedParameter]
    ) -> tuple[Array, Array]:
        """Root mean squares of all recordings ``(r, n_y)``, and numbers of predictions ``(r,)``."""
        found = [
            errors_ahead(TrackingFilter(o, chosen) if chosen else o, own, horizon, warm_up=warm_up)
            for o, own in evidence
        ]
        return np.concatenate([f.rmse for f in found]), np.concatenate([f.starts for f in found]).astype(
            float
        )

    plain = [errors(one, ()) for one in sets]
    floors = [np.maximum(rmse, 1e-12 * np.maximum(rmse.max(axis=0), 1e-300)) for rmse, _ in plain]
    tried: dict[str, float] = {}

    def judged(chosen: Sequence[TrackedParameter], needed: float = math.inf) -> tuple[float, Array]:
        """Mean ratio of errors over recordings and outputs, and the ratio of each output: the largest of all sets.

        Once the mean ratio of a set exceeds ``needed``, the other sets are skipped: the largest ratio decides.
        """
        outputs: list[Array] = []
        for one, floor, (_, starts) in zip(sets, floors, plain, strict=True):
            ratio = np.clip(errors(one, chosen)[0] / floor, 1.0 / FAR, FAR)
            outputs.append(np.average(np.log(ratio), axis=0, weights=starts))
            if math.exp(float(outputs[-1].mean())) > needed:
                break
        mean = math.exp(float(np.max([o.mean() for o in outputs])))
        tried[", ".join(one.name + ("" if one.time == DAY else f" ({one.time:.3g} s)") for one in chosen)] = (
            mean
        )
        return mean, np.exp(np.max(outputs, axis=0))

    def drifting(one: TrackedParameter) -> tuple[TrackedParameter, ...]:
        """The parameter with the drift of the largest likelihood; empty if that is no better than without drift.

        Source: Schweppe, *Evaluation of likelihood functions for Gaussian signals*, IEEE T-IT 11 (1965).
        """
        some = [replace(one, time=float(time)) for time in np.geomspace(DAY, min(horizon, DAY), TIMES)]
        logs: list[float] = []
        for own in some:
            filters = [(TrackingFilter(o, [own]).inner, part) for o, part in sets[-1]]
            logs.append(sum(log_likelihood(inner, t) for inner, part in filters for t in part))
            if logs[-1] < max(logs) - WORTH:  # past the maximum
                break
        best = int(np.argmax(logs))
        return (some[best],) if logs[best] > logs[0] + WORTH else ()

    own = [p for p in varying.parameters if p.declared and p.varies]
    best: tuple[TrackedParameter, ...] = tuple(p.tracked() for p in own)
    ratio, outputs = judged(best) if best else (1.0, np.ones(len(names)))
    pool = [
        p.tracked(p.alone)
        for p in varying.parameters
        if not p.declared and p.alone > 0 and p.gain >= WORTH and p.name not in shown
    ]
    drifts = [d for one in (*pool, *(p.tracked() for p in own if p.time is None)) for d in drifting(one)]
    varies = tuple(p.tracked() for p in varying.parameters if p.varies and p.name not in shown)
    together = [varies, (*best, *pool)]
    while True:
        have = {one.name: one.time for one in best}
        trials = [
            (*(b for b in best if b.name != one.name), one)
            for one in (*pool, *drifts)
            if one.time < have.get(one.name, math.inf)
        ]
        trials += [one for one in together if len(one) > len(best) + 1]
        together = []
        found = [(*judged(trial, BETTER * ratio), trial) for trial in trials]
        harmless = [one for one in found if (one[1] <= np.maximum(HARM, HARM * outputs)).all()]
        first = min(harmless, key=lambda one: one[0], default=None)
        if first is None or first[0] > BETTER * ratio:
            break
        ratio, outputs, best = first
    doubts = _unlearned(*sets[0][0], best) if best else ()
    return Tracking(best, dict(zip(names, outputs.tolist(), strict=True)), horizon, tried, doubts)


def _unlearned(
    observer: Filter, recordings: Sequence[Trajectory], chosen: Sequence[TrackedParameter]
) -> tuple[str, ...]:
    """A doubt if the observer hardly learns a tracked parameter, and the load is nearly as large as without tracking.

    Then load and parameter explain the same errors: both replace a term that the prior lacks.
    """
    tracking, n_d = TrackingFilter(observer, chosen), observer.model.n_d
    loads, stds = [], []
    for t in recordings if n_d else ():
        ks = [len(t.t) // 2 + i for i in evenly(len(t.t) - len(t.t) // 2, LATE_ESTIMATES)]
        plain, own = (_watched(one, t, ks) for one in (observer, tracking))
        loads.append([np.mean([np.square(e.d) for e in some], axis=0) for some in (plain, own)])
        stds.append(np.mean([e.std for e in own if isinstance(e, TrackedEstimate)], axis=0))
    if not loads:
        return ()
    before, after = np.mean(loads, axis=0)
    left = math.sqrt(float(np.mean(after / np.maximum(before, 1e-300))))
    late = np.mean(stds, axis=0) / np.array([one.std for one in chosen])
    names = [one.name for one, ratio in zip(chosen, late, strict=True) if ratio > UNLEARNED]
    if not names or left < UNLEARNED:
        return ()
    return (
        f"the recordings do not separate the load from the tracked parameters ({', '.join(names)}): in the second "
        f"half of a recording the parameters have {100 * late.max():.0f} % of their initial standard deviation, and "
        f"the load is {100 * left:.0f} % of that without tracking. The prior may lack a term, or the lag of an input: "
        "read the warnings of hybrid-mpc check --fit (docs/tracking.md) [HM-IDENTIFY-083]",
    )
