"""From recordings to trajectories on the model's uniform grid, with states, derivatives and roles."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from hybrid_mpc.data.differentiate import local_polynomial, window_samples
from hybrid_mpc.data.findings import findings_of
from hybrid_mpc.data.recording import MIN_SCORED, Finding, Recording, gaps, read_recordings
from hybrid_mpc.errors import SHOWN, InputError, refuse
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.specification import DataSpec, Role, Window

Array = NDArray[np.float64]
ROLES: tuple[Role, ...] = ("train", "valid", "test")
TINY = 1e-6
"""Tolerance [s] of comparisons between time stamps; far below any sampling time, above rounding."""
UNEVEN = 20.0
"""Largest ratio of mean to median sampling interval: smoothing works on the median."""
WORK = 2e10
"""Most products of smoothing, samples times those in a window: half a minute."""


@dataclass(frozen=True)
class Trajectory:
    """One contiguous piece of a recording on the uniform grid ``dt``.

    Args:
        name: ``"<file stem>"``, or ``"<file stem>#2"`` for the second piece of that file.
        role: ``"train"``, ``"valid"``, ``"test"``; ``""`` for a whole recording.
        dt: Period [s].
        t: Times ``(n,)`` [s] in the recording's own time.
        u: Inputs ``(n, n_u)`` held over ``[t_k, t_k + dt)``: the mean of the recorded zero-order hold.
        y: Measured outputs ``(n, n_y)``, interpolated to the grid and not smoothed.
        x: States ``(n, n_x)``, ``[q, v]`` smoothed.
        xdot: Derivatives of the states ``(n, n_x)``, ``[v, v_dot]`` smoothed.
        w: Measured disturbances ``(n, n_w)``. Default: none.
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

    def __post_init__(self) -> None:
        if not self.w.size:
            object.__setattr__(self, "w", np.zeros((len(self.t), 0)))

    @property
    def file(self) -> str:
        """Stem of the file that it comes from."""
        return self.name.split("#")[0]

    def part(
        self, keep: NDArray[np.bool_] | slice, name: str | None = None, role: str | None = None
    ) -> Trajectory:
        """The samples of ``keep``, a slice or a mask ``(n,)`` of one contiguous run.

        Args:
            keep: Which samples.
            name: New name. Default: as before.
            role: New role. Default: as before.
        """
        arrays = {key: getattr(self, key)[keep] for key in ("t", "u", "y", "x", "xdot", "w")}
        own = (self.name if name is None else name), (self.role if role is None else role)
        return replace(self, name=own[0], role=own[1], **arrays)


class Cut(NamedTuple):
    """A part of a recording that is not used as it was recorded: file name, from and to [s], and why."""

    file: str
    start: float
    end: float
    why: str


@dataclass(frozen=True)
class Dataset:
    """All recordings of a run.

    Args:
        trajectories: Pieces for training, validation and test; no sample has two roles.
        whole: The recordings from first to last sample (one for each side of a gap), role ``""``.
        cuts: What was left out, and why.
        files: File names, in the order given.
        sha256: SHA-256 of each file, in the same order.
        hash: One hash of all files' names and contents; it does not depend on their order or folder.
        findings: What is doubtful about the recordings (:mod:`hybrid_mpc.data.findings`). Default: nothing.
    """

    trajectories: tuple[Trajectory, ...]
    whole: tuple[Trajectory, ...]
    cuts: tuple[Cut, ...]
    files: tuple[str, ...]
    sha256: tuple[str, ...]
    hash: str
    findings: tuple[Finding, ...] = ()

    def by_role(self, role: Role) -> tuple[Trajectory, ...]:
        """The trajectories of one role, in order."""
        return tuple(piece for piece in self.trajectories if piece.role == role)


def load_trajectories(
    paths: Sequence[Path | str],
    spec: DataSpec,
    *,
    outputs: tuple[Signal, ...],
    inputs: tuple[Signal, ...],
    states: Sequence[Signal] = (),
    needed: Sequence[Role] = ROLES,
) -> Dataset:
    """Read recordings, cut them at gaps, smooth and differentiate, resample to ``spec.dt``, give roles.

    The outputs are the positions ``q``; velocities and accelerations are their derivatives. Smoothing comes before
    resampling and the split, never across a gap: a sample's ``x`` and ``xdot`` know half of ``spec.smoothing`` of the
    time before and after it. Parts by ``fractions`` keep ``spec.smoothing`` apart; ``windows`` should, too.

    Args:
        paths: CSV, ``.npz`` or ``.mat`` files with different stems, of any lengths.
        spec: Columns, ``dt``, ``max_gap``, ``smoothing``, ``warm_up`` [s] and the split.
        outputs: Signals of the prior's outputs (positions).
        inputs: Signals of the prior's inputs.
        states: Signals of the prior's states ``[q, v, ...]``, for the plausible ranges of the speeds. Default: speeds
            are not checked.
        needed: Roles that must not be empty. Default: all three.

    Raises:
        InputError: If recordings are bad (see :func:`~hybrid_mpc.data.recording.read_recording`), columns differ
            between them, windows overlap, a role gets no trajectory, the sampling is too coarse or too uneven for
            ``smoothing``, or the speeds are beyond all that is plausible. It names all that is wrong with all files.

    Example:
        >>> import tempfile
        >>> from hybrid_mpc import write_csv
        >>> spec = DataSpec("t", ("tau",), ("phi",), dt=0.02, max_gap=0.05, smoothing=0.1, warm_up=0.5)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     t = 0.01 * np.arange(1000)
        ...     file = write_csv(Path(folder) / "run.csv", {"t": t, "tau": 0 * t, "phi": np.sin(t)})
        ...     data = load_trajectories([file], spec, outputs=(Signal("phi", "rad"),),
        ...                              inputs=(Signal("tau", "N m"),))
        >>> [(piece.name, piece.role, len(piece.t)) for piece in data.trajectories]
        [('run', 'train', 299), ('run#2', 'valid', 94), ('run#3', 'test', 94)]
    """
    if not paths:
        raise InputError("no recordings given; name at least one file with --data")
    _check_windows(spec)
    recordings, problems = read_recordings(paths, spec, outputs=outputs, inputs=inputs)
    trajectories: list[Trajectory] = []
    whole: list[Trajectory] = []
    motions: list[tuple[Array, Array]] = []
    cuts: list[Cut] = []
    for recording in recordings:
        own: list[Trajectory] = []
        try:
            own = list(_segments(recording, spec, cuts))
            trajectories += _pieces(recording, own, spec, cuts)
        except InputError as error:
            problems.append(f"{recording.path}: {error}")
        whole += own
        t, x = [piece.t for piece in own], [piece.x for piece in own]
        motions.append((np.concatenate(t), np.concatenate(x)) if own else (np.zeros(0), np.zeros((0, 0))))
    findings = findings_of(recordings, motions, spec, outputs=outputs, states=states)
    paths_of = {recording.path.name: recording.path for recording in recordings}
    problems += [f"{paths_of[finding.file]}: {finding.message}" for finding in findings if finding.refused]
    refuse(problems)
    _check_roles(trajectories, cuts, spec, needed)
    return Dataset(
        trajectories=tuple(trajectories),
        whole=tuple(whole),
        cuts=tuple(cuts),
        files=tuple(recording.path.name for recording in recordings),
        sha256=tuple(recording.sha256 for recording in recordings),
        hash=hashlib.sha256(
            "".join(sorted(f"{t.name} {t.sha256}\n" for t in recordings)).encode()
        ).hexdigest(),
        findings=findings,
    )


def _segments(recording: Recording, spec: DataSpec, cuts: list[Cut]) -> Iterator[Trajectory]:
    """Smoothed and resampled parts between gaps, numbered; too short ones become cuts."""
    ends = np.flatnonzero(gaps(recording.t, spec.max_gap))
    for k in ends:
        why = f"gap of {recording.t[k + 1] - recording.t[k]:.4g} s is longer than max_gap {spec.max_gap:g} s"
        cuts.append(Cut(recording.path.name, float(recording.t[k]), float(recording.t[k + 1]), why))
    samples = window_samples(spec.smoothing, recording.dt)
    _check_sampling(recording, samples, spec)
    shortest = max((samples - 1) * recording.dt, (_fewest(spec) - 1) * spec.dt) + spec.dt
    number = 0
    for rows in np.split(np.arange(len(recording.t)), ends + 1):
        t = recording.t[rows]
        if t[-1] - t[0] < shortest - TINY:
            cuts.append(Cut(recording.path.name, float(t[0]), float(t[-1]), _too_short(shortest, spec)))
            continue
        number += 1
        yield _resample(recording, rows, spec, _numbered(recording.name, number))


def _check_sampling(recording: Recording, samples: int, spec: DataSpec) -> None:
    """Refuse sampling that smoothing would take gigabytes or minutes for."""
    steps = np.diff(recording.t)
    mean = float(steps[~gaps(recording.t, spec.max_gap)].mean())
    if mean > UNEVEN * recording.dt:
        raise InputError(
            f"sampling is uneven: the time stamps are {recording.dt:.3g} s apart in the median and {mean:.3g} s in "
            "the mean. Record at one rate, or check the time stamps."
        )
    if samples * len(recording.t) * mean / recording.dt > WORK:
        raise InputError(
            f"smoothing of {spec.smoothing:g} s holds {samples} of {len(recording.t)} samples, too many to work "
            f"with. The model's period is {spec.dt:g} s: give every tenth or hundredth row, or split the recording."
        )


def _resample(recording: Recording, rows: NDArray[np.intp], spec: DataSpec, name: str) -> Trajectory:
    t, y, u = recording.t[rows], recording.y[rows], recording.u[rows]
    n = int(np.floor((t[-1] - t[0]) / spec.dt + TINY))
    grid = t[0] + spec.dt * np.arange(n)
    fine = t[0] + recording.dt * np.arange(int(np.floor((t[-1] - t[0]) / recording.dt + TINY)) + 1)
    smooth = local_polynomial(_interpolate(t, y, fine), recording.dt, spec.smoothing)
    q, v, a = (CubicSpline(fine, z)(grid) for z in (smooth.value, smooth.first, smooth.second))
    return Trajectory(
        name=name,
        role="",
        dt=spec.dt,
        t=grid,
        u=hold_mean(t, u, grid, spec.dt),
        y=_interpolate(t, y, grid),
        x=np.hstack([q, v]),
        xdot=np.hstack([v, a]),
    )


def hold_mean(t: Array, u: Array, grid: Array, dt: float) -> Array:
    """Mean over ``[T_k, T_k + dt)`` of an input ``(m, n_u)`` recorded as a zero-order hold: exact, whatever the stamps.

    Each input is held until the next time stamp; it is zero outside the recording.
    """
    integral = np.vstack([np.zeros((1, u.shape[1])), np.cumsum(u[:-1] * np.diff(t)[:, None], axis=0)])
    return (_interpolate(t, integral, grid + dt) - _interpolate(t, integral, grid)) / dt


def _interpolate(t: Array, z: Array, grid: Array) -> Array:
    """Linear interpolation of each column of ``z`` ``(m, n_z)``."""
    return np.column_stack([np.interp(grid, t, column) for column in z.T])


def _pieces(
    recording: Recording, segments: list[Trajectory], spec: DataSpec, cuts: list[Cut]
) -> list[Trajectory]:
    """Intersections of windows and segments, in order of time; too short ones become cuts."""
    pieces: list[Trajectory] = []
    for window in sorted(_windows(recording, spec), key=lambda window: window.start):
        for segment in segments:
            keep = (segment.t >= window.start - TINY) & (segment.t + spec.dt <= window.end + TINY)
            if not keep.any():
                continue
            piece = segment.part(keep, _numbered(recording.name, len(pieces) + 1), window.role)
            if len(piece.t) >= _fewest(spec):
                pieces.append(piece)
            else:
                why = f"{window.role}: " + _too_short(_fewest(spec) * spec.dt, spec)
                cuts.append(Cut(recording.path.name, float(piece.t[0]), float(piece.t[-1]), why))
    return pieces


def _windows(recording: Recording, spec: DataSpec) -> tuple[Window, ...]:
    """The file's named windows, or its parts by fractions with the smoothing length between them."""
    if recording.name in spec.windows:
        return tuple(spec.windows[recording.name])
    start, length = float(recording.t[0]), float(recording.t[-1] - recording.t[0])
    windows: list[Window] = []
    for role, fraction in zip(ROLES, spec.fractions, strict=True):
        if fraction > 0:
            distance = spec.smoothing if windows else 0.0
            windows.append(Window(start + distance, start + fraction * length, role))
            start += fraction * length
    last = windows[-1]
    windows[-1] = replace(last, end=last.end + spec.dt)
    return tuple(windows)


def _check_windows(spec: DataSpec) -> None:
    for stem, windows in spec.windows.items():
        ordered = sorted(windows, key=lambda window: window.start)
        for window in ordered:
            if not window.start < window.end or window.role not in (*ROLES, "nominal"):
                raise InputError(
                    f"data specification: window {window} of {stem} needs start < end and one of "
                    f"{(*ROLES, 'nominal')}"
                )
        for one, two in pairwise(ordered):
            if two.start < one.end:
                raise InputError(
                    f"windows overlap in {stem}: {one.role} {one.start:g} to {one.end:g} s, "
                    f"{two.role} {two.start:g} to {two.end:g} s. A sample can have one role only."
                )


def _check_roles(
    trajectories: list[Trajectory], cuts: list[Cut], spec: DataSpec, needed: Sequence[Role]
) -> None:
    missing = [role for role in needed if all(piece.role != role for piece in trajectories)]
    if not missing:
        return
    dropped = "".join(f"\n  {cut.file} {cut.start:g} to {cut.end:g} s: {cut.why}" for cut in cuts[:SHOWN])
    dropped += f"\n  and {len(cuts) - SHOWN} more" if len(cuts) > SHOWN else ""
    used = [fraction for fraction in spec.fractions if fraction > 0]
    distances = [0.0, *(spec.smoothing for _ in used[1:])]
    least = (_fewest(spec) + 1) * spec.dt
    needed_s = max((least + distance) / fraction for fraction, distance in zip(used, distances, strict=True))
    raise InputError(
        f"no piece of {_fewest(spec) * spec.dt:g} s or more is left for {' and '.join(missing)}. "
        "Give more or longer recordings, or change windows, fractions or max_gap in the DataSpec; a recording "
        f"without gaps that is split by fractions needs {needed_s:.3g} s."
        + (f" Cut out:{dropped}" if dropped else "")
    )


def _fewest(spec: DataSpec) -> int:
    """Fewest samples of a piece: the warm-up and a handful to score."""
    return int(np.ceil(spec.warm_up / spec.dt - TINY)) + MIN_SCORED


def _too_short(need: float, spec: DataSpec) -> str:
    return f"shorter than the {need:.4g} s that warm-up ({spec.warm_up:g} s) and smoothing need"


def _numbered(stem: str, number: int) -> str:
    return stem if number == 1 else f"{stem}#{number}"
