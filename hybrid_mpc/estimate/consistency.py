"""Consistency of a filter: its innovations on recordings, compared with its own covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.switching import Filter, SwitchingFilter
from hybrid_mpc.estimate.tuning import Recording, measured_disturbances
from hybrid_mpc.records import BESIDE

Array = NDArray[np.float64]
LEVEL = 0.95
"""Probability with which a consistent filter passes each of the two tests."""


@dataclass(frozen=True)
class Innovations:
    """Innovations of a filter along one recording, without the first samples; ``t`` [s] since the recording's start.

    Args:
        normalised: ``L^-1 (y - y_predicted)`` with ``L L' = C P C' + R``, ``(n, n_y)`` [-]; white with unit
            variance if the filter's assumptions hold; NaN in rows with a missing output.
        nis: Normalised innovations squared ``(n,)`` [-]; NaN without a measurement. For a switching filter they use the
            mean and covariance of the mixture, since its own ``nis`` favours the fitting mode.
        degrees: Number of measured outputs ``(n,)``: the degrees of freedom of each NIS.
    """

    t: Array
    normalised: Array
    nis: Array
    degrees: NDArray[np.int_]


@dataclass(frozen=True)
class Consistency:
    """Two tests of a filter's innovations, each passed by 95 % of the consistent filters.

    If the mean NIS is above its band, the filter assumes too little noise (or its model is wrong); below, too much.

    Args:
        mean_nis: Mean normalised innovation squared; the number of outputs if the covariances are right.
        nis_band: Its 95 % band.
        nis_inside: Share of single NIS below their 95 % quantile.
        ljung_box: Ljung-Box statistic of the autocorrelations, summed over the outputs.
        ljung_box_limit: Its 95 % quantile for white innovations.
        samples: Number of samples.
        correlation_band: Half the width of the 95 % band of one autocorrelation for white innovations.
        autocorrelation: Autocorrelations ``(lags, n_y)`` of the normalised innovations at lags 1, 2, ...
        runs: Innovations of each recording.
    """

    mean_nis: float
    nis_band: tuple[float, float]
    nis_inside: float
    ljung_box: float
    ljung_box_limit: float
    samples: int
    correlation_band: float
    autocorrelation: Array = field(default_factory=lambda: np.zeros(0), compare=False, metadata=BESIDE)
    runs: tuple[Innovations, ...] = field(default=(), compare=False, metadata=BESIDE)


def consistency(
    estimator: Filter,
    recordings: Sequence[Recording],
    *,
    skip: int = 25,
    lags: int = 20,
) -> Consistency:
    """Test a filter on recordings, which should differ from those used for tuning.

    The mean NIS is compared with its chi-square band, the autocorrelations of the normalised innovations with those of
    white noise (about zero, not about their mean, so an offset fails, too). For a nonlinear model both are approximate.
    A consistent switching filter has the same mean NIS, but its single NIS scatter more than band and ``nis_inside``
    assume, since its innovations are a mixture of Gaussians.

    The first ``skip`` samples of each recording are left out while the filter settles; ``lags`` is the largest lag.

    Source: Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and Navigation*, 2001, section
    5.4; Ljung, Box, *On a measure of lack of fit in time series models*, Biometrika 65 (1978).
    """
    from scipy.stats import chi2, norm

    if skip < 1 or lags < 1:
        raise InputError(
            f"consistency: skip and lags must be at least 1, got {skip} and {lags} [HM-ESTIMATE-001]"
        )
    runs = tuple(innovations(estimator, recording, skip) for recording in recordings)
    nis = np.concatenate([np.zeros(0), *(run.nis for run in runs)])
    degrees = np.concatenate([np.zeros(0, dtype=int), *(run.degrees for run in runs)])
    seen = np.isfinite(nis)
    n, freedom = int(seen.sum()), int(degrees[seen].sum())
    if n < 5 * lags:
        raise InputError(
            f"consistency: {n} samples remain after the first {skip} of each recording, but {lags} lags need at least "
            f"{5 * lags}. Give longer recordings or fewer lags. [HM-ESTIMATE-002]"
        )
    tail = (1.0 - LEVEL) / 2
    low, high = (float(chi2.ppf(share, freedom)) / n for share in (tail, 1.0 - tail))
    r, pairs = _autocorrelation([run.normalised for run in runs], lags)
    size = int(sum(np.all(np.isfinite(run.normalised), axis=1).sum() for run in runs))
    return Consistency(
        runs=runs,
        samples=n,
        mean_nis=float(nis[seen].mean()),
        nis_band=(low, high),
        nis_inside=float(np.mean(nis[seen] <= chi2.ppf(LEVEL, degrees[seen]))),
        autocorrelation=r,
        correlation_band=float(norm.ppf(1.0 - tail)) / np.sqrt(size),
        ljung_box=float(size * (size + 2) * np.sum(r**2 / pairs[:, None])),
        ljung_box_limit=float(chi2.ppf(LEVEL, r.size)),
    )


def innovations(estimator: Filter, recording: Recording, skip: int = 25) -> Innovations:
    """Innovations of a filter along a recording on the model's grid, without the first ``skip`` samples."""
    n_y, n = estimator.model.n_y, len(recording.y)
    if recording.y.shape != (n, n_y) or recording.u.shape != (n, estimator.model.n_u) or n == 0:
        raise InputError(
            f"consistency: y and u must have shapes (n, {n_y}) and (n, {estimator.model.n_u}) with n > 0, got "
            f"{recording.y.shape} and {recording.u.shape} [HM-ESTIMATE-003]"
        )
    ws = measured_disturbances(estimator.model, recording)
    estimate = estimator.start(recording.y[0], w=ws[0])
    rows: list[Array] = []
    nis: list[float] = []
    degrees: list[int] = []
    for k in range(1, n):
        u, y = recording.u[k - 1], recording.y[k]
        ahead = estimator.measuring(estimator.predict(estimate, u), ws[k])
        s = estimator.innovation_covariance(ahead, u)
        estimate = estimator.update(estimate, y, u, w=ws[k])
        whole = bool(np.all(np.isfinite(estimate.innovation)) and np.all(np.isfinite(s)))
        normalised = (
            np.linalg.solve(np.linalg.cholesky(s), estimate.innovation) if whole else np.full(n_y, np.nan)
        )
        rows.append(normalised)
        mixed = whole and isinstance(estimator, SwitchingFilter)
        nis.append(float(normalised @ normalised) if mixed else estimate.nis)
        degrees.append(int(np.isfinite(estimate.innovation).sum()))
    kept = slice(skip - 1, None)  # the first row belongs to the second sample
    return Innovations(
        estimator.model.dt * np.arange(1.0, n)[kept],
        np.array(rows).reshape(-1, n_y)[kept],
        np.array(nis)[kept],
        np.array(degrees, dtype=int)[kept],
    )


def _autocorrelation(runs: Sequence[Array], lags: int) -> tuple[Array, Array]:
    """Autocorrelations ``(lags, n_y)`` within the runs, and the number of pairs of samples at each lag."""
    n_y = runs[0].shape[1]
    finite = [np.all(np.isfinite(e), axis=1) for e in runs]
    power = sum((np.sum(e[f] ** 2, axis=0) for e, f in zip(runs, finite, strict=True)), np.zeros(n_y))
    r, pairs = np.zeros((lags, n_y)), np.zeros(lags)
    for lag in range(1, lags + 1):
        for e, f in zip(runs, finite, strict=True):
            both = f[lag:] & f[:-lag]
            r[lag - 1] += np.sum((e[lag:] * e[:-lag])[both], axis=0)
            pairs[lag - 1] += both.sum()
    if np.any(power == 0) or np.any(pairs == 0):
        raise InputError(
            "consistency: the recordings have no pairs of samples at some lag. Use fewer lags."
            " [HM-ESTIMATE-004]"
        )
    return r / power, pairs
