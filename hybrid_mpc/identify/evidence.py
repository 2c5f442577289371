"""Held-out evidence: windows of recordings, what is left out together, and whether an error is surely smaller."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from hybrid_mpc.data.scales import evenly, time_unit
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.explanation import Evidence, HeldOutError
from hybrid_mpc.identify.windows import OutputWindows, cut_outputs
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.rules import counted

Array = NDArray[np.float64]
Places = NDArray[np.int64]
FOLDS = 5
"""Maximum number of groups of recordings that are held out in turn."""
BLOCKS = 8
"""Number of blocks that a few recordings are cut into."""
ADDED = 0.85
"""Ratio of errors that a term must fall below to be added. Smaller held-out gains became harm on another recording as
often as gain (docs/results/explain.md), and a term costs its reader attention."""
HARM = 1.05
"""Ratio of errors above which a term or a network is harmful."""
GAIN = 0.7
"""Lower limit of a recording's ratio of errors in the upper bound. It makes the bound larger, and a single recording
with a large reduction does not widen the interval."""
POOR = 0.7
"""Relative error of a model that explains half of the outputs' variance. If the error with a term is larger, only a
ratio below ``GAIN`` counts, because small reductions of such free runs occur by chance. The same holds with fewer than
``FEWEST`` recordings: their blocks do not show what differs in the next."""
DOUBT = 0.1
"""Probability that the ratio exceeds one bound of its interval, for all fitted candidates of a step together. A term is
added if the upper bound is below 1."""
SMALL = 0.1
"""Share of the smaller mean squared error that is added to the mean squared error of every piece. So pieces in which
both models have small errors have little influence."""
FEWEST, MANY = 3, 5
"""Minimum number of pieces of evidence for an interval, and of recordings for small gains; number of recordings from
which on each recording is one piece."""
MEMORY = 3.0
"""Minimum length of a block [time units]; shorter blocks are not independent. There are at least ``FEWEST`` blocks in
any case."""
SHORTEST = 4
"""Minimum samples of a block."""


@dataclass(frozen=True)
class HeldOut:
    """Windows, with the piece of evidence of each sample and the fold of each window.

    ``starts`` are the trajectory and first sample of each window.
    """

    windows: OutputWindows
    starts: tuple[tuple[Trajectory, int], ...]
    pieces: Places
    folds: Places
    summary: Evidence
    warm: int

    @property
    def counted(self) -> NDArray[np.bool_]:
        """Mask ``(n, T + 1)`` of the counted samples: measured, and after the warm-up."""
        late = np.arange(self.windows.y.shape[1]) >= self.warm
        return np.asarray(np.isfinite(self.windows.y).any(axis=-1) & late)

    def rows(self, keep: NDArray[np.bool_]) -> OutputWindows:
        """Select windows by a mask."""
        w = self.windows
        return replace(
            w, y=w.y[keep], u=w.u[keep], w=w.w[keep], x=w.x[keep], censored=w.censored[keep], known=w.known[keep],
            group=np.arange(int(keep.sum())),
        )  # fmt: skip

    def compared(self, own: Array, other: Array, candidates: int) -> HeldOutError:
        """Compare squared errors ``(n, T + 1)`` of a model with those of another; ``candidates`` widens the interval.

        With l_i the logarithms of the ratios by piece: upper = mean(max(l, log GAIN)) + t_{n-1} std / sqrt(n).
        """
        each = self._each(own, other)
        n, mean, error = len(each), float(each.mean()), float(np.sqrt(own[self.counted].mean()))
        if n < FEWEST:
            return HeldOutError(error, math.exp(mean), 0.0, math.inf, 1.0)
        capped = np.maximum(each, math.log(GAIN))  # larger mean, and less scatter from large reductions
        scatter, safe = (max(float(v.std(ddof=1)) / math.sqrt(n), 1e-9) for v in (each, capped))
        wide = float(student.ppf(1.0 - DOUBT / candidates, n - 1))
        upper = float(capped.mean()) + wide * safe
        harm = float(student.cdf((float(capped.mean()) - math.log(HARM)) / safe, n - 1))
        return HeldOutError(
            error, math.exp(mean), math.exp(max(mean - wide * scatter, -700.0)), math.exp(min(upper, 700.0)),
            min(1.0, candidates * harm),
        )  # fmt: skip

    def needed(self, own: Array, other: Array, candidates: int) -> int:
        """Number of further similar recordings for an upper bound below 1; 0 if it would be more than tenfold."""
        capped = np.maximum(self._each(own, other), math.log(GAIN))
        mean, scatter, n = float(capped.mean()), float(capped.std(ddof=1)), len(capped)
        for pieces in range(n + 1, 10 * n + 1):
            wide = float(student.ppf(1.0 - DOUBT / candidates, pieces - 1)) * scatter / math.sqrt(pieces)
            if mean + wide < 0:
                return math.ceil((pieces - n) * self.summary.recordings / n)
        return 0

    def doubt(self, found: HeldOutError, squares: Array, before: Array, candidates: int) -> str:
        """Why the evidence does not suffice to add a candidate with these squared errors; empty if it does."""
        said = f"the error ratio with to without the term is {found.words}"
        if found.ratio >= ADDED:
            return said
        if squares.sum() >= before.sum():
            return f"{said}, but the error over all samples is not smaller"
        if found.upper >= 1.0:
            more = self.needed(squares, before, candidates)
            return f"{said}: not significant" + (
                f"; {more} more such recordings would show the effect" if more else ""
            )
        if self.summary.recordings < FEWEST and found.ratio > GAIN:
            return (
                f"{said}, but must be below {GAIN:g} with fewer than {FEWEST} recordings: add "
                f"{counted(FEWEST - self.summary.recordings, 'recording')}"
            )
        if found.error > POOR and found.ratio > GAIN:
            return f"{said}: with a relative error of {found.error:.2f}, a ratio above {GAIN:g} may be due to chance"
        return ""

    def _each(self, own: Array, other: Array) -> Array:
        """Logarithm of the ratio of errors of each piece of evidence."""
        seen = self.counted
        sums = [np.bincount(self.pieces[seen], weights=v[seen]) for v in (own, other)]
        counts = np.bincount(self.pieces[seen])
        means = [total[counts > 0] / counts[counts > 0] for total in sums]
        floor = SMALL * min(float(own[seen].mean()), float(other[seen].mean())) + 1e-300
        return np.asarray(0.5 * np.log((means[0] + floor) / (means[1] + floor)))


def gathered(known: Sequence[Trajectory], prior: Prior, periods: int, warm: int, most: int) -> HeldOut:
    """Cut windows of all recordings, and form the groups that are held out together.

    A group consists of similar recordings, or of parts of a single recording.
    """
    files = sorted({t.file for t in known})
    share = max(2 if len(files) > 1 else most, most // len(files))
    parts, of = [], []
    starts: list[tuple[Trajectory, int]] = []
    for number, name in enumerate(files):
        own = [t for t in known if t.file == name and len(t.t) > periods]
        if own:
            parts.append(cut_outputs(own, periods, 0, share, prior.states))
            of += [number] * len(parts[-1].x)
            begins = [(t, k) for t in own for k in range(0, len(t.t) - periods, periods)]
            starts += [begins[i] for i in evenly(len(begins), share)]
    joined: dict[str, Any] = {
        key: np.concatenate([getattr(p, key) for p in parts])
        for key in ("y", "u", "w", "x", "censored", "known")
    }
    windows = replace(parts[0], **joined, group=np.arange(len(of)))
    recording, present = np.array(of), sorted(set(of))
    if len(present) > 1:
        order, groups = _by_kind(windows, recording, present), min(FOLDS, len(present))
        fold = dict(zip(order, np.arange(len(order)) * groups // len(order), strict=True))
        folds = np.array([fold[own] for own in of])
    else:
        groups = min(FOLDS, len(of))
        folds = np.arange(len(of)) * groups // len(of)
    samples, text = windows.y.shape[1], "one recording" if len(present) == 1 else f"{len(present)} recordings"
    pieces, count = np.repeat(recording[:, None], samples, axis=1), len(present)
    if len(present) < MANY:  # a few recordings are cut into blocks as pieces of evidence
        lasting, count = MEMORY * time_unit(known, known[0].dt) / known[0].dt, 0
        for recorded in present:
            at = np.flatnonzero(recording == recorded)
            whole = len(at) * samples
            most = max(FEWEST / len(present), min(BLOCKS / len(present), whole / lasting))
            blocks = max(1, min(math.ceil(most), whole // SHORTEST))
            pieces[at] = (count + np.arange(whole) * blocks // whole).reshape(len(at), samples)
            count += blocks
        if count < FEWEST or groups < 2:
            raise InputError(
                f"{len(present)} recording of {whole} samples is too short to test terms. Add a similar recording, or "
                f"record at least {2 * samples} samples [HM-IDENTIFY-011]"
            )
        text = f"{count} blocks of {text}"
    summary = Evidence(len(present), count, groups, periods * known[0].dt, f"{text} in {groups} groups")
    return HeldOut(windows, tuple(starts), pieces, folds, summary, min(warm, samples // 3))


def _by_kind(windows: OutputWindows, pieces: Places, present: Sequence[int]) -> list[int]:
    """Sort recordings along the first principal component of means and sizes of inputs, outputs and disturbances.

    Neighbours are held out together, so held-out recordings differ from the fitted ones. Otherwise the held-out error
    would be too optimistic.
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
