"""Windows of recordings that a prior is fitted to, and what is known of their first states."""

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
"""Windows of a length at most, evenly chosen. Where a prior lacks something, its parameters depend on which parts of
the recordings are fitted: with half of them errors on held-out recordings scatter by a tenth."""
FEW = 24
"""The same where starts are compared, where a delay is looked for, and of predictions."""
LONGEST = 20_000
"""Periods of a whole recording at most: longer ones are cut."""
PUNCTUAL = 0.01
"""Share of a period by which one trajectory may begin late or early to be the next part of another."""
COMPARED_SAMPLES = 1000
"""First samples by which trajectories of the same length are put in order."""


@dataclass(frozen=True)
class FirstStates:
    """What is known of the first states of a fit's free runs.

    Args:
        kind: ``"free"``: nothing, they are found with the parameters. ``"known"``: ``values`` are those of a
            trajectory's own first sample, for example of a machine that rests before it is started; the others are
            free. ``"measured"``: outputs that are states, by their names, are exact wherever a run starts; the others
            are free.
            ``"shared"``: all trajectories start from one state, which is free. ``"warm_up"``: a run's first ``seconds``
            alone tell its first state, and what follows alone counts, as where models are evaluated.
        values: Values [their units] of the states that are known, by name.
        seconds: Length [s] of the warm-up.

    Raises:
        InputError: If ``values`` or ``seconds`` do not belong to the kind, or are missing.

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
        """Samples of the warm-up, none without."""
        return scales.periods(self.seconds, dt, 2) if self.kind == "warm_up" else 0

    def check(self, prior: Prior, largest_delay: float) -> None:
        """Refuse what does not fit to a prior.

        Raises:
            InputError: With all that does not.
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
    """Windows of recordings: ``y`` ``(n, T + 1, n_y)`` with NaN where nothing was measured, ``u`` ``(n, lead + T + 1,
    n_u)``, of which the first ``lead`` come before the window, ``w`` ``(n, T + 1, n_w)``, a guess ``x`` ``(n, n_x)`` of
    the first state, and which samples are censored ``(n, T + 1, n_y)``.

    Of the first states ``known`` ``(n, n_x)`` are as guessed. Windows of one group ``(n,)`` begin in the same state. Of
    a window the first ``warm`` samples alone tell its first state, and the others count; 0: all do both.
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
        """The first so many periods of each."""
        y, w, censored = (v[:, : periods + 1] for v in (self.y, self.w, self.censored))
        return replace(self, y=y, u=self.u[:, : self.lead + periods + 1], w=w, censored=censored)

    def times(self, n: int) -> OutputWindows:
        """The same windows, ``n`` times one behind the other."""
        y, u, w, x, censored, known = (
            np.concatenate([v] * n) for v in (self.y, self.u, self.w, self.x, self.censored, self.known)
        )
        group = np.concatenate([self.group + i * (self.group.max() + 1) for i in range(n)])
        return OutputWindows(
            y=y, u=u, w=w, x=x, censored=censored, lead=self.lead, known=known, group=group, warm=self.warm
        )


def cut_outputs(
    trajectories: Sequence[Trajectory],
    periods: int | None,
    lead: int,
    most: int,
    states: Sequence[Signal] = (),
    outputs: Sequence[Signal] = (),
    first: FirstStates = FREE,
) -> OutputWindows:
    """At most ``most`` windows of ``periods``, one behind the other, evenly chosen; or whole trajectories.

    Whole ones are cut where they are longer than ``LONGEST``, and filled up with missing samples to the longest.
    First states are guessed within the ranges of ``states``. Default: as the trajectories have them. What is known of
    them by their names, and by those of the ``outputs``, says ``first``; it needs ``states``.

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
        if first.kind in ("known", "shared"):  # what is known is known of a recording's own first sample
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
    """Place of a trajectory among others, by what was measured alone."""
    first = np.hstack([trajectory.y, trajectory.u])[:COMPARED_SAMPLES]
    return len(trajectory.t), np.nan_to_num(first, nan=-math.inf).ravel().tolist()


def continued(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """Join the trajectories of files that follow each other within a period: a logger had begun a new file.

    Two trajectories stay apart where an output jumps between them by more than within either (the machine was moved),
    and where they come from one file (it was cut on purpose).

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
        if len(before) != 1:  # none, or several recordings of the same time
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
    """Whether the other trajectory begins a period after the end of the one, in a new file, and no output jumps."""
    if one.file == other.file or not abs(float(other.t[0] - one.t[-1]) / one.dt - 1.0) < PUNCTUAL:
        return False
    jump = np.abs(other.y[0] - one.y[-1])
    steps = np.abs(np.concatenate([np.diff(one.y, axis=0), np.diff(other.y, axis=0)]))
    return bool((jump <= np.nan_to_num(steps).max(axis=0)).all())


def most_samples(trajectories: Sequence[Trajectory]) -> int:
    """Samples of the longest trajectory; 0 without any."""
    return max((len(t.t) for t in trajectories), default=0)
