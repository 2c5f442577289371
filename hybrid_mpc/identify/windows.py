"""Windows of recordings for the fit of a prior, and knowledge about their initial states."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data import scales
from hybrid_mpc.data.scales import evenly
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.signals import Signal

Array = NDArray[np.float64]
WINDOWS = 100
"""Maximum number of windows of one length, evenly chosen. If a prior lacks an effect, its parameters depend on the
fitted parts of the recordings: with half as many windows, errors on held-out recordings scatter by 10 %."""
FEW = 24
"""Maximum number of windows for the comparison of starts, the test for a delay, and predictions."""
LONGEST = 20_000
"""Maximum periods of a whole recording; longer ones are cut."""


@dataclass(frozen=True)
class FirstStates:
    """Knowledge about the initial states of a fit's free runs.

    Args:
        kind: ``"free"``: unknown; initial states are fitted. ``"known"``: ``values`` hold at the first sample of each
            trajectory, for example of a machine that starts at rest; other states are free. ``"measured"``: outputs
            with the name of a state are exact initial values; other states are free. ``"shared"``: all trajectories
            start from the same free state. ``"warm_up"``: the first ``seconds`` of a run only determine its initial
            state; errors are counted on the rest, as in the evaluation of models. Default: ``"free"``.
        values: Values [their units] of the known states by name.
        seconds: Length [s] of the warm-up.

    Raises:
        InputError: If ``values`` or ``seconds`` do not match the kind.

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
            problems.append(
                f"first states: kind must be one of {', '.join(kinds)}, got {self.kind!r} [HM-IDENTIFY-066]"
            )
        if (self.kind == "known") != bool(self.values):
            problems.append(
                f"first states: give values by name with kind 'known', and only then; got {self.values}"
                " [HM-IDENTIFY-067]"
            )
        if not all(math.isfinite(value) for value in self.values.values()):
            problems.append(f"first states: values must be finite, got {self.values} [HM-IDENTIFY-068]")
        if (self.kind == "warm_up") != (0 < self.seconds < math.inf):
            problems.append(
                f"first states: give a positive length [s] with kind 'warm_up', and only then; got {self.seconds}"
                " [HM-IDENTIFY-069]"
            )
        refuse(problems)

    def samples(self, dt: float) -> int:
        """Samples of the warm-up; 0 without a warm-up."""
        return scales.periods(self.seconds, dt, 2) if self.kind == "warm_up" else 0

    def check(self, prior: Prior, largest_delay: float) -> None:
        """Check that the initial states match a prior.

        Raises:
            InputError: If they do not match; lists all errors together.
        """
        names, outputs = ([s.name for s in signals] for signals in (prior.states, prior.outputs))
        problems = [
            f"first states: {type(prior).__name__} has no state {name!r}; choose from: {', '.join(names)} "
            "[HM-IDENTIFY-070]"
            for name in self.values
            if name not in names
        ]
        if self.kind == "measured" and not set(names) & set(outputs):
            problems.append(
                f"first states: no output of {type(prior).__name__} ({', '.join(outputs)}) is a state "
                f"({', '.join(names)}). Use kind 'free' [HM-IDENTIFY-071]"
            )
        if self.kind in ("known", "shared") and largest_delay:
            problems.append(
                f"first states: with a delay, the first samples of a trajectory are lost, but their state is "
                f"{self.kind}. Set largest_delay to 0, or use kind 'free' [HM-IDENTIFY-072]"
            )
        refuse(problems)


FREE = FirstStates()


@dataclass(frozen=True)
class OutputWindows:
    """Windows of recordings.

    Args:
        y: Measured outputs ``(n, T + 1, n_y)``; NaN for a missing sample.
        u: Inputs ``(n, lead + T + 1, n_u)``; the first ``lead`` samples lie before the window.
        w: Disturbances ``(n, T + 1, n_w)``.
        x: Guess of the initial states ``(n, n_x)``.
        censored: +1 or -1 for samples at the upper or lower end of a sensor, else 0, ``(n, T + 1, n_y)``.
        lead: Number of input samples before the window.
        known: Mask of the initial states whose guess is exact ``(n, n_x)``.
        group: Group of each window ``(n,)``; windows of a group have the same initial state.
        warm: The first ``warm`` samples of a window only determine its initial state; errors are counted on the rest.
            Default 0: all samples serve both.
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
        """Cut each window after ``periods`` periods."""
        y, w, censored = (v[:, : periods + 1] for v in (self.y, self.w, self.censored))
        return replace(self, y=y, u=self.u[:, : self.lead + periods + 1], w=w, censored=censored)

    def times(self, n: int) -> OutputWindows:
        """Repeat the windows ``n`` times, one after the other."""
        keys = ("y", "u", "w", "x", "censored", "known")
        every: dict[str, Any] = {key: np.concatenate([getattr(self, key)] * n) for key in keys}
        group = np.concatenate([self.group + i * (self.group.max() + 1) for i in range(n)])
        return replace(self, **every, group=group)


def cut_outputs(
    trajectories: Sequence[Trajectory],
    periods: int | None,
    lead: int,
    most: int,
    states: Sequence[Signal] = (),
    outputs: Sequence[Signal] = (),
    first: FirstStates = FREE,
) -> OutputWindows:
    """Cut at most ``most`` windows of ``periods``, without overlap and evenly chosen; or take whole trajectories.

    Args:
        trajectories: Trajectories with estimated states.
        periods: Length of a window; None: whole trajectories, cut after ``LONGEST`` periods and filled up with missing
            samples.
        lead: Number of input samples before a window.
        most: Maximum number of windows.
        states: Signals of the states; guesses of initial states are clipped to their ranges. Default: no clipping.
        outputs: Signals of the outputs, for ``first``.
        first: Knowledge about initial states; needs ``states``. Default: none.

    Raises:
        InputError: If no trajectory is long enough.
    """
    if periods is None:
        periods = min(LONGEST, most_samples(trajectories) - lead - 1)
        chosen = [(t, k) for t in trajectories for k in range(lead, len(t.t) - 2, periods)]
    else:
        starts = [(t, k) for t in trajectories for k in range(lead, len(t.t) - periods, periods)]
        if not starts:
            longest = most_samples(trajectories)
            raise InputError(
                f"recordings: too short. The longest has {longest} samples, but a free run of {periods} periods with "
                f"{lead} samples before it needs {periods + lead + 1}. Give longer recordings [HM-IDENTIFY-073]"
            )
        chosen = [starts[i] for i in evenly(len(starts), most)]
        if first.kind in ("known", "shared"):  # this knowledge is about the first sample of a recording
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
        y=y, u=cut("u", lead), w=cut("w", 0), x=guesses,
        censored=cut("censored", 0), lead=lead, known=known, group=group,
        warm=min(first.samples(trajectories[0].dt), periods - 1),
    )  # fmt: skip


def place_among(trajectory: Trajectory) -> tuple[int, list[float]]:
    """Sort key of a trajectory: its length, then its measured samples."""
    # number of first samples that sort trajectories of equal length
    first = np.hstack([trajectory.y, trajectory.u])[:1000]
    return len(trajectory.t), np.nan_to_num(first, nan=-math.inf).ravel().tolist()


def continued(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """Join trajectories of files that follow each other within one period (the logger began a new file).

    Two trajectories are not joined if an output jumps between them by more than within each of them (the machine was
    moved), or if they come from one file (which was cut on purpose).

    Example:
        >>> from scenarios.pendulum.data import exact_runs
        >>> (run,) = exact_runs("train", 1)
        >>> cut = [run.part(slice(100, None), "second"), run.part(slice(0, 100), "first")]
        >>> [len(t.t) for t in continued(cut)] == [len(run.t)]
        True
    """
    found: list[Trajectory] = []
    for t in sorted(trajectories, key=lambda t: float(t.t[0])):
        before = [i for i, one in enumerate(found) if _follows(one, t)]
        if len(before) != 1:  # no predecessor, or several recordings of the same time
            found.append(t)
            continue
        one = found[before[0]]
        arrays: dict[str, Any] = {
            key: np.concatenate([getattr(one, key), getattr(t, key)])
            for key in ("t", "u", "y", "x", "xdot", "w", "censored")
        }
        found[before[0]] = replace(one, **arrays)
    return found


def _follows(one: Trajectory, other: Trajectory) -> bool:
    """Whether the other trajectory starts one period after the end of the first, in a new file, without a jump."""
    # tolerance, in periods, of the start of a trajectory that continues another one
    if one.file == other.file or not abs(float(other.t[0] - one.t[-1]) / one.dt - 1.0) < 0.01:
        return False
    jump = np.abs(other.y[0] - one.y[-1])
    steps = np.abs(np.concatenate([np.diff(one.y, axis=0), np.diff(other.y, axis=0)]))
    return bool((jump <= np.nan_to_num(steps).max(axis=0)).all())


def most_samples(trajectories: Sequence[Trajectory]) -> int:
    """Samples of the longest trajectory; 0 without any."""
    return max((len(t.t) for t in trajectories), default=0)
