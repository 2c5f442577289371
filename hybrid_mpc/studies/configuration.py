"""What a study consists of, and the runs that it expands to."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import count, product
from pathlib import Path
from typing import Any, cast

from hybrid_mpc.assembly import SOLVERS
from hybrid_mpc.closed_loop.faults import Fault
from hybrid_mpc.errors import InputError
from hybrid_mpc.job.contenders import CONTENDERS, ORACLES
from hybrid_mpc.job.loops import Intervals, LoopSpec
from hybrid_mpc.pipeline.control_job import DEFAULT_CONTROLLERS, parsed_fault, selected_tasks
from hybrid_mpc.records import MOST_SEED, known, plain, record
from hybrid_mpc.scenario import load_scenario
from hybrid_mpc.studies.draws import RandomFaults, factors, generator

ESTIMATORS: Mapping[str, tuple[bool, bool] | None] = {
    "own": None,
    "plain": (False, False),
    "observer": (True, False),
    "truth": (False, True),
}
"""By name: whether it follows an unknown load, and whether it is handed the truth; None for the controller's own."""
MONITORS = ("own", "none", "energy")
"""``own``: what ``hybrid-mpc control`` runs, the uncalibrated energy monitor beside a hybrid; ``energy``: the same with
the artifact's calibration, so that it alarms."""
MOST_DRAWS = 1_000_000
"""Most seeds, and most draws, of a study: all of them are in memory."""
MOST_HORIZON = 10_000
"""Longest horizon [periods] of a study: a plan is in memory with its derivatives."""
AXES = ("models", "tasks", "controllers", "estimators", "solvers", "horizons", "monitors", "faults", "seeds")


@dataclass(frozen=True)
class Study:
    """Closed loops of every combination of what is listed.

    Lists may be given as any sequence; they become tuples, so that a study can be compared and hashed.

    Args:
        scenario: Registered name or path of a user's file.
        models: Artifact folders (or folders of runs) by label; a single folder gets the label ``"model"``.
        tasks: Names of tasks, or their beginnings. Default: all.
        controllers: Names of contenders. Default: prior and hybrid, with observer.
        estimators: Names in :data:`ESTIMATORS`: another estimator for each of the controllers. Default: its own.
        solvers: ``"rti"``, ``"sqp"``, ``"ipopt"``. Default: the first.
        horizons: Periods; None for the task's own, which is the default.
        monitors: Names in :data:`MONITORS`. Default: ``"own"``.
        faults: Sets of faults, each one text (``"plant_friction=2@1.5 + input_gain=0.8"``; ``"none"``), a
            :class:`~hybrid_mpc.closed_loop.Fault` or a sequence of either. Default: one empty set.
        vary: Parameters of the plant, and by what share each is varied at most in either direction. Default: none.
        random_faults: Faults that a draw takes at random, see :class:`~hybrid_mpc.studies.RandomFaults`. Default: none.
        draws: How many times the random things are drawn; all controllers meet the same draws. Default: 1.
        seeds: Numbers of the loops, or how many. Default: 10.
        seed: Seed of the draws.
        duration: Longest duration of a loop [s]. Default: the task's own.
        name: For tables and the report.

    Raises:
        InputError: If a name is unknown (with the nearest one), a number is impossible, or a combination is.

    Example:
        >>> study = Study("golf_robot", "runs/golf/model", tasks=["track"], vary={"m": 0.2}, draws=3, seeds=2)
        >>> study.size, len({run.id for run in study.runs()})
        (24, 24)
        >>> Study("golf_robot", "m", controllers=["hybird"])
        Traceback (most recent call last):
        hybrid_mpc.errors.InputError: no controller 'hybird'; did you mean 'hybrid'? There are: prior, prior_observer, \
hybrid, hybrid_observer, oracle, oracle_state
    """

    scenario: str
    models: str | Path | Mapping[str, str | Path] | Sequence[tuple[str, str]]
    tasks: Sequence[str] = ()
    controllers: Sequence[str] = DEFAULT_CONTROLLERS
    estimators: Sequence[str] = ("own",)
    solvers: Sequence[str] = ("rti",)
    horizons: Sequence[int | None] = (None,)
    monitors: Sequence[str] = ("own",)
    faults: Sequence[str | Fault | Sequence[str | Fault]] = ((),)
    vary: Mapping[str, float] | Sequence[tuple[str, float]] = ()
    random_faults: RandomFaults | Mapping[str, Any] | None = None
    draws: int = 1
    seeds: int | Sequence[int] = 10
    seed: int = 0
    duration: float | None = None
    name: str = "study"

    def __post_init__(self) -> None:
        for field, value in _normal(self).items():
            object.__setattr__(self, field, value)
        for name in AXES:
            values = getattr(self, name)
            if not values and name != "tasks":
                raise InputError(f"study: {name} is empty; leave it out for the default")
            if len(set(values)) != len(values):
                raise InputError(f"study: {name} lists something twice: {values}")
        for what, table in (("controllers", CONTENDERS), ("estimators", ESTIMATORS), ("solvers", SOLVERS)):
            for word in getattr(self, what):
                known(word, table, what[:-1])
        for word in self.monitors:
            known(word, MONITORS, "monitor")
        for label in self.folders:
            if not re.fullmatch(r"[A-Za-z0-9_.-]*[A-Za-z0-9_-]", label):
                raise InputError(f"study: a model's label is made of letters, digits, _ . -; got {label!r}")
        self._check_numbers()
        self._check_combinations()

    @property
    def folders(self) -> dict[str, Path]:
        """Folders of the models by label."""
        return {label: Path(folder) for label, folder in cast("Sequence[tuple[str, str]]", self.models)}

    @property
    def spans(self) -> tuple[tuple[str, float], ...]:
        """Varied parameters with their shares."""
        return cast("tuple[tuple[str, float], ...]", self.vary)

    @property
    def loop_seeds(self) -> tuple[int, ...]:
        """Numbers of the loops."""
        return cast("tuple[int, ...]", self.seeds)

    @property
    def fault_sets(self) -> tuple[tuple[Fault, ...], ...]:
        """Sets of faults."""
        return cast("tuple[tuple[Fault, ...], ...]", self.faults)

    @property
    def contenders(self) -> tuple[str, ...]:
        """Controllers with their estimators, each once."""
        pairs = product(self.controllers, self.estimators)
        return tuple(dict.fromkeys(_contender(c, e) for c, e in pairs))

    @property
    def axes(self) -> dict[str, int]:
        """How many of each thing there are; the product is the number of runs."""
        lengths = {
            name: len(getattr(self, name)) for name in AXES if name not in ("controllers", "estimators")
        }
        tasks = len(selected_tasks(load_scenario(self.scenario), self.tasks))
        return {**lengths, "tasks": tasks, "controllers": len(self.contenders), "draws": self.draws}

    @property
    def size(self) -> int:
        """Number of runs."""
        return math.prod(self.axes.values())

    def runs(self) -> Iterator[LoopSpec]:
        """The runs, those with the same controller next to each other; none is kept, so there may be millions."""
        tasks = [t.name for t in selected_tasks(load_scenario(self.scenario), self.tasks)]
        drawn = [self._drawn(i) for i in range(self.draws)]
        outer = product(
            self.folders, tasks, self.contenders, self.solvers, self.horizons, self.monitors, self.fault_sets
        )
        number = count()
        for model, task, contender, solver, horizon, monitor, faults in outer:
            for draw, (parameters, some, late) in enumerate(drawn):
                for seed in self.loop_seeds:
                    yield LoopSpec(
                        self.scenario, model, task, contender, solver, horizon, monitor,
                        faults, some, late, parameters, draw, seed, self.duration, number=next(number),
                    )  # fmt: skip

    def identity(self) -> dict[str, Any]:
        """The study as plain data, without where its models lie."""
        whole: dict[str, Any] = plain(asdict(self))
        return {**whole, "models": list(self.folders)}

    def with_models(self, models: Mapping[str, str | Path]) -> Study:
        """The same study of other models."""
        return replace(self, models=models)

    def _drawn(self, i: int) -> tuple[tuple[tuple[str, float], ...], tuple[Fault, ...], Intervals]:
        faults: tuple[tuple[Fault, ...], Intervals] = ((), ())
        if isinstance(self.random_faults, RandomFaults):
            faults = self.random_faults.drawn(generator(self.seed, i, "faults"))
        return factors(self.spans, self.seed, i), *faults

    def _check_numbers(self) -> None:
        lists: tuple[tuple[str, Sequence[int | None], int, int], ...] = (
            ("draws", [self.draws], 1, MOST_DRAWS),
            ("seed", [self.seed], 0, MOST_SEED),
            ("seeds", self.loop_seeds, 0, MOST_SEED),
            ("horizons", [h for h in self.horizons if h is not None], 1, MOST_HORIZON),
        )
        for name, values, least, most in lists:
            for number in values:
                whole = isinstance(number, int) and not isinstance(number, bool)
                if not whole or not least <= number <= most:  # type: ignore[operator]
                    raise InputError(
                        f"study: {name}: whole numbers from {least} to {most} are needed, got {str(number)[:40]}"
                    )
        for name, span in self.spans:
            if not (isinstance(span, int | float) and 0.0 < span < 1.0):
                raise InputError(f"study: vary {name}: a share between 0 and 1 is needed, got {span!r}")
        if self.duration is not None and not (
            isinstance(self.duration, int | float) and 0 < self.duration < math.inf
        ):
            raise InputError(f"study: duration must be a positive number of seconds, got {self.duration!r}")

    def _check_combinations(self) -> None:
        oracles = [name for name in self.contenders if name in ORACLES]
        if oracles and set(self.solvers) != {"rti"}:
            raise InputError(
                f"study: {oracles[0]} has a solver of its own (several starts); leave it or solvers out"
            )
        if oracles and self.vary:
            raise InputError(
                f"study: {oracles[0]} knows the machine as it is built, not as it is drawn; leave it or vary out"
            )
        if self.draws > 1 and not self.vary and self.random_faults is None:
            raise InputError(
                f"study: {self.draws} draws, and nothing that is drawn: give vary or random_faults, or use seeds"
            )
        watched = [name for name in self.contenders if CONTENDERS[name].model != "hybrid"]
        if "energy" in self.monitors and watched:
            raise InputError(
                f"study: monitor energy is calibrated for the hybrid, {watched[0]} has none; take monitor own, or "
                "controllers with a hybrid"
            )


def _normal(s: Study) -> dict[str, Any]:
    """The fields that may be given in several forms, as tuples."""
    models = {"model": s.models} if isinstance(s.models, str | Path) else s.models
    try:
        pairs = tuple((str(k), str(v)) for k, v in _items(models))
        vary = tuple((str(k), v) for k, v in _items(s.vary))
    except (TypeError, ValueError) as error:
        raise InputError(f"study: models and vary are mappings (name: value); {error}") from error
    drawn = s.random_faults
    if isinstance(drawn, Mapping):
        drawn = record(RandomFaults, drawn, "random_faults")
    lists: dict[str, Any] = {
        name: _listed(getattr(s, name), name)
        for name in ("tasks", "controllers", "estimators", "solvers", "horizons", "monitors")
    }
    if isinstance(s.seeds, int) and not isinstance(s.seeds, bool):
        if not 1 <= s.seeds <= MOST_DRAWS:
            raise InputError(
                f"study: seeds: their number must be from 1 to {MOST_DRAWS}, got {str(s.seeds)[:40]}"
            )
        seeds: tuple[Any, ...] = tuple(range(s.seeds))
    else:
        seeds = _listed(s.seeds, "seeds")
    faults = tuple(_fault_set(entry) for entry in _listed(s.faults, "faults"))
    return {**lists, "models": pairs, "vary": vary, "random_faults": drawn, "seeds": seeds, "faults": faults}


def _items(value: Any) -> Any:
    return value.items() if isinstance(value, Mapping) else value


def _listed(value: Any, name: str) -> tuple[Any, ...]:
    if isinstance(value, str | Fault) or value is None or not isinstance(value, Sequence):
        raise InputError(f"study: {name} is a list, got {value!r}; write [{value!r}]")
    return tuple(value)


def _fault_set(entry: Any) -> tuple[Fault, ...]:
    if isinstance(entry, Fault):
        return (entry,)
    if isinstance(entry, str):
        words = [word.strip() for word in entry.split(" + ")]
        return () if words in (["none"], [""]) else tuple(parsed_fault(word) for word in words)
    if not isinstance(entry, Sequence):
        raise InputError(f"study: faults are texts, lists of texts, or Fault; got {entry!r}")
    return tuple(fault for part in entry for fault in _fault_set(part))


def _contender(controller: str, estimator: str) -> str:
    """The contender of a controller's model with that estimator.

    Raises:
        InputError: If there is none.
    """
    wanted, model = ESTIMATORS[estimator], CONTENDERS[controller].model
    if wanted is None:
        return controller
    for name, c in CONTENDERS.items():
        if c.model == model and (c.observer, c.truth) == wanted:
            return name
    raise InputError(
        f"study: controller {controller} with estimator {estimator} is impossible: there is no such contender"
    )
