"""Recordings on the model's uniform grid, as trajectories with states, derivatives and roles."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.differentiate import local_polynomial, window_samples
from hybrid_mpc.data.findings import MIN_SCORED, Finding, findings_of, gaps
from hybrid_mpc.data.recording import Flags, Recording, Samples, Signals, find_misspelt, read_recordings
from hybrid_mpc.errors import SHOWN, InputError, refuse
from hybrid_mpc.machine.specification import DataSpec, Role, Window

Array = NDArray[np.float64]
ROLES: tuple[Role, ...] = ("train", "valid", "test")
TINY = 1e-6  # tolerance [periods] in counts of periods: above rounding
NEAR = 5e-5  # tolerance [periods] between time stamps, which files round: 1 us at 20 ms
FINEST = 1000  # most samples of the model's grid per recorded sample: beyond it a unit is wrong


@dataclass(frozen=True)
class Trajectory(Samples):
    """One contiguous piece of a recording on the uniform grid ``dt``.

    Args:
        name: ``"<file stem>"``; later pieces of the same file are ``"<file stem>#2"`` and so on.
        role: ``"train"``, ``"valid"``, ``"test"``; ``""`` for a whole recording.
        dt: Period [s].
        t: Times ``(n,)`` [s] in the recording's own time.
        u: Inputs ``(n, n_u)`` over ``[t_k, t_k + dt)``: the mean of the recorded zero-order hold.
        y: Measured outputs ``(n, n_y)``, interpolated to the grid and not smoothed; NaN where no sample of the output
            is near (:func:`to_grid`).
        x: Smoothed states ``(n, n_x)``, ``[q, v]``, if the outputs are the positions ``q``; else NaN.
        xdot: Smoothed derivatives of the states ``(n, n_x)``, ``[v, v_dot]``, or NaN.
        w: Disturbances ``(n, n_w)`` over ``[t_k, t_k + dt)``: the mean of the straight lines between their samples.
            Default: none, ``(n, 0)``.
        censored: ``(n, n_y)``: 0 where ``y`` is measured, -1 at the sensor's lower end (the true value is at most
            ``y``), +1 at its upper end (the true value is at least ``y``). Default: zeros.
    """

    name: str
    role: str
    dt: float
    t: Array
    u: Array
    y: Array
    x: Array
    xdot: Array
    w: Array = field(default_factory=lambda: np.zeros((0, 0)))
    censored: Flags = field(default_factory=lambda: np.zeros((0, 0), dtype=np.int8))

    @property
    def file(self) -> str:
        """Stem of the recording's file."""
        return self.name.split("#")[0]

    def part(
        self, keep: NDArray[np.bool_] | slice, name: str | None = None, role: str | None = None
    ) -> Trajectory:
        """The samples in ``keep``, a slice or a contiguous mask ``(n,)``, optionally with another name or role."""
        arrays = {key: getattr(self, key)[keep] for key in ("t", "u", "y", "x", "xdot", "w", "censored")}
        name, role = self.name if name is None else name, self.role if role is None else role
        return replace(self, name=name, role=role, **arrays)


@dataclass(frozen=True)
class Cut:
    """A part of a recording that is cut out or interpolated.

    Args:
        file: Name of the recording.
        start_s: Start [s] in the recording's own time: the last sample before it.
        end_s: End [s]: the first sample after it.
        why: Its reason.
    """

    file: str
    start_s: float
    end_s: float
    why: str


@dataclass(frozen=True)
class Dataset:
    """All recordings of a run.

    Args:
        trajectories: Pieces for training, validation and test; no sample has two roles.
        whole: The recordings from first to last sample (one for each side of a gap), role ``""``.
        cuts: Parts that are left out, with reasons.
        files: File names, in the order given.
        sha256: SHA-256 of each file, in the same order.
        hash: One hash of all files' names and contents, independent of their order and folder.
        findings: Doubtful data (:mod:`hybrid_mpc.data.findings`), and how files were read. Default: none.
        sampling: Median step [s] of the time stamps of each file, in the same order. Default: unknown.
    """

    trajectories: tuple[Trajectory, ...]
    whole: tuple[Trajectory, ...]
    cuts: tuple[Cut, ...]
    files: tuple[str, ...]
    sha256: tuple[str, ...]
    hash: str
    findings: tuple[Finding, ...] = ()
    sampling: tuple[float, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is doubtful about the recordings, one text per finding."""
        return tuple(str(one) for one in self.findings if not one.is_note)

    @property
    def notes(self) -> tuple[str, ...]:
        """How files were read that needed more than a plain table, e.g. a decimal comma; one text per file."""
        return tuple(str(one) for one in self.findings if one.is_note)

    def by_role(self, role: Role) -> tuple[Trajectory, ...]:
        """The trajectories of one role, in order."""
        return tuple(piece for piece in self.trajectories if piece.role == role)


def load_trajectories(
    paths: Sequence[Path | str], prior: Signals, spec: DataSpec, *, needed: Sequence[Role] = ROLES
) -> Dataset:
    """Read recordings, cut them at gaps, remove known delays, smooth, resample to ``spec.dt``, and assign roles.

    If the outputs are the positions ``q`` of states ``[q, v]`` (equal count and names), ``x`` and ``xdot`` are smoothed
    before resampling and splitting. A smoothed value depends on half of ``spec.smoothing`` before and after it. It is
    NaN over gaps, and where samples of its output are missing or censored for longer than ``spec.max_gap``. For other
    outputs ``x`` and ``xdot`` are NaN: states then come from the prior's equations. Parts by ``fractions`` are
    ``spec.smoothing`` apart; ``windows`` should be, too.

    Args:
        paths: Files with different stems, of any formats and lengths.
        prior: The prior, its class, or a model. Its signals define the columns and their order, whether the outputs are
            positions, and the plausible ranges.
        spec: Columns, ``dt``, ``max_gap``, ``smoothing``, ``warm_up`` [s], delays and the split.
        needed: Roles that must not be empty. Default: all three.

    Raises:
        InputError: With all problems of all files: bad recordings
            (:func:`~hybrid_mpc.data.recording.read_recording`), columns that differ between them, overlapping windows,
            a role without a trajectory, sampling too coarse or uneven for ``smoothing``, implausible speeds.

    Example:
        >>> import tempfile
        >>> from hybrid_mpc import Prior, Signal, write_csv
        >>> class Swing(Prior):
        ...     states = (Signal("phi", "rad"), Signal("phi_dot", "rad/s"))
        ...     inputs, outputs = (Signal("tau", "N m"),), states[:1]
        >>> spec = DataSpec("t", ("tau",), ("phi",), dt=0.02, max_gap=0.05, smoothing=0.1, warm_up=0.5)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     t = 0.01 * np.arange(1000)
        ...     file = write_csv(Path(folder) / "run.csv", {"t": t, "tau": 0 * t, "phi": np.sin(t)})
        ...     data = load_trajectories([file], Swing, spec)
        >>> [(piece.name, piece.role, len(piece.t)) for piece in data.trajectories]
        [('run', 'train', 299), ('run#2', 'valid', 94), ('run#3', 'test', 94)]
    """
    if isinstance(paths, str | bytes | Path) or not all(isinstance(path, str | Path) for path in paths):
        raise InputError(f"recordings: must be a list of paths, got {paths!r:.80} [HM-DATA-098]")
    if not paths:
        raise InputError("recordings: none given. Name at least one file with --data. [HM-DATA-099]")
    _check_windows(spec)
    recordings, problems = read_recordings(paths, prior, spec)
    outputs, states = prior.outputs, prior.states
    names = [[s.name for s in signals] for signals in (outputs, states)]
    positions = len(states) == 2 * len(outputs) and names[0] == names[1][: len(outputs)]
    trajectories: list[Trajectory] = []
    whole: list[Trajectory] = []
    motions: list[tuple[Array, Array]] = []
    cuts: list[Cut] = []
    for recording in recordings:
        own: list[Trajectory] = []
        try:
            own = list(_segments(recording, spec, None if positions else len(states), cuts))
            trajectories += _pieces(recording, own, spec, cuts)
        except InputError as error:
            problems.append(f"{recording.path}: {error}")
        whole += own
        t, x = [piece.t for piece in own], [piece.x for piece in own]
        motions.append((np.concatenate(t), np.concatenate(x)) if own else (np.zeros(0), np.zeros((0, 0))))
    findings = findings_of(recordings, motions, spec, outputs=outputs, states=states if positions else ())
    findings = (*findings, *find_misspelt(spec, [recording.path for recording in recordings]))
    paths_of = {recording.path.name: recording.path for recording in recordings}
    refuse(
        problems + [f"{paths_of[one.file]}: {one.message} [HM-DATA-100]" for one in findings if one.refused]
    )
    _check_roles(trajectories, cuts, spec, needed)
    contents = "".join(sorted(f"{one.name} {one.sha256}\n" for one in recordings))
    return Dataset(
        tuple(trajectories),
        tuple(whole),
        tuple(cuts),
        files=tuple(one.path.name for one in recordings),
        sha256=tuple(one.sha256 for one in recordings),
        hash=hashlib.sha256(contents.encode()).hexdigest(),
        findings=findings,
        sampling=tuple(one.dt for one in recordings),
    )


def _segments(recording: Recording, spec: DataSpec, n_x: int | None, cuts: list[Cut]) -> Iterator[Trajectory]:
    """Resampled parts between gaps, numbered; parts that are too short become cuts.

    States are smoothed if ``n_x`` is None; else the ``n_x`` states are NaN.
    """
    times, period, number, file = recording.t, recording.dt, 0, recording.path.name
    ends = np.flatnonzero(gaps(times, spec.max_gap))
    for first in recording.cuts:
        why = "the number of turns of an angle during missing samples is unknown"
        cuts.append(Cut(file, float(times[first - 1]), float(times[first]), why))
    for k in ends:
        why = f"gap of {times[k + 1] - times[k]:.4g} s is longer than max_gap {spec.max_gap:g} s"
        cuts.append(Cut(file, float(times[k]), float(times[k + 1]), why))
    ends = np.union1d(ends, np.array(recording.cuts, dtype=np.intp) - 1)
    shortest = _fewest(spec) * spec.dt
    samples = window_samples(spec.smoothing, period) if n_x is None else 0
    _check_sampling(recording, samples, spec)
    shortest = max((samples - 1) * period + spec.dt, shortest) if samples else shortest
    # an input acts later than recorded; a measured value belongs to an earlier time
    delays = spec.delays_in(recording.name)
    late_u, late_w, late_y = (
        [sign * delays.get(name, 0.0) for name in names]
        for sign, names in ((1, spec.inputs_in(recording.name)), (-1, spec.disturbances), (-1, spec.outputs))
    )
    for rows in np.split(np.arange(len(times)), ends + 1):
        origin, t = float(times[rows[0]]), times[rows] - times[rows[0]]
        # the time that every channel covers; blank cells of an output do not shorten it
        spans = [(late, t[-1] + late) for late in (*late_u, *late_y)]
        for late, column in zip(late_w, recording.w[rows].T, strict=True):
            known = t[np.isfinite(column)]
            spans.append((known[0] + late, known[-1] + late) if len(known) else (0.0, 0.0))
        start, end = float(max(begin for begin, _ in spans)), float(min(end for _, end in spans))
        if end - start < shortest - NEAR * spec.dt:
            why = _too_short(shortest, spec)
            if t[-1] >= shortest - NEAR * spec.dt:
                why = f"without the known delays, the time covered by all columns is {why}"
            cuts.append(Cut(file, origin, origin + float(t[-1]), why))
            continue
        for one, two in ((0.0, start), (end, float(t[-1]))):
            if two - one > NEAR * spec.dt:
                why = "not covered by all columns without the known delays"
                cuts.append(Cut(file, origin + one, origin + two, why))
        number += 1
        grid: Array = start + spec.dt * np.arange(
            int(np.floor((end - start) / spec.dt + TINY)), dtype=np.float64
        )
        n, y, censored = len(grid), recording.y[rows], recording.censored[rows]
        u = [
            hold_mean(t + a, z[:, None], grid, spec.dt)
            for a, z in zip(late_u, recording.u[rows].T, strict=True)
        ]
        w = [
            line_mean(t + a, z, grid, spec.dt)[:, None]
            for a, z in zip(late_w, recording.w[rows].T, strict=True)
        ]
        outputs = list(zip(late_y, y.T, censored.T, strict=True))
        measured = [to_grid(t + a, z, flags, grid, spec.dt, spec.max_gap) for a, z, flags in outputs]
        x = xdot = np.full((n, n_x or 0), np.nan)
        if n_x is None:
            motions = [
                _smoothed(t + a, np.where(flags == 0, z, np.nan), grid, period, spec)
                for a, z, flags in outputs
            ]
            q, v, a = (np.column_stack(columns) for columns in zip(*motions, strict=True))
            x, xdot = np.hstack([q, v]), np.hstack([v, a])
        yield Trajectory(
            _numbered(recording.name, number),
            "",
            spec.dt,
            origin + grid,
            u=np.hstack([np.zeros((n, 0)), *u]),
            y=np.column_stack([y for y, _ in measured]),
            x=x,
            xdot=xdot,
            w=np.hstack([np.zeros((n, 0)), *w]),
            censored=np.column_stack([flags for _, flags in measured]),
        )


def _check_sampling(recording: Recording, samples: int, spec: DataSpec) -> None:
    """Refuse sampling that is too uneven, too coarse for the period, or too fine to smooth over ``samples``."""
    steps = np.diff(recording.t)
    mean = float(steps[~gaps(recording.t, spec.max_gap)].mean())  # gaps left out
    # largest ratio of mean to median sampling period: smoothing assumes the median
    if samples and mean > 20.0 * recording.dt:
        raise InputError(
            f"sampling is uneven: the median step of the time stamps is {recording.dt:.3g} s, the mean step {mean:.3g} "
            "s. Record at a constant rate, or check the time stamps. [HM-DATA-101]"
        )
    # most multiplications of smoothing, samples times samples in a window: half a minute
    if samples * len(recording.t) * mean / recording.dt > 2e10:
        raise InputError(
            f"smoothing of {spec.smoothing:g} s covers {samples} of {len(recording.t)} samples, too many to compute. "
            f"The model period is {spec.dt:g} s: keep every tenth or hundredth row, or split the recording. "
            "[HM-DATA-102]"
        )
    if mean > FINEST * spec.dt:
        raise InputError(
            f"the model period of {spec.dt:g} s is more than {FINEST} times finer than the sampling (mean step "
            f"{mean:.3g} s). Raise dt in the DataSpec, or check that time is in seconds. [HM-DATA-103]"
        )


def _smoothed(t: Array, y: Array, grid: Array, period: float, spec: DataSpec) -> tuple[Array, Array, Array]:
    """Value and two derivatives of one output on the grid; NaN outside stretches with samples."""
    known = np.isfinite(y)
    t, y = t[known], y[known]
    value, first, second = (np.full(len(grid), np.nan) for _ in range(3))
    for rows in np.split(np.arange(len(t)), np.flatnonzero(gaps(t, spec.max_gap)) + 1):
        if not len(rows):
            continue
        start, end = t[rows[0]], t[rows[-1]]
        fine = start + period * np.arange(int(np.floor((end - start) / period + TINY)) + 1)
        if len(fine) < window_samples(spec.smoothing, period):
            continue
        smooth = local_polynomial(np.interp(fine, t[rows], y[rows]), period, spec.smoothing)
        inside = (grid >= start - NEAR * spec.dt) & (grid <= end + NEAR * spec.dt)
        from scipy.interpolate import CubicSpline

        for array, z in ((value, smooth.value), (first, smooth.first), (second, smooth.second)):
            array[inside] = CubicSpline(fine, z)(grid[inside])
    return value, first, second


def to_grid(
    t: Array, y: Array, censored: Flags, grid: Array, dt: float, max_gap: float
) -> tuple[Array, Flags]:
    """One output's samples on a grid of period ``dt`` [s], without invented values; and the censored ones.

    Between two samples at most ``max_gap`` [s] apart the grid has the straight line. Elsewhere, e.g. between samples of
    a slow analyser, each sample moves to the nearest grid point, at most half a period away; all other points are NaN.
    A straight line to a censored sample is a bound of the same side; between opposite ends of a sensor it is NaN.

    Args:
        t: Times ``(m,)`` [s] of the rows, increasing.
        y: Samples ``(m,)``; NaN where missing.
        censored: -1, 0 or +1 ``(m,)`` for each sample.
        grid: Times ``(n,)`` [s], ``dt`` apart; the function returns values ``(n,)`` and flags -1, 0 or +1.
        dt: Period [s].
        max_gap: Longest distance [s] that a straight line bridges.

    Example:
        >>> t = 0.1 * np.arange(9)
        >>> slow = np.where(np.arange(9) % 4 == 0, 10.0 + t, np.nan)
        >>> to_grid(t, slow, np.zeros(9, dtype=np.int8), t, 0.1, max_gap=0.2)[0].round(3).tolist()
        [10.0, nan, nan, nan, 10.4, nan, nan, nan, 10.8]
    """
    known = np.isfinite(y)
    t, y, censored = t[known], y[known], censored[known]
    values, flags = np.full(len(grid), np.nan), np.zeros(len(grid), dtype=np.int8)
    if not len(t):
        return values, flags
    left = np.searchsorted(t, grid, side="right") - 1
    between = (left >= 0) & (left < len(t) - 1)
    between[between] &= ~gaps(t, max_gap)[left[between]]
    left = left[between]
    values[between] = np.interp(grid[between], t, y)
    share = (grid[between] - t[left]) / (t[left + 1] - t[left])
    one = np.where(share < 1 - TINY, censored[left], 0)
    two = np.where(share > TINY, censored[left + 1], 0)
    flags[between] = np.where(one == 0, two, one)
    values[np.flatnonzero(between)[one * two < 0]] = np.nan
    # TINY: a sample halfway between two points belongs to the earlier one, whatever the rounding
    nearest = np.floor((t - grid[0]) / dt + 0.5 - TINY).astype(np.int64)
    alone = np.flatnonzero((nearest >= 0) & (nearest < len(grid)))
    alone = alone[~between[nearest[alone]]]
    away = np.abs(t[alone] - grid[nearest[alone]])
    alone = alone[np.argsort(-away, kind="stable")]  # the nearest sample is written last and remains
    values[nearest[alone]], flags[nearest[alone]] = y[alone], censored[alone]
    flags[np.isnan(values)] = 0
    return values, flags


def hold_mean(t: Array, u: Array, grid: Array, dt: float) -> Array:
    """Mean over ``[T_k, T_k + dt)`` of an input ``(m, n_u)`` recorded as a zero-order hold; exact for any stamps.

    Each input is held until the next time stamp and is zero outside the recording.
    """
    integral = np.vstack([np.zeros((1, u.shape[1])), np.cumsum(u[:-1] * np.diff(t)[:, None], axis=0)])
    means = [(np.interp(grid + dt, t, z) - np.interp(grid, t, z)) / dt for z in integral.T]
    return np.column_stack(means)


def line_mean(t: Array, w: Array, grid: Array, dt: float) -> Array:
    """Mean over ``[T_k, T_k + dt)`` of the straight lines between samples ``(m,)``; NaN marks missing ones. Exact.

    The first sample also holds before it, the last one after it.

    Example:
        >>> line_mean(np.array([0.0, 1.0, 2.0, 3.0]), np.array([0.0, np.nan, 4.0, 4.0]), np.array([0.0, 1.5]), 1.0)
        array([1.  , 3.75])
    """
    known = np.isfinite(w)
    t, w = t[known], w[known]
    area = np.r_[0.0, np.cumsum((w[1:] + w[:-1]) / 2 * np.diff(t))]

    def integral(times: Array) -> Array:
        k = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 1)
        return np.asarray(area[k] + (times - t[k]) * (w[k] + np.interp(times, t, w)) / 2)

    return (integral(grid + dt) - integral(grid)) / dt


def _pieces(
    recording: Recording, segments: list[Trajectory], spec: DataSpec, cuts: list[Cut]
) -> list[Trajectory]:
    """Intersections of windows and segments, ordered by time; pieces that are too short become cuts."""
    pieces: list[Trajectory] = []
    for window in sorted(_windows(recording, spec), key=lambda window: window.start):
        for segment in segments:
            near = max(NEAR * spec.dt, 4 * float(np.spacing(np.abs(segment.t).max())))
            keep = (segment.t >= window.start - near) & (segment.t + spec.dt <= window.end + near)
            if not keep.any():
                continue
            piece = segment.part(keep, _numbered(recording.name, len(pieces) + 1), window.role)
            why = "" if np.isfinite(piece.y).any() else "no sample of any output"
            why = _too_short(_fewest(spec) * spec.dt, spec) if len(piece.t) < _fewest(spec) else why
            if not why:
                pieces.append(piece)
                continue
            first, last = float(piece.t[0]), float(piece.t[-1])
            cuts.append(Cut(recording.path.name, first, last, f"{window.role}: {why}"))
    return pieces


def _windows(recording: Recording, spec: DataSpec) -> tuple[Window, ...]:
    """The file's windows from the specification, or its parts by fractions, a smoothing length apart."""
    if recording.name in spec.windows:
        return tuple(spec.windows[recording.name])
    start, length = float(recording.t[0]), float(recording.t[-1] - recording.t[0])
    windows: list[Window] = []
    for role, fraction in zip(ROLES, spec.fractions, strict=True):
        if fraction > 0:
            distance = spec.smoothing if windows else 0.0
            # a part shorter than that distance becomes one without samples, which is cut and reported
            end = max(start + fraction * length, math.nextafter(start + distance, math.inf))
            windows.append(Window(start + distance, end, role))
            start += fraction * length
    last = windows[-1]
    windows[-1] = replace(last, end=last.end + spec.dt)
    return tuple(windows)


def _check_windows(spec: DataSpec) -> None:
    for stem, windows in spec.windows.items():
        for one, two in pairwise(sorted(windows, key=lambda window: window.start)):
            if two.start < one.end:
                raise InputError(
                    f"windows overlap in {stem}: {one.role} {one.start:g} to {one.end:g} s and "
                    f"{two.role} {two.start:g} to {two.end:g} s. Separate them: a sample has one role. [HM-DATA-104]"
                )


def _check_roles(
    trajectories: list[Trajectory], cuts: list[Cut], spec: DataSpec, needed: Sequence[Role]
) -> None:
    missing = [role for role in needed if all(piece.role != role for piece in trajectories)]
    if not missing:
        return
    dropped = "".join(f"\n  {cut.file} {cut.start_s:g} to {cut.end_s:g} s: {cut.why}" for cut in cuts[:SHOWN])
    dropped += f"\n  and {len(cuts) - SHOWN} more" if len(cuts) > SHOWN else ""
    used = [fraction for fraction in spec.fractions if fraction > 0]
    distances = [0.0, *(spec.smoothing for _ in used[1:])]
    least = (_fewest(spec) + 1) * spec.dt
    needed_s = max((least + distance) / fraction for fraction, distance in zip(used, distances, strict=True))
    raise InputError(
        f"recordings: no piece of at least {_fewest(spec) * spec.dt:g} s is left for {' and '.join(missing)}. "
        "Give more or longer recordings, or change windows, fractions or max_gap in the DataSpec. A recording "
        f"without gaps, split by fractions, needs {needed_s:.3g} s."
        f"{f' Cut out:{dropped}' if dropped else ''} [HM-DATA-114]"
    )


def _fewest(spec: DataSpec) -> int:
    """Fewest samples of a piece: the warm-up and ``MIN_SCORED`` periods."""
    return int(np.ceil(spec.warm_up / spec.dt - TINY)) + MIN_SCORED


def _too_short(need: float, spec: DataSpec) -> str:
    return (
        f"shorter than the {need:.4g} s that warm-up ({spec.warm_up:g} s), smoothing and {MIN_SCORED} periods of dt "
        f"({spec.dt:g} s) need"
    )


def _numbered(stem: str, number: int) -> str:
    return stem if number == 1 else f"{stem}#{number}"
