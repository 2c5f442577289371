"""Figures of the observers: the consistency of their innovations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.plots.style import (
    COLOURS,
    FAINT,
    GOOD,
    INK,
    PALE,
    Array,
    checked,
    new_figure,
    number,
    plain,
    shared_legend,
    title_axes,
)

WINDOW = 50
"""Samples of the running mean."""


def innovations(
    nis: Sequence[Array],
    autocorrelation: Array,
    *,
    dt: float,
    outputs: Sequence[Signal],
    mean_band: tuple[float, float],
    correlation_band: float,
    title: str = "",
) -> Figure:
    """NIS over time with the 95 % bands of a consistent filter, and the autocorrelation of the innovations.

    The NIS (normalised innovation squared) of a consistent filter is chi-squared with ``n_y`` degrees of freedom
    (Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4).

    Args:
        nis: NIS of each recording ``(n,)`` [-], joined in the figure; NaN for a sample without measurement.
        autocorrelation: Autocorrelation of the normalised innovations at lags 1, 2, ..., ``(lags, n_y)``.
        dt: Sampling period [s].
        outputs: Signals of the outputs.
        mean_band: Lower and upper end of the band of the mean NIS over all samples.
        correlation_band: Half width of the band of one autocorrelation.
        title: Title. Default: none.

    Raises:
        InputError: If there are no recordings, or shapes do not fit.

    Example:
        >>> figure = innovations([np.ones(60)], np.zeros((5, 1)), dt=0.1, outputs=[Signal("phi", "rad")],
        ...     mean_band=(0.8, 1.2), correlation_band=0.2)
        >>> len(figure.axes)
        2
    """
    from scipy.stats import chi2

    if not nis or not dt > 0:
        raise InputError(
            "plot of the innovations: at least one recording and a positive period are needed [HM-PLOTS-019]"
        )
    lags, n_y = len(autocorrelation), len(outputs)
    r = checked("autocorrelation", autocorrelation, lags, n_y)
    values = np.concatenate([np.asarray(v, dtype=float) for v in nis])
    t = dt * np.arange(len(values))
    figure, axes = new_figure(2, 1, heights=(1.5, 1.0), size=(10, 6.2), title=title)
    top, bottom = axes[:, 0]
    top.plot(t, values, ".", color=PALE, markersize=2.5, label="NIS")
    mean = np.array([np.nanmean(v) if np.isfinite(v).any() else np.nan for v in _windows(values)])
    top.plot(t[: len(mean)] + 0.5 * WINDOW * dt, mean, color=COLOURS["hybrid"], linewidth=1.3,
             label=f"mean over {WINDOW} samples")  # fmt: skip
    low, high = (float(chi2.ppf(p, WINDOW * n_y)) / WINDOW for p in (0.025, 0.975))
    top.axhspan(low, high, color=GOOD, alpha=0.15, linewidth=0, label=f"95 % band of the mean over {WINDOW}")
    top.axhline(
        float(chi2.ppf(0.95, n_y)),
        color=INK,
        linestyle=":",
        linewidth=1.1,
        label="95 % limit of a single NIS",
    )
    for edge in np.cumsum([len(v) for v in nis])[:-1]:
        top.axvline(dt * edge, color=FAINT, linewidth=0.6)
    top.set_yscale("log")
    finite = values[np.isfinite(values)]
    top.set_ylim(1e-2 * n_y, max(20.0 * n_y, 1.2 * float(finite.max(initial=1.0))))
    top.set_ylabel("NIS [-]")
    top.set_xlabel("time, recordings joined [s]")
    top.margins(x=0)
    whole = float(finite.mean()) if len(finite) else float("nan")
    title_axes(
        top, f"mean {number(whole)}; consistent filter: {number(mean_band[0])} to {number(mean_band[1])}"
    )
    width = 0.7 / n_y
    for i, signal in enumerate(outputs):
        offset = (i + 0.5) / n_y * 0.7 - 0.35
        bottom.bar(np.arange(1, lags + 1) + offset, r[:, i], width=width, label=plain(signal.name))
    bottom.axhspan(-correlation_band, correlation_band, color=GOOD, alpha=0.15, linewidth=0)
    bottom.axhline(0.0, color=FAINT, linewidth=0.8)
    bottom.xaxis.set_major_locator(MaxNLocator(integer=True))
    bottom.set_xlabel("lag [samples]")
    bottom.set_ylabel("autocorrelation of the\nnormalised innovations [-]")
    title_axes(bottom, "band: 95 % interval of white innovations, for each lag alone")
    shared_legend(figure)
    return figure


def _windows(values: Array) -> Array:
    """All windows ``(n - w + 1, w)`` of ``w`` samples; a series shorter than a window is one window."""
    return np.lib.stride_tricks.sliding_window_view(values, min(WINDOW, len(values)))
