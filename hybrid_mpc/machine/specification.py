"""How a machine's recordings are read, and how ``hybrid-mpc benchmark`` evaluates models on them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Annotated, Literal

from hybrid_mpc.records import Fields
from hybrid_mpc.rules import (
    Bound,
    Column,
    Duration,
    Label,
    Name,
    NotNegative,
    Number,
    Positive,
    Seconds,
    Share,
    Shift,
    Within,
)

Role = Literal["train", "valid", "test", "nominal"]
"""Use of a part of a recording, see :class:`Window`."""
Count = Annotated[int, Within(1, 10**9, "a whole number from 1 to 1e9")]
CountOrNone = Annotated[int, Within(0, 10**9, "a whole number from 0 to 1e9")]


@dataclass(frozen=True)
class Window:
    """A part of a recording and its use.

    Args:
        start: First time [s] in the recording's own time.
        end: Last time [s].
        role: ``"train"``, ``"valid"``, ``"test"``, or ``"nominal"``: free of disturbances but unsuitable for free runs
            (e.g. standing at an unstable point); the monitor must stay quiet there.

    Raises:
        InputError: If a field is of a wrong kind, or the end is not after the start.
    """

    start: Bound
    end: Bound
    role: Role

    def __post_init__(self) -> None:
        own = Fields(self, f"window {self.start!r} to {self.end!r}")
        own.need("start end", lambda: self.start < self.end, "end must be after start [HM-MACHINE-023]")
        own.refuse()


@dataclass(frozen=True)
class DataSpec:
    """How a machine's recordings are read.

    Args:
        time: Column of the time stamps [s], or a number: the sampling period [s] of files without such a column.
        inputs: Columns of the inputs, in the order of the prior's inputs (zero-order hold).
        outputs: Columns of the measured outputs, in the order of the prior's outputs. A blank cell is a missing sample.
        dt: Model period [s]; recordings are resampled to it.
        max_gap: Longest time [s] between two samples; a recording is cut at longer gaps.
        smoothing: Length [s] of the local polynomial that smooths and differentiates outputs that are the positions of
            states ``[q, v]``. The prior is fitted to the result, and then smooths them once more by its own equations.
            Parts by ``fractions`` are this far apart.
        warm_up: Measured past [s] before every free run: x(0) is smoothed from it, h is warmed up on it, and errors in
            it are not counted.
        windows: Windows by file stem. Other recordings are split by ``fractions``.
        fractions: Shares of training, validation and test samples, in this order of time.
        free_run: Length [s] of the free runs that evaluate a model; one starts every fifth of it. Default: each test
            trajectory as a whole. At an unstable point, which multiplies every error, many short runs are better.
        inputs_of: Input columns of single recordings, by file stem, where they differ from ``inputs``.
        units: Units of columns that are not in seconds or in their signal's unit, by column: ``"ms"``, ``"deg"``, or
            the factor as a number (:mod:`hybrid_mpc.data.recording`).
        largest_delay: Longest delay [s] of the inputs that is fitted with the prior's parameters. Default 0: the input
            acts at once.
        disturbances: Columns of the disturbances, which are measured and not commanded (wind, supply voltage), in the
            order of the prior's disturbances. Default: none.
        delays: Known delays [s] by column. An input acts this much later than recorded; an output or a disturbance was
            measured this much earlier than recorded. A negative delay means the opposite. Reading shifts the columns
            accordingly. Default: none.
        delays_of: Known delays of single recordings, by file stem and column, instead of those in ``delays``.

    Raises:
        InputError: With all problems: a field of a wrong kind, a length that is not positive, a delay that is not
            finite, a column named twice, fractions that do not sum to one.

    Example:
        >>> spec = DataSpec(0.1, ("u",), ("y",), 0.1, 0.3, 1.0, 1.0, delays={"y": 0.2}, delays_of={"b": {"u": 0.1}})
        >>> spec.delays_in("a"), spec.delays_in("b")
        ({'y': 0.2}, {'y': 0.2, 'u': 0.1})
    """

    time: Column | Seconds
    inputs: tuple[Column, ...]
    outputs: tuple[Column, ...]
    dt: Seconds
    max_gap: Seconds
    smoothing: Seconds
    warm_up: Seconds
    windows: Mapping[str, tuple[Window, ...]] = field(default_factory=dict)
    fractions: tuple[Share, Share, Share] = (0.6, 0.2, 0.2)
    free_run: Seconds | None = None
    inputs_of: Mapping[str, tuple[Column, ...]] = field(default_factory=dict)
    units: Mapping[Column, Label | Number] = field(default_factory=dict)
    largest_delay: Duration = 0.0
    disturbances: tuple[Column, ...] = ()
    delays: Mapping[Column, Shift] = field(default_factory=dict)
    delays_of: Mapping[str, Mapping[Column, Shift]] = field(default_factory=dict)

    @property
    def columns(self) -> frozenset[str]:
        """All columns that are read from any file."""
        time = (self.time,) if isinstance(self.time, str) else ()
        return frozenset(chain(time, self.inputs, self.disturbances, self.outputs, *self.inputs_of.values()))

    def inputs_in(self, stem: str) -> tuple[str, ...]:
        """Input columns of the recording of this file stem."""
        return tuple(self.inputs_of.get(stem, self.inputs))

    def delays_in(self, stem: str) -> dict[str, float]:
        """Known delays [s] by column in the recording of this file stem."""
        return {**self.delays, **self.delays_of.get(stem, {})}

    def __post_init__(self) -> None:
        own = Fields(self, "data specification")
        for name in ("inputs", "disturbances", "outputs"):
            own.distinct(name, lambda name=name: getattr(self, name), f"{name}: column")  # type: ignore[misc]
        own.need(
            "inputs_of", lambda: all(len(set(c)) == len(c) for c in self.inputs_of.values()),
            "inputs_of: a column appears twice in one recording. Name it once. [HM-MACHINE-024]",
        )  # fmt: skip
        own.need(
            "fractions", lambda: abs(sum(self.fractions) - 1.0) <= 1e-9,
            f"fractions: must sum to 1, got {self.fractions} [HM-MACHINE-025]",
        )  # fmt: skip
        own.refuse()


@dataclass(frozen=True)
class ChoiceRule:
    """Evidence on held-out data that is required to recommend a hybrid instead of the fitted prior.

    Args:
        confidence: One-sided probability with which the upper bound of the error ratio holds. Default: 0.95. If half a
            correction is exactly as good as the prior, and all else is worse, half the correction is recommended in 6 %
            of the cases. With a higher confidence the prior is recommended more often.
        shares: Shares of a network's correction that are tried if the whole does not pass, the largest first. Default:
            0.75 and 0.5. The error of a model between prior and hybrid varies less than that of either. A quarter alone
            passed in 3 of 45 checks on real machines, with the error of the prior.
        fewest: Smallest number of recordings that give a bound. Default: 3. Two may agree by chance: on the temperature
            lab two did, and a hybrid with 1.3 to 1.4 times the prior's error was recommended.
        limit: Ratio of errors that the upper bound must be below. Default: 1, a hybrid that is surely not worse. With
            ``confidence=0.9, limit=1.05`` the best expectation is recommended whose probability of 5 % more error is
            below 10 %.
        each: Largest ratio of errors of each output, over all held-out data together. Default: 1.1, so that an output
            does not get much worse for the others' sake.

    Example:
        >>> ChoiceRule(confidence=0.975).shares
        (0.75, 0.5)
    """

    confidence: Annotated[float, Within(0.5, 0.9999, "a probability from 0.5 to 0.9999")] = 0.95
    shares: tuple[Share, ...] = (0.75, 0.5)
    fewest: Annotated[int, Within(2, 10**6, "a whole number from 2 to 1e6")] = 3
    limit: Annotated[float, Within(0.5, 2.0, "a ratio from 0.5 to 2")] = 1.0
    each: Annotated[float, Within(1.0, 1e6, "a ratio from 1 to 1e6")] = 1.1

    def __post_init__(self) -> None:
        Fields(self, "choice rule").refuse()


@dataclass(frozen=True)
class BenchmarkBudget:
    """Effort of the training of a machine's networks.

    Args:
        hidden: Hidden units of each network.
        networks: Networks trained per model, each without another part of the data. Their mean is deployed: one network
            of ``networks * hidden`` hidden units z, which determines the time of a control step.
        teacher_steps: Optimiser steps with teacher forcing.
        free_run_steps: Optimiser steps on free runs.
        horizon: Most counted periods of a free run in training. Default: 50.
        batch: Windows per step. Default: 32.
        decay: Weight decay times the number of training samples: fewer samples need more decay against overfitting.
            Default: 300.
        prior_replay: Weight that fades corrections where nothing was measured (``TrainingSettings``), for a machine
            whose tasks leave the range of its recordings. Default: zero.

    Example:
        >>> BenchmarkBudget(hidden=16, networks=2, teacher_steps=100, free_run_steps=200, horizon=40).batch
        32
    """

    hidden: Count
    networks: Count
    teacher_steps: CountOrNone
    free_run_steps: CountOrNone
    horizon: Count = 50
    batch: Count = 32
    decay: NotNegative = 300.0
    prior_replay: NotNegative = 0.0

    def __post_init__(self) -> None:
        Fields(self, "budget").refuse()


@dataclass(frozen=True)
class BenchmarkSpec:
    """How a machine's models are evaluated by free runs over held-out recordings.

    A run starts after the scenario's ``warm_up`` and covers the rest of the recording, or ``length`` seconds.

    Args:
        budgets: Effort by name, ``"quick"`` and ``"full"``.
        units: By output name, the unit of its results and the factor to that unit: ``{"x": ("mm", 1e3)}`` for an output
            in metres. Default: the output's own unit.
        length: Length [s] of a run after its warm-up. Default: the whole recording.
        repeated: Whether a recording is evaluated by as many consecutive runs of that length as it holds. Default: by
            one run from its beginning.
        piece: Length [s] of the pieces into which long training recordings are cut. Default: 25 s.
        cycle: Roles of these pieces, repeated in order of time, for recordings whose last parts are not representative.
            Default: none, the data specification splits.
        valid_every: Every ``valid_every``-th training file, in order of their names, is used as a whole for validation,
            the others for training. For short runs whose last second is not representative. The files must not have
            windows in the data specification, which also splits fewer files. Default: zero, never.
        fractions: Shares of training, validation and held-back samples. A benchmark has test files of its own, while
            the main job needs a part for evaluation. Default: those of the data specification.

    Raises:
        InputError: If a length or a factor is out of range, a cycle lacks a required role, both ``cycle`` and
            ``valid_every`` are given, or repeated runs have no length.

    Example:
        >>> BenchmarkSpec({}, units={"q": ("mm", 1e3)}).length is None
        True
    """

    budgets: Mapping[Name, BenchmarkBudget] = field(default_factory=dict)
    units: Mapping[str, tuple[Label, Positive]] = field(default_factory=dict, kw_only=True)
    length: Seconds | None = None
    piece: Seconds = 25.0
    cycle: tuple[Literal["train", "valid", "test"], ...] = ()
    valid_every: CountOrNone = 0
    repeated: bool = field(default=False, kw_only=True)
    fractions: tuple[Share, Share, Share] | None = None

    def __post_init__(self) -> None:
        own = Fields(self, "benchmark specification")
        own.need(
            "repeated length", lambda: not self.repeated or self.length is not None, "repeated: runs need a length"
            " [HM-MACHINE-026]"
        )  # fmt: skip
        own.need(
            "cycle", lambda: not self.cycle or {"train", "valid"} <= set(self.cycle),
            f"cycle: must contain 'train' and 'valid', and may contain 'test', got {self.cycle} [HM-MACHINE-027]",
        )  # fmt: skip
        own.need(
            "valid_every cycle", lambda: not self.valid_every or (self.valid_every >= 2 and not self.cycle),
            "valid_every: must be 2 or more (0: never), without a cycle, got "
            f"{self.valid_every} and cycle {self.cycle} [HM-MACHINE-028]",
        )  # fmt: skip
        own.need(
            "fractions", lambda: self.fractions is None or abs(sum(self.fractions) - 1.0) <= 1e-9,
            f"fractions: must sum to 1, got {self.fractions} [HM-MACHINE-029]",
        )  # fmt: skip
        own.refuse()
