"""Studies: settings, the loops that they expand to, random draws, the YAML file, and the built-in studies."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.util import find_spec
from itertools import count, product
from pathlib import Path
from typing import Any, cast

import numpy as np

from hybrid_mpc.compare.controllers import CONTROLLERS, OBSERVERS, ORACLES
from hybrid_mpc.compare.loops import ALARMING, GUARDS, MONITORS, Intervals, LoopSpec
from hybrid_mpc.compare.tasks import ready, selected_tasks
from hybrid_mpc.control.ocp import MOST_HORIZON
from hybrid_mpc.errors import InputError, named_extra
from hybrid_mpc.files import read_bytes
from hybrid_mpc.kit.assembly import SOLVERS
from hybrid_mpc.loop.faults import SIGNAL_TARGETS, Fault, parsed_fault
from hybrid_mpc.model.blend import BLEND_SHARE
from hybrid_mpc.records import Fields, known, plain, record
from hybrid_mpc.rules import MOST_SEED, Duration, Label, Name, NameOrNone, Number, Seconds, name_problem
from hybrid_mpc.scenario import load_scenario, registered_scenarios, scenario_of

LATE = "late"
"""An additional target to those of :class:`~hybrid_mpc.loop.faults.Fault`: solves miss their deadline."""
DEFAULT_CONTROLLERS = OBSERVERS
MOST_DRAWS = 1_000_000
"""Largest number of seeds, and of draws, of a study: all of them are in memory."""
AXES = ("models", "tasks", "controllers", "solvers", "horizons", "monitors", "faults", "seeds")


@dataclass(frozen=True)
class FaultKind:
    """One kind of random fault with its range of sizes.

    Args:
        target: Target of a :class:`~hybrid_mpc.loop.faults.Fault`, or ``"late"``: solves miss their deadline.
        low: Smallest size.
        high: Largest size; the size is uniform between both.
        signed: Whether the sign is random. Default: False.
        ramp: Time [s] over which the fault grows. Default: 0.
        length: Shortest and longest duration [s] of this kind, which then always ends. Default: that of all kinds.
        channel: Name of the output or input. Default: the only one.

    Raises:
        InputError: If the target is unknown or a range is empty.

    Example: ``FaultKind("plant_friction", 1.5, 4.0)``
    """

    target: Name
    low: Number = 0.0
    high: Number = 0.0
    signed: bool = False
    ramp: Duration = 0.0
    length: Sequence[float] | None = None
    channel: NameOrNone = ""

    def __post_init__(self) -> None:
        Fields(self, f"random fault {self.target}").refuse()
        if self.target != LATE and not str(self.target).startswith("plant_"):
            known(self.target, (*SIGNAL_TARGETS, LATE), "fault target")
        _check_span((self.low, self.high), f"random fault {self.target}: low to high")
        if self.length is not None:
            span = _check_span(self.length, f"random fault {self.target}: length", above=0.0)
            object.__setattr__(self, "length", span)


@dataclass(frozen=True)
class RandomFaults:
    """Random faults of a draw.

    Args:
        kinds: Kinds of faults, also as mappings of :class:`FaultKind`'s fields.
        at_once: Smallest and largest number of kinds in one draw. Default: 1 to 3.
        start: Earliest and latest begin [s]. Default: 1.4 to 2.
        length: Shortest and longest duration [s] of faults that end. Default: 0.2 to 2.
        lasting: Share of faults that never end. Default: 0.5.

    Raises:
        InputError: If there is no kind, ``at_once`` exceeds the number of kinds, or a range is empty.

    Example:
        >>> some = RandomFaults([{"target": "input_gain", "low": 0.7, "high": 0.9}], at_once=(1, 1))
        >>> faults, late = some.drawn(np.random.default_rng(0))
        >>> faults[0].target, 0.7 <= faults[0].value <= 0.9, late
        ('input_gain', True, ())
    """

    kinds: Sequence[FaultKind | Mapping[str, Any]]
    at_once: Sequence[int] = (1, 3)
    start: Sequence[float] = (1.4, 2.0)
    length: Sequence[float] = (0.2, 2.0)
    lasting: float = 0.5

    def __post_init__(self) -> None:
        kinds = tuple(
            k if isinstance(k, FaultKind) else record(FaultKind, k, f"random_faults.kinds[{i}]")
            for i, k in enumerate(self.kinds)
        )
        object.__setattr__(self, "kinds", kinds)
        object.__setattr__(self, "start", _check_span(self.start, "random_faults: start", least=0.0))
        object.__setattr__(self, "length", _check_span(self.length, "random_faults: length", above=0.0))
        fewest, most = (int(n) for n in _check_span(self.at_once, "random_faults: at_once", least=0.0))
        object.__setattr__(self, "at_once", (fewest, most))
        if most < 1 or most > len(kinds):
            raise InputError(
                f"random_faults: at_once ends at {most}; give from 1 to the number of kinds, {len(kinds)} "
                "[HM-COMPARE-022]"
            )
        if not 0.0 <= self.lasting <= 1.0:
            raise InputError(
                f"random_faults: lasting must be a share from 0 to 1, got {self.lasting} [HM-COMPARE-023]"
            )

    def drawn(self, rng: np.random.Generator) -> tuple[tuple[Fault, ...], Intervals]:
        """Random faults, and the intervals [s] in which solves miss their deadline."""
        n = int(rng.integers(self.at_once[0], self.at_once[1] + 1))
        faults, late = [], []
        for i in rng.choice(len(self.kinds), size=n, replace=False).tolist():
            kind = self.kinds[i]
            assert isinstance(kind, FaultKind)
            size, start = rng.uniform(kind.low, kind.high), float(rng.uniform(self.start[0], self.start[1]))
            sign = float(rng.choice([-1.0, 1.0])) if kind.signed else 1.0
            shortest, longest = kind.length or self.length
            length, lasts = rng.uniform(shortest, longest), rng.random() < self.lasting
            end = math.inf if lasts and kind.length is None else start + float(length)
            if kind.target == LATE:
                late.append((start, end))
            else:
                faults.append(Fault(start, end, kind.target, float(sign * size), kind.channel, kind.ramp))
        return tuple(faults), tuple(late)

    def examples(self) -> tuple[Fault, ...]:
        """The largest fault of each kind, to check whether the plant supports it."""
        found = []
        for kind in self.kinds:
            assert isinstance(kind, FaultKind)
            if kind.target != LATE:
                found.append(Fault(0.0, 1.0, kind.target, kind.high, kind.channel, kind.ramp))
        return tuple(found)


def generator(seed: int, draw: int, what: str) -> np.random.Generator:
    """Random number generator for one item ``what`` of one draw, independent of all other items."""
    key = hashlib.sha256(f"{seed}/{draw}/{what}".encode()).digest()
    return np.random.default_rng(int.from_bytes(key[:16], "big"))


def factors(vary: Sequence[tuple[str, float]], seed: int, draw: int) -> tuple[tuple[str, float], ...]:
    """Factors of the plant's parameters in a draw, uniform in ``1 - span`` to ``1 + span``."""
    return tuple(
        (name, float(1.0 + span * generator(seed, draw, name).uniform(-1.0, 1.0))) for name, span in vary
    )


def _check_span(
    values: Sequence[float], what: str, *, least: float = -math.inf, above: float = -math.inf
) -> tuple[float, float]:
    """Two numbers in ascending order; InputError otherwise."""
    try:
        low, high = (float(v) for v in values)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what}: give two numbers, got {values!r} [HM-COMPARE-024]") from error
    if not (math.isfinite(low) and math.isfinite(high) and low <= high and low >= least and low > above):
        bounds = f" of {least:g} or more" if math.isfinite(least) else ""
        bounds = f" above {above:g}" if math.isfinite(above) else bounds
        raise InputError(
            f"{what}: [{low:g}, {high:g}] is not a range; give two finite numbers{bounds}, the smaller one first"
            " [HM-COMPARE-025]"
        )
    return low, high


@dataclass(frozen=True)
class Study:
    """Closed loops of every combination of what is listed.

    Lists may be given as any sequence; they become tuples, so that a study can be compared and hashed.

    Args:
        scenario: Registered name or path of a user's file.
        models: Artifact folders (or folders of runs) by label; a single folder gets the label ``"model"``.
        tasks: Names of tasks, or their beginnings. Default: all.
        controllers: Names in :data:`~hybrid_mpc.compare.controllers.CONTROLLERS`. Default: prior and hybrid, with
            observer.
        solvers: ``"rti"``, ``"native"``, ``"sqp"``, ``"ipopt"``. Default: the first.
        horizons: Periods; None for the task's own, which is the default.
        monitors: Names in :data:`~hybrid_mpc.compare.loops.MONITORS`. Default: ``"own"``, without thresholds.
        faults: Sets of faults, each one text (``"plant_friction=2@1.5 + input_gain=0.8"``; ``"none"``), a
            :class:`~hybrid_mpc.loop.faults.Fault` or a sequence of either. Default: one empty set.
        vary: Parameters of the plant, and the largest relative variation of each. Default: none.
        random_faults: Random faults of a draw. Default: none.
        draws: Number of random draws; all controllers get the same draws. Default: 1.
        seeds: Seeds of the loops, or their number. Default: 10.
        seed: Seed of the draws. Default: 0.
        duration: Longest duration of a loop [s]. Default: the task's own.
        guard: Reaction to an alarm, in :data:`~hybrid_mpc.compare.loops.GUARDS`; it needs monitors that alarm, and
            hybrids. Default: none.
        run_seed: Seed of the run; 1000 times it is added to the seeds of the loops, as in a run. Default: 0.
        name: Name in tables and the report. Default: study.
        share: Share of the network's correction that the controller ``blended_observer`` starts with, between 0 and 2.
            Default: 1, if the hybrid is recommended; a model that recommends the prior needs a share.

    Raises:
        InputError: If a name is unknown (the message names the nearest one), or a number or combination is invalid.

    Example:
        >>> study = Study("golf_robot", "runs/golf/model", tasks=["track"], vary={"m": 0.2}, draws=3, seeds=2)
        >>> study.size, len({run.id for run in study.runs()})
        (24, 24)
        >>> Study("golf_robot", "m", controllers=["hybird"])
        Traceback (most recent call last):
        hybrid_mpc.errors.InputError: no controller 'hybird'; did you mean 'hybrid'? Known names: prior, \
prior_observer, hybrid, hybrid_observer, prior_tracking, hybrid_tracking, blended_observer, \
oracle, oracle_state
    """

    scenario: str
    models: str | Path | Mapping[str, str | Path] | Sequence[tuple[str, str]]
    tasks: Sequence[str] = ()
    controllers: Sequence[str] = DEFAULT_CONTROLLERS
    solvers: Sequence[str] = ("rti",)
    horizons: Sequence[int | None] = (None,)
    monitors: Sequence[str] = ("own",)
    faults: Sequence[str | Fault | Sequence[str | Fault]] = ((),)
    vary: Mapping[str, float] | Sequence[tuple[str, float]] = ()
    random_faults: RandomFaults | Mapping[str, Any] | None = None
    draws: int = 1
    seeds: int | Sequence[int] = 10
    seed: int = 0
    duration: Seconds | None = None
    guard: str = ""
    run_seed: int = 0
    name: Label = "study"
    share: Number | None = None

    def __post_init__(self) -> None:
        for field, value in _unify_fields(self).items():
            object.__setattr__(self, field, value)
        for name in AXES:
            values = getattr(self, name)
            if not values and name != "tasks":
                raise InputError(f"study: {name} is empty; omit it to use the default [HM-COMPARE-026]")
            if len(set(values)) != len(values):
                raise InputError(f"study: {name} has a duplicate: {values}. Remove it [HM-COMPARE-027]")
        for what, table in (("controllers", CONTROLLERS), ("solvers", SOLVERS), ("monitors", MONITORS)):
            for word in getattr(self, what):
                known(word, table, what[:-1])
        if self.guard:
            known(self.guard, GUARDS[1:], "guard")
        own = Fields(self, f"study {self.name!r}")
        own.add(
            f"models: {wrong} [HM-COMPARE-060]" for label in self.folders if (wrong := name_problem(label))
        )
        own.refuse()
        self._check_numbers()
        self._check_combinations()

    @property
    def folders(self) -> dict[str, Path]:
        """Folders of the models by label."""
        return {label: Path(folder) for label, folder in cast("Sequence[tuple[str, str]]", self.models)}

    @property
    def spans(self) -> tuple[tuple[str, float], ...]:
        """Varied parameters with their largest relative variation."""
        return cast("tuple[tuple[str, float], ...]", self.vary)

    @property
    def loop_seeds(self) -> tuple[int, ...]:
        """Seeds of the loops."""
        return cast("tuple[int, ...]", self.seeds)

    @property
    def fault_sets(self) -> tuple[tuple[Fault, ...], ...]:
        """Sets of faults."""
        return cast("tuple[tuple[Fault, ...], ...]", self.faults)

    @property
    def axes(self) -> dict[str, int]:
        """Number of levels of each axis; their product is the number of runs."""
        lengths = {name: len(getattr(self, name)) for name in AXES}
        tasks = len(selected_tasks(ready(load_scenario(self.scenario)), self.tasks))
        return {**lengths, "tasks": tasks, "draws": self.draws}

    @property
    def size(self) -> int:
        """Number of runs."""
        return math.prod(self.axes.values())

    def runs(self) -> Iterator[LoopSpec]:
        """The runs, ordered by controller."""
        tasks = [t.name for t in selected_tasks(ready(load_scenario(self.scenario)), self.tasks)]
        drawn = [self._draw(i) for i in range(self.draws)]
        outer = product(
            self.folders, tasks, self.controllers, self.solvers, self.horizons, self.monitors, self.fault_sets
        )
        number = count()
        for model, task, controller, solver, horizon, monitor, faults in outer:
            for draw, (parameters, some, late) in enumerate(drawn):
                for seed in self.loop_seeds:
                    yield LoopSpec(
                        scenario=self.scenario,
                        model=model,
                        task=task,
                        controller=controller,
                        solver=solver,
                        horizon=horizon,
                        monitor=monitor,
                        faults=faults,
                        drawn_faults=some,
                        late=late,
                        parameters=parameters,
                        draw=draw,
                        seed=seed,
                        duration=self.duration,
                        guard=self.guard,
                        run_seed=self.run_seed,
                        share=self.share if CONTROLLERS[controller].blended else None,
                        number=next(number),
                    )

    def identity(self) -> dict[str, Any]:
        """The study as plain data, without the folders of its models."""
        whole: dict[str, Any] = plain(asdict(self))
        return {**whole, "models": list(self.folders)}

    def _draw(self, i: int) -> tuple[tuple[tuple[str, float], ...], tuple[Fault, ...], Intervals]:
        faults: tuple[tuple[Fault, ...], Intervals] = ((), ())
        if isinstance(self.random_faults, RandomFaults):
            faults = self.random_faults.drawn(generator(self.seed, i, "faults"))
        return factors(self.spans, self.seed, i), *faults

    def _check_numbers(self) -> None:
        lists: tuple[tuple[str, Sequence[int | None], int, int], ...] = (
            ("draws", [self.draws], 1, MOST_DRAWS),
            ("seed", [self.seed], 0, MOST_SEED),
            ("run_seed", [self.run_seed], 0, MOST_SEED),
            ("seeds", self.loop_seeds, 0, MOST_SEED),
            ("horizons", [h for h in self.horizons if h is not None], 1, MOST_HORIZON),
        )
        for name, values, least, most in lists:
            for number in values:
                whole = isinstance(number, int) and not isinstance(number, bool)
                if not whole or not least <= number <= most:  # type: ignore[operator]
                    raise InputError(
                        f"study: {name}: give whole numbers from {least} to {most}, got {str(number)[:40]}"
                        " [HM-COMPARE-028]"
                    )
        for name, span in self.spans:
            if not (isinstance(span, int | float) and 0.0 < span < 1.0):
                raise InputError(
                    f"study: vary {name}: give a share between 0 and 1, got {span!r} [HM-COMPARE-029]"
                )

    def _check_combinations(self) -> None:
        if self.share is not None and not any(CONTROLLERS[name].blended for name in self.controllers):
            raise InputError(
                "study: share belongs to controller blended_observer, which is not listed. Add this controller, or "
                "remove share [HM-COMPARE-061]"
            )
        if self.share is not None and not 0.0 < self.share < BLEND_SHARE.upper:
            raise InputError(
                f"study: share must be between 0 and {BLEND_SHARE.upper:g}, got {self.share} [HM-COMPARE-062]"
            )
        oracles = [name for name in self.controllers if name in ORACLES]
        if oracles and set(self.solvers) != {"rti"}:
            raise InputError(
                f"study: controller {oracles[0]} always uses its own solver (several starts). Remove this controller, "
                "or solvers [HM-COMPARE-030]"
            )
        if oracles and self.vary:
            raise InputError(
                f"study: controller {oracles[0]} knows the nominal plant, not the varied one. Remove this controller, "
                "or vary [HM-COMPARE-031]"
            )
        if self.draws > 1 and not self.vary and self.random_faults is None:
            raise InputError(
                f"study: draws = {self.draws}, but nothing is random. Give vary or random_faults, or use seeds"
                " [HM-COMPARE-032]"
            )
        others = [
            n for n in self.controllers if CONTROLLERS[n].model != "hybrid" or not CONTROLLERS[n].compared
        ]
        alarming = [name for name in self.monitors if name in ALARMING]
        if self.guard and others:
            raise InputError(
                f"study: the guard needs a hybrid, but controller {others[0]} has another model. With a guard, use "
                "only the controllers hybrid_observer or hybrid [HM-COMPARE-033]"
            )
        if self.guard and len(alarming) < len(self.monitors):
            raise InputError(
                f"study: a guard reacts to alarms; use only monitors {' or '.join(ALARMING)} [HM-COMPARE-034]"
            )
        if alarming and others:
            raise InputError(
                f"study: monitor {alarming[0]} has limits of the hybrid, but controller {others[0]} has no hybrid. Use "
                "monitor own, or controllers with a hybrid [HM-COMPARE-035]"
            )


def _unify_fields(s: Study) -> dict[str, Any]:
    """Fields that have several input forms, as tuples."""
    models = {"model": s.models} if isinstance(s.models, str | Path) else s.models
    try:
        pairs = tuple((str(k), str(v)) for k, v in _read_items(models))
        vary = tuple((str(k), v) for k, v in _read_items(s.vary))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"study: models and vary must be mappings (name: value); {error} [HM-COMPARE-036]"
        ) from error
    drawn = s.random_faults
    if isinstance(drawn, Mapping):
        drawn = record(RandomFaults, drawn, "random_faults")
    lists: dict[str, Any] = {
        name: _read_list(getattr(s, name), name)
        for name in ("tasks", "controllers", "solvers", "horizons", "monitors")
    }
    if isinstance(s.seeds, int) and not isinstance(s.seeds, bool):
        if not 1 <= s.seeds <= MOST_DRAWS:
            raise InputError(
                f"study: seeds: give a number from 1 to {MOST_DRAWS}, or a list, got {str(s.seeds)[:40]} "
                "[HM-COMPARE-037]"
            )
        seeds: tuple[Any, ...] = tuple(range(s.seeds))
    else:
        seeds = _read_list(s.seeds, "seeds")
    faults = tuple(_read_faults(entry) for entry in _read_list(s.faults, "faults"))
    return {**lists, "models": pairs, "vary": vary, "random_faults": drawn, "seeds": seeds, "faults": faults}


def _read_items(value: Any) -> Any:
    return value.items() if isinstance(value, Mapping) else value


def _read_list(value: Any, name: str) -> tuple[Any, ...]:
    if isinstance(value, str | Fault) or value is None or not isinstance(value, Sequence):
        raise InputError(f"study: {name} must be a list, got {value!r}; write [{value!r}] [HM-COMPARE-038]")
    return tuple(value)


def _read_faults(entry: Any) -> tuple[Fault, ...]:
    if isinstance(entry, Fault):
        return (entry,)
    if isinstance(entry, str):
        words = [word.strip() for word in entry.split(" + ")]
        return () if words in (["none"], [""]) else tuple(parsed_fault(word) for word in words)
    if not isinstance(entry, Sequence):
        raise InputError(
            f"study: faults must be texts, lists of texts, or Fault; got {entry!r} [HM-COMPARE-039]"
        )
    return tuple(fault for part in entry for fault in _read_faults(part))


MOST_YAML = 2**16
"""Largest YAML file of a study [bytes]."""


def read_study(path: str | Path, **instead: Any) -> Study:
    """Read a study from a YAML file, whose keys are the fields of :class:`Study`.

    Folders of models are relative to the folder of the YAML file. The default name is that of the file. A study file
    executes no code: its scenario must be registered; give a ``.py`` file as ``instead["scenario"]``.

    Raises:
        InputError: If the file is missing or not YAML, its scenario is not registered, a key is unknown (the message
            names the nearest one), or the study is invalid.
    """
    path = Path(path)
    keys = _read_mapping(path)
    models, here = keys.get("models"), path.parent
    if isinstance(models, str):
        models = {"model": models}
    if isinstance(models, dict):
        keys["models"] = {label: here / str(folder) for label, folder in models.items()}
    keys.update(instead)
    if "scenario" not in instead and isinstance(keys.get("scenario"), str):
        scenario_of(keys["scenario"], path)
    if "models" not in keys:
        raise InputError(
            f"{path}: no models; write 'models: {{label: FOLDER}}', or give --model FOLDER [HM-COMPARE-040]"
        )
    study = record(Study, keys, str(path))
    return study if "name" in keys else replace(study, name=path.stem)


def _read_mapping(path: Path) -> dict[str, Any]:
    with named_extra("a study's file"):
        import yaml

    try:
        found = yaml.load(read_bytes(path, MOST_YAML), Loader=_make_loader())
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{path}: not valid YAML: {' '.join(str(error).split())[:300]} [HM-COMPARE-041]"
        ) from error
    if not isinstance(found, dict):
        raise InputError(
            f"{path}: must be a mapping of keys to values, got {type(found).__name__} [HM-COMPARE-042]"
        )
    return {str(key): value for key, value in found.items()}


@cache
def _make_loader() -> Any:
    """A YAML loader of plain data: texts, numbers, true, false, null, lists and mappings without duplicate keys.

    It reads the core schema of YAML 1.2; PyYAML's YAML 1.1 would turn ``on`` into a flag and ``1:30`` into a number.
    Anchors and aliases are refused, because they can expand a small file to a huge one.
    """
    import yaml

    class Loader(yaml.SafeLoader):
        yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012  its own, none of YAML 1.1

        def compose_node(self, parent: Any, index: Any) -> Any:
            event = self.peek_event()
            if getattr(event, "anchor", None) is not None:
                why = "anchors (&) and aliases (*) are not supported; write the value itself"
                raise yaml.composer.ComposerError(None, None, why, event.start_mark)
            return super().compose_node(parent, index)

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
            if len(set(keys)) < len(keys):
                twice = next(key for key in keys if keys.count(key) > 1)
                raise yaml.constructor.ConstructorError(
                    None, None, f"duplicate key {twice!r}", node.start_mark
                )
            return super().construct_mapping(node, deep)

    for tag, pattern, first in _PLAIN:
        Loader.add_implicit_resolver(f"tag:yaml.org,2002:{tag}", re.compile(rf"^(?:{pattern})$"), list(first))
    return Loader


_PLAIN = (
    ("bool", "true|True|TRUE|false|False|FALSE", "tTfF"),
    ("null", "~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("int", r"[-+]?[0-9]{1,20}", "-+0123456789"),
    ("float", r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
     "-+.0123456789"),
)  # fmt: skip
"""Plain scalars of the core schema of YAML 1.2: type, pattern, first characters."""


def built_in_studies() -> dict[str, Path]:
    """Files of the studies of registered scenarios, by name; the first line of each file describes it."""
    found: dict[str, Path] = {}
    for place in registered_scenarios().values():
        module = find_spec(place.partition(":")[0])
        for folder in (module.submodule_search_locations if module else None) or ():
            found |= {path.stem: path for path in sorted((Path(folder) / "studies").glob("*.yaml"))}
    return found


def built_in_study(name: str, models: str | Path | Mapping[str, str | Path]) -> Study:
    """The built-in study ``name`` with these models."""
    files = built_in_studies()
    return read_study(files[known(name, files, "built-in study")], models=models)
