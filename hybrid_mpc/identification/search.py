"""Search of training settings by the validation error of free runs (Optuna): resumable, pruned, repeatable."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.trial import FrozenTrial, Trial, TrialState

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import digest
from hybrid_mpc.identification.search_journal import open_study
from hybrid_mpc.identification.search_space import SearchSpace
from hybrid_mpc.identification.settings import TrainingSettings
from hybrid_mpc.identification.trained import Trained
from hybrid_mpc.identification.training import train
from hybrid_mpc.physics import Prior

__all__ = ["search", "SearchSpace", "SearchResult", "TrialRow", "Progress"]

Progress = Callable[[int, int, int, float], None]
STARTUP = 6
"""Trials at random before the sampler looks at their results."""
JUDGES = 4
"""Finished trainings that a median is taken of before one is pruned by it."""
PATIENCE = 0.2
"""Share of the optimiser steps that every training gets: a good setting may start slowly."""
ENOUGH = 8
"""Finished trainings from which the settings' importance is estimated."""


@dataclass(frozen=True)
class TrialRow:
    """One training of a search.

    Args:
        number: 0, 1, ...
        state: ``"complete"``, ``"pruned"`` (stopped while worse than the median of the finished ones at the same
            step) or ``"diverged"`` (no network had a finite validation error).
        value: Validation error of the best network [E_sim's unit]; of a pruned training that at its end, of a
            diverged one infinite.
        mean: Mean of the networks' validation errors; NaN for a pruned training.
        steps: Optimiser steps done.
        duration: How long it took [s].
        values: The searched settings.
    """

    number: int
    state: str
    value: float
    mean: float
    steps: int
    duration: float
    values: Mapping[str, float]


@dataclass(frozen=True)
class SearchResult:
    """What a search found.

    Args:
        settings: The best training's settings; :func:`~hybrid_mpc.identification.training.train` with them gives
            ``best.value`` again.
        best: The best training.
        base: Validation error with the settings that the search started from; None where the space does not hold them.
        trials: All trainings.
        importance: Share of each setting in the differences of the finished trainings' values (PED-ANOVA, sums to
            one); empty where fewer than eight finished or one setting alone is searched.
    """

    settings: TrainingSettings
    best: TrialRow
    base: float | None
    trials: tuple[TrialRow, ...]
    importance: Mapping[str, float]


def search(
    prior: Prior,
    training: Sequence[Trajectory],
    validation: Sequence[Trajectory],
    base: TrainingSettings,
    space: SearchSpace,
    *,
    trials: int,
    storage: Path,
    seed: int = 0,
    on_progress: Progress = lambda number, done, total, error: None,
    timeout: float | None = None,
) -> SearchResult:
    """Search settings by the validation error of free runs, the best network of each training counting.

    The first training has the settings ``base``, if the space holds them. Settings are drawn from (seed, number of
    the trial, results so far), and a training that was interrupted is drawn again: a search that was killed and goes
    on is the search that was not. Every finished trial stands in ``storage`` at once. Validation chooses here what
    it also chooses within a training, so the best value is too good to be true by some; judge on test runs.

    Args:
        prior: The fitted prior.
        training: Training trajectories.
        validation: Validation trajectories; the only ones that decide.
        base: All settings that are not searched, and the first trial's.
        space: What is searched.
        trials: Trials in all, those in ``storage`` counted.
        storage: Journal: JSON lines, made if missing, gone on with if there. One search at a time.
        seed: Seed of the search; weights and batches have that of ``base``.
        on_progress: ``(number of the trial, steps done, steps in all, best validation error)``.
        timeout: No further trial starts after this time of the call [s]; one trial is made in any case. Default: none.

    Raises:
        InputError: If the journal is damaged or of another search, a number is too small, all trainings diverged, or
            the data are such that :func:`~hybrid_mpc.identification.training.train` refuses them.

    Example:
        >>> found = search(prior, train_runs, valid_runs, base, SearchSpace(), trials=20,
        ...                storage=Path("search.jsonl"))  # doctest: +SKIP
        >>> train(prior, train_runs, valid_runs, found.settings)  # doctest: +SKIP
    """
    check_numbers(trials, seed, timeout)
    if space.horizon is not None:  # trials must be judged by windows of the same length
        base = replace(base, validation_horizon=base.validation_horizon or 5 * base.horizon)
    study = open_study(storage, _identity(prior, training, validation, base, space, seed))
    warm_up = math.ceil(PATIENCE * (base.teacher_steps + base.free_run_steps))
    study.pruner = optuna.pruners.MedianPruner(JUDGES, warm_up)
    start = time.monotonic()
    while (number := len(_finished(study))) < trials:
        trial = _ask(study, number, base, space, seed)
        settings = space.apply(base, trial.params)
        with _kept(study, trial, partial(on_progress, number)) as report:
            report.trained = train(prior, training, validation, settings, on_progress=report)
        if timeout is not None and time.monotonic() - start >= timeout:
            break
    return _result(study, base, space)


def check_numbers(trials: int, seed: int, timeout: float | None) -> None:
    """Refuse numbers that no search can be made with.

    Raises:
        InputError: If one is too small.
    """
    if trials < 1 or seed < 0 or (timeout is not None and not timeout > 0):
        raise InputError(
            f"a search needs trials of 1 or more, a seed of 0 or more and a timeout above 0 s, got "
            f"{trials}, {seed}, {timeout}"
        )


class _Report:
    """Hands the validation errors of a training on, to the user and to the pruner."""

    def __init__(self, trial: Trial, on_progress: Callable[[int, int, float], None]) -> None:
        self.trial, self.on_progress = trial, on_progress
        self.trained: Trained | None = None

    def __call__(self, done: int, total: int, error: float) -> None:
        self.trial.report(error, done)
        self.on_progress(done, total, error)
        if done < total and self.trial.should_prune():
            raise optuna.TrialPruned


@contextmanager
def _kept(
    study: optuna.Study, trial: Trial, on_progress: Callable[[int, int, float], None]
) -> Iterator[_Report]:
    """A trial's training is noted as it ended; one that is interrupted stays open and is drawn again."""
    report = _Report(trial, on_progress)
    try:
        yield report
    except optuna.TrialPruned:
        study.tell(trial, state=TrialState.PRUNED)
        return
    assert report.trained is not None
    trial.set_user_attr("mean", str(float(report.trained.validation.mean())))
    study.tell(trial, float(report.trained.validation.min()))


def _ask(study: optuna.Study, number: int, base: TrainingSettings, space: SearchSpace, seed: int) -> Trial:
    """The trial of this number: the base first, then what (seed, number) and the finished trials give."""
    own = int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
    study.sampler = optuna.samplers.TPESampler(seed=own, n_startup_trials=STARTUP)
    values = space.values_of(base)
    if number == 0 and space.holds(values):
        study.enqueue_trial(values)
    return study.ask(space.distributions())


def _identity(
    prior: Prior,
    training: Sequence[Trajectory],
    validation: Sequence[Trajectory],
    base: TrainingSettings,
    space: SearchSpace,
    seed: int,
) -> dict[str, str]:
    """Hashes of everything that decides what the trials are."""
    data = hashlib.sha256()
    for trajectory in (*training, *validation):
        data.update(f"{trajectory.role} {trajectory.dt} {trajectory.x.shape}".encode())
        for name in ("x", "u", "xdot"):
            data.update(np.ascontiguousarray(getattr(trajectory, name)).tobytes())
    return {
        "data": data.hexdigest(),
        "prior": digest([type(prior).__name__, prior.values]),
        "base settings": digest(_without_default(base)),
        "space": digest(_without_default(space)),
        "seed": digest(seed),
    }


def _without_default(settings: TrainingSettings | SearchSpace) -> dict[str, Any]:
    """As plain data; without anchors, where there are none, as in searches from before there were any."""
    return {name: value for name, value in asdict(settings).items() if name != "anchors" or value}


def _finished(study: optuna.Study) -> list[FrozenTrial]:
    return study.get_trials(states=(TrialState.COMPLETE, TrialState.PRUNED))


def _result(study: optuna.Study, base: TrainingSettings, space: SearchSpace) -> SearchResult:
    rows = tuple(_row(number, trial) for number, trial in enumerate(_finished(study)))
    complete = [row for row in rows if row.state == "complete"]
    if not complete:
        raise InputError(
            f"all {len(rows)} trainings of the search diverged: no network had a finite validation error; look at "
            "the data and the fitted prior, or lower the learning rates' bounds"
        )
    best = min(complete, key=lambda row: row.value)
    importance: dict[str, float] = {}
    if len(complete) >= ENOUGH and len(space.names) > 1:
        importance = dict(optuna.importance.get_param_importances(study))
    first = space.holds(space.values_of(base))
    return SearchResult(
        space.apply(base, best.values), best, rows[0].value if first else None, rows, importance
    )


def _row(number: int, trial: FrozenTrial) -> TrialRow:
    assert trial.duration is not None
    value = math.inf if trial.value is None else trial.value
    state = (
        "pruned" if trial.state == TrialState.PRUNED else "complete" if math.isfinite(value) else "diverged"
    )
    return TrialRow(
        number,
        state,
        value,
        float(trial.user_attrs.get("mean", "nan")),
        trial.last_step or 0,
        trial.duration.total_seconds(),
        dict(trial.params),
    )
