"""Search of training settings by the validation error of free runs (Optuna): resumable, pruned, repeatable.

The journal of a search is Optuna's (JSON lines); it belongs to one search and cannot continue another one.
"""

from __future__ import annotations

import hashlib
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, FloatDistribution, IntDistribution
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, Trial, TrialState

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import MOST_CONTENT, digest, read_bytes
from hybrid_mpc.identify.settings import TrainingSettings
from hybrid_mpc.identify.train import Trained, train
from hybrid_mpc.machine.prior import Prior

Values = Mapping[str, int | float]
Progress = Callable[[int, int, int, float], None]
STUDY = "hybrid-mpc tune"
FINISHED = 4
"""Minimum number of finished trainings before a training is pruned by their median."""
PATIENCE = 0.2
"""Share of the optimizer steps without pruning, because a good setting may start slowly."""
WHOLE = ("hidden", "batch", "horizon")
"""Settings that are whole numbers."""
USUAL: Mapping[str, tuple[float, float]] = {
    "hidden": (4, 64),
    "learning_rate": (2e-3, 5e-2),
    "free_run_learning_rate": (5e-4, 2e-2),
    "decay": (10.0, 30000.0),
    "batch": (8, 128),
    "horizon": (20, 100),
    "prior_replay": (0.3, 300.0),
}
"""Default bounds of a searched setting."""


@dataclass(frozen=True)
class SearchSpace:
    """Searched settings, each between two bounds on a logarithmic scale; None: not searched.

    Args:
        hidden: Hidden units z, whole numbers. Default: 4 to 64.
        learning_rate: Initial learning rate of teacher forcing; the ratio of final to initial rate is that of the base.
            Default: 0.002 to 0.05.
        free_run_learning_rate: Initial learning rate of the free runs, likewise. Default: 0.0005 to 0.02.
        decay: Weight decay times the number of training samples. Default: 10 to 30000.
        batch: Number of windows in a step, whole numbers. Default: not searched; the computing time is proportional to
            it.
        horizon: Maximum evaluated periods of a free-run window, whole numbers. Default: not searched; the computing
            time is proportional to it.
        prior_replay: Weight of prior replay. Default: not searched. A logarithmic scale excludes zero; compare with a
            search without prior replay.

    Raises:
        InputError: If no setting is searched, or bounds are not positive, not increasing, or not whole numbers.

    Example:
        >>> SearchSpace(hidden=(8, 32), decay=None).names
        ('hidden', 'learning_rate', 'free_run_learning_rate')
    """

    hidden: tuple[int, int] | None = (4, 64)
    learning_rate: tuple[float, float] | None = (2e-3, 5e-2)
    free_run_learning_rate: tuple[float, float] | None = (5e-4, 2e-2)
    decay: tuple[float, float] | None = (10.0, 30000.0)
    batch: tuple[int, int] | None = None
    horizon: tuple[int, int] | None = None
    prior_replay: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            bounds = getattr(self, field.name)
            if bounds is not None:
                object.__setattr__(self, field.name, _checked(field.name, bounds))
        if not self.names:
            raise InputError(
                f"search space: empty; give bounds for at least one of: {', '.join(USUAL)} [HM-IDENTIFY-056]"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the searched settings."""
        return tuple(name for name, bounds in asdict(self).items() if bounds is not None)

    def bounds(self, name: str) -> tuple[float, float]:
        """Bounds of a searched setting."""
        low, high = getattr(self, name)
        return low, high

    def values_of(self, settings: TrainingSettings) -> dict[str, float]:
        """Values of the searched settings in ``settings``."""
        rates = settings.learning_rates
        own = {"learning_rate": rates[0], "free_run_learning_rate": rates[2]}
        return {name: own[name] if name in own else getattr(settings, name) for name in self.names}

    def holds(self, values: Values) -> bool:
        """Whether all values lie within the bounds."""
        return all(self.bounds(n)[0] <= values[n] <= self.bounds(n)[1] for n in self.names)

    def apply(self, base: TrainingSettings, values: Values) -> TrainingSettings:
        """Replace settings of ``base`` by values."""
        start, end, free_start, free_end = base.learning_rates
        rate = values.get("learning_rate", start)
        free = values.get("free_run_learning_rate", free_start)
        rates = (rate, rate * (end / start), free, free * (free_end / free_start))
        changes = {name: value for name, value in values.items() if not name.endswith("learning_rate")}
        return replace(base, learning_rates=rates, **changes)  # type: ignore[arg-type]

    def distributions(self) -> dict[str, BaseDistribution]:
        """Optuna's distributions of the searched settings."""
        made: dict[str, BaseDistribution] = {}
        for name in self.names:
            low, high = self.bounds(name)
            if name in WHOLE:
                made[name] = IntDistribution(int(low), int(high), log=True)
            else:
                made[name] = FloatDistribution(low, high, log=True)
        return made


def parsed_space(texts: Sequence[str]) -> SearchSpace:
    """Parse a space from ``NAME`` or ``NAME=LOW:HIGH`` for each setting, e.g. ``["hidden=8:32", "batch"]``.

    A name alone has its default bounds; other settings are not searched. Without texts, the space is the default one.
    """
    if not texts:
        return SearchSpace()
    found: dict[str, tuple[float, float] | None] = {}
    for text in texts:
        name, _, given = text.partition("=")
        if name not in USUAL:
            raise InputError(
                f"{name!r}: this setting cannot be varied; choose from: {', '.join(USUAL)} [HM-IDENTIFY-057]"
            )
        if name in found:
            raise InputError(f"{name}: given twice; give it once [HM-IDENTIFY-058]")
        found[name] = _parsed_bounds(text, given) if given else USUAL[name]
    return SearchSpace(**(dict.fromkeys(USUAL) | found))


def _parsed_bounds(text: str, given: str) -> tuple[float, float]:
    low, _, high = given.partition(":")
    try:
        return float(low), float(high)
    except ValueError as error:
        raise InputError(
            f"{text!r}: wrong form; write NAME=LOW:HIGH, e.g. hidden=8:32 [HM-IDENTIFY-059]"
        ) from error


def _checked(name: str, bounds: Sequence[float]) -> tuple[float, float]:
    if len(bounds) != 2 or not 0 < bounds[0] < bounds[1] < float("inf"):
        raise InputError(
            f"{name}: the bounds are {list(bounds)}; give two positive numbers, the lower one first"
            " [HM-IDENTIFY-060]"
        )
    if name not in WHOLE:
        return float(bounds[0]), float(bounds[1])
    if any(b != int(b) for b in bounds):
        raise InputError(f"{name}: the bounds are {list(bounds)}; give whole numbers [HM-IDENTIFY-061]")
    return int(bounds[0]), int(bounds[1])


@dataclass(frozen=True)
class TrialRow:
    """One training of a search.

    Args:
        number: Number of the trial: 0, 1, ...
        state: ``"complete"``, ``"pruned"`` (stopped because it was worse than the median of the finished trainings at
            the same step) or ``"diverged"`` (no network has a finite validation error).
        value: Validation error of the best network [unit of E_sim]; the last value of a pruned training; infinite for a
            diverged one.
        mean: Mean of the networks' validation errors; NaN for a pruned training.
        steps: Number of optimizer steps.
        duration: Duration [s].
        values: Values of the searched settings.
    """

    number: int
    state: str
    value: float
    mean: float
    steps: int
    duration: float
    values: Values


@dataclass(frozen=True)
class SearchResult:
    """Result of a search.

    Args:
        settings: Settings of the best training; :func:`~hybrid_mpc.identify.train.train` with these settings gives
            ``best.value`` again.
        best: The best training.
        base: Validation error with the initial settings; None if these are outside the space.
        trials: All trainings.
        importance: Share of each setting in the variation of the finished trainings' errors (PED-ANOVA, sum one); empty
            with fewer than eight finished trainings or a single searched setting.
    """

    settings: TrainingSettings
    best: TrialRow
    base: float | None
    trials: tuple[TrialRow, ...]
    importance: Mapping[str, float]


def tune(
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
    """Search settings by the free-run validation error of the best network of each training.

    The first training has the settings ``base`` if the space contains them. Settings depend on seed, number of the
    trial and previous results only, and an interrupted training is repeated. So an interrupted and resumed search has
    the same result. Validation also selects the weights within a training, so the best value is optimistic; evaluate on
    test runs.

    Args:
        prior: The fitted prior.
        training: Training trajectories.
        validation: Validation trajectories, which alone determine the result.
        base: Settings that are not searched, and the settings of the first trial.
        space: Searched settings.
        trials: Total number of trials, with those in ``storage``.
        storage: Journal (JSON lines); created if missing, else the search continues. One search at a time.
        seed: Seed of the search; weights and batches use the seed of ``base``.
        on_progress: ``(number of the trial, steps done, steps in total, best validation error)``.
        timeout: No further trial starts after this time [s]; there is at least one trial. Default: none.

    Raises:
        InputError: If the journal is damaged or belongs to another search, a number is too small, all trainings
            diverged, or :func:`~hybrid_mpc.identify.train.train` refuses the data.

    Example:
        >>> found = tune(prior, train_runs, valid_runs, base, SearchSpace(), trials=20,
        ...              storage=Path("tune.jsonl"))  # doctest: +SKIP
        >>> train(prior, train_runs, valid_runs, found.settings)  # doctest: +SKIP
    """
    check_numbers(trials, seed, timeout)
    study = open_study(storage, _identity(prior, training, validation, base, space, seed))
    warm_up = math.ceil(PATIENCE * (base.teacher_steps + base.free_run_steps))
    study.pruner = optuna.pruners.MedianPruner(FINISHED, warm_up)
    start = time.monotonic()
    while (number := len(_finished(study))) < trials:
        trial = _ask(study, number, base, space, seed)
        settings = space.apply(base, trial.params)
        own = partial(train, prior, training, validation, settings)
        _run_trial(study, trial, own, partial(on_progress, number))
        if timeout is not None and time.monotonic() - start >= timeout:
            break
    return _result(study, base, space)


def check_numbers(trials: int, seed: int, timeout: float | None) -> None:
    """Check the numbers of a search."""
    if trials < 1 or seed < 0 or (timeout is not None and not timeout > 0):
        raise InputError(
            f"search: give trials of at least 1, a seed of at least 0 and a timeout above 0 s; got "
            f"{trials}, {seed}, {timeout} [HM-IDENTIFY-062]"
        )


def _run_trial(
    study: optuna.Study,
    trial: Trial,
    training: Callable[..., Trained],
    on_progress: Callable[[int, int, float], None],
) -> None:
    """Run the training of a trial and store its result; an interrupted trial stays open and is repeated."""

    def report(done: int, total: int, error: float) -> None:
        trial.report(error, done)
        on_progress(done, total, error)
        if done < total and trial.should_prune():
            raise optuna.TrialPruned

    try:
        trained = training(on_progress=report)
    except optuna.TrialPruned:
        study.tell(trial, state=TrialState.PRUNED)
    else:
        trial.set_user_attr("mean", str(float(trained.validation.mean())))
        study.tell(trial, float(trained.validation.min()))


def _ask(study: optuna.Study, number: int, base: TrainingSettings, space: SearchSpace, seed: int) -> Trial:
    """Draw the trial of a number: first the base, then from seed, number and finished trials."""
    own = int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
    # number of random trials before the sampler uses results
    study.sampler = optuna.samplers.TPESampler(seed=own, n_startup_trials=6)
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
    """Hashes of all arguments that the trials depend on."""
    data = hashlib.sha256()
    for trajectory in (*training, *validation):
        data.update(f"{trajectory.role} {trajectory.dt} {trajectory.x.shape}".encode())
        for name in ("x", "u", "xdot"):
            data.update(np.ascontiguousarray(getattr(trajectory, name)).tobytes())
    return {
        "data": data.hexdigest(),
        "prior": digest([type(prior).__name__, prior.values]),
        "base settings": digest(asdict(base)),
        "space": digest(asdict(space)),
        "seed": digest(seed),
    }


def _finished(study: optuna.Study) -> list[FrozenTrial]:
    return study.get_trials(states=(TrialState.COMPLETE, TrialState.PRUNED))


def _result(study: optuna.Study, base: TrainingSettings, space: SearchSpace) -> SearchResult:
    rows = tuple(_row(number, trial) for number, trial in enumerate(_finished(study)))
    complete = [row for row in rows if row.state == "complete"]
    if not complete:
        raise InputError(
            f"search: all {len(rows)} trainings diverged, so no network has a finite validation error. Check the data "
            "and the fitted prior, or reduce the bounds of the learning rates [HM-IDENTIFY-063]"
        )
    best = min(complete, key=lambda row: row.value)
    importance: dict[str, float] = {}
    # minimum number of finished trainings for an estimate of the settings' importance
    if len(complete) >= 8 and len(space.names) > 1:
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


def open_study(storage: Path, identity: Mapping[str, str]) -> optuna.Study:
    """Open the study of a journal; unfinished trials are closed as failed."""
    storage.parent.mkdir(parents=True, exist_ok=True)
    _mend(storage)
    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)  # no message about a created or loaded study
    try:
        # absolute path, because the lock is a symbolic link to it
        journal = JournalStorage(JournalFileBackend(str(storage.resolve())))
        make = optuna.load_study if STUDY in optuna.get_all_study_names(journal) else optuna.create_study
        study = make(storage=journal, study_name=STUDY)
        found = study.user_attrs.get("identity", {})
    except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
        raise InputError(
            f"{storage}: not the journal of a search, or damaged ({type(error).__name__}: {error}). Choose another "
            "file, or delete it to start a new search [HM-IDENTIFY-064]"
        ) from error
    finally:
        optuna.logging.set_verbosity(verbosity)
    if not found and not study.trials:  # new, or interrupted before its identity was written
        study.set_user_attr("identity", dict(identity))
    elif differ := [name for name in identity if found.get(name) != identity[name]]:
        raise InputError(
            f"{storage}: belongs to another search ({', '.join(differ)} differ). Continue with the same settings, or "
            "choose another file [HM-IDENTIFY-065]"
        )
    for _ in study.get_trials(states=(TrialState.WAITING,)):  # drawn but not started before the interruption
        study.ask()
    for trial in study.get_trials(states=(TrialState.RUNNING,)):
        study.tell(trial.number, state=TrialState.FAIL)
    return study


def _mend(storage: Path) -> None:
    """Remove an incomplete last line after an interruption."""
    if storage.is_file():
        content = read_bytes(storage, MOST_CONTENT)
        whole = content.rfind(b"\n") + 1
        if whole < len(content):
            os.truncate(storage, whole)
