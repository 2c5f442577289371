"""Roles of a recording's columns, from their names, their numbers and their effects on each other.

The first evidence in this order decides, and is given as the reason:

1. copies: a column that is a constant times another, or another one clipped at limits, is not a separate signal;
2. the name: words for a set-point, a command, a sensor (:func:`hybrid_mpc.data.names.role_said_by`);
3. a set-point: no column affects it, one follows it with gain one, and a third one reacts to it;
4. values that are held and then jump are commanded; a coarse sensor repeats values, too, but moves by single steps;
5. the unit: machines are driven in V, %, N m, and measured in rad, m, K;
6. causality: no column affects an input, and an input helps to predict outputs (Granger, *Investigating causal
   relations by econometric models and cross-spectral methods*, 1969). If all columns affect each other, as in a closed
   loop, the input is the roughest column, since machines are low-pass filters.

Only 1 to 4 are certain; roles from 5 and 6 are reported as uncertain.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.names import (
    DRIVING_UNITS,
    REACHED_UNITS,
    Role,
    is_command_of,
    is_set_point_of,
    role_said_by,
)
from hybrid_mpc.machine.units import turn_in

Array = NDArray[np.float64]
Kind = Literal["input", "output", "set-point", "disturbance", "none"]
HELD = 0.5
"""Least share of samples equal to the previous one for a column to look commanded."""
COARSE_STEP, COARSE_SPAN = 3.5, 30.0
"""A coarse sensor in slow motion has a median change of at most ``COARSE_STEP`` smallest changes, and a span of more
than ``COARSE_SPAN`` of them. A command jumps, or has few levels."""
EXACT, ROUNDED = 1e-3, 1e-6
"""Bounds of the largest error of a copy over its span, which is the rounding of the file. Two sensors of one quantity
differ by more."""
INTERIOR, LIMITED = 0.1, 0.02
"""Least shares of samples between and at the limits of a clipped copy."""
SWITCHES = 5
"""Fewest changes of a switch that show its effect."""
LAGS = 6
"""Past samples from which columns are predicted."""
ROWS = 6000
"""Most samples to which a prediction is fitted."""
FEWEST_ROWS = 60
"""Fewest samples to which a prediction is fitted."""
STRIDES = (1, 4, 16, 64)
"""Sampling distances of the predictions: slow machines are often sampled fast."""
ACTS = 5.0
"""Least link of a real effect: by chance a link is 1, with a standard deviation of 0.6."""
QUIET = 3.0
"""Largest link that may be chance."""
LEADS = 2.0
"""Least ratio of a link to the reverse one for the first column to be the cause."""
STRONGER = 8.0
"""Ratio of a column's strongest effect on others to that of an input on it, from which the latter may be chance."""
MOST_LINKED = 16
"""Most columns among which links are computed."""
GAIN, OFFSET = 0.25, 0.25
"""Largest deviations of a column that follows a set-point: of its gain from one, and of its mean, in standard
deviations of the set-point."""
RATE = 0.97
"""Least correlation of a column with the rate of another for it to be that rate."""


@dataclass(frozen=True)
class Trait:
    """A column for the assignment of roles: full name, unit, numbers ``(m,)`` of each recording, NaN where blank."""

    full: str
    unit: str
    pieces: tuple[Array, ...]

    @cached_property
    def values(self) -> Array:
        """All known numbers."""
        whole = np.concatenate(self.pieces)
        return whole[np.isfinite(whole)]

    @cached_property
    def changes(self) -> Array:
        """Differences of consecutive samples within the recordings."""
        steps = np.concatenate([np.diff(piece) for piece in self.pieces])
        return steps[np.isfinite(steps)]

    @cached_property
    def levels(self) -> Array:
        """Distinct numbers, increasing."""
        return np.unique(self.values)

    @property
    def whole(self) -> bool:
        """Whether every row has a number, as for an input."""
        return sum(map(len, self.pieces)) == len(self.values)

    @cached_property
    def said(self) -> Role:
        """The role by its name."""
        # most integer values of a column of modes
        few = len(self.levels) <= 8 and bool((self.levels == np.round(self.levels)).all())
        return role_said_by(self.full, self.unit, switches=few)

    @cached_property
    def is_held(self) -> bool:
        """Whether the column is held and then jumps."""
        changes = np.abs(self.changes)
        if not len(changes) or (changes == 0).mean() < HELD or not changes.any():
            return False
        moved = changes[changes > 0]
        step = float(np.quantile(moved, 0.1))
        return bool(np.median(moved) > COARSE_STEP * step or np.ptp(self.values) <= COARSE_SPAN * step)

    @property
    def is_switch(self) -> bool:
        """Whether the column only has the values zero and one."""
        return set(self.levels.tolist()) <= {0.0, 1.0}

    @property
    def roughness(self) -> float:
        """Root mean square of the changes, over the standard deviation."""
        size = float(np.std(self.values))
        return (
            float(np.sqrt(np.mean(np.square(self.changes)))) / size if size > 0 and len(self.changes) else 0.0
        )


class Verdict(NamedTuple):
    """A column's role, the reason, and whether it is certain; ``none`` is no signal."""

    kind: Kind
    reason: str
    sure: bool = True


BY_NAME = "by its name"


@dataclass
class _Links:
    """How much one column helps to predict another; each link is computed once."""

    known: dict[tuple[str, ...], float] = field(default_factory=dict)

    def of(self, source: Trait, target: Trait, now: bool = False, beside: Sequence[Trait] = ()) -> float:
        """The strongest link over all strides; by chance it is 1.

        ``now``: the present sample of the source is used, too. ``beside``: columns whose past is known as well.
        """
        key = source.full, target.full, "now" * now, *(one.full for one in beside)
        if key not in self.known:
            self.known[key] = max(_link(source, target, stride, now, beside) for stride in STRIDES)
        return self.known[key]

    def into(self, target: Trait, others: Sequence[Trait]) -> float:
        """The strongest link to a column."""
        return max((self.of(one, target) for one in others if one is not target), default=0.0)

    def out_of(self, source: Trait, others: Sequence[Trait]) -> float:
        """The strongest link from a column."""
        return max((self.of(source, one) for one in others if one is not source), default=0.0)


def _link(source: Trait, target: Trait, stride: int, now: bool, beside: Sequence[Trait]) -> float:
    """How much the past of one column helps to predict another, beyond its own past and that of ``beside``.

    ``ln(var_without / var_with) n / k`` with n samples and k added lags: a likelihood ratio, by chance 1.
    """
    pasts, others, nexts = [], [], []
    budget = ROWS // len(target.pieces) + LAGS + 1
    for i, whole in enumerate(target.pieces):
        first = max(0, (len(whole) - stride * budget) // 2)
        cut = slice(first, first + stride * budget, stride)
        y, x, *more = (trait.pieces[i][cut] for trait in (target, source, *beside))
        if len(y) <= 2 * LAGS:
            continue
        before = [slice(LAGS - k - 1, len(y) - k - 1) for k in range(LAGS)]
        rows = np.column_stack([
            *(one[s] for one in (y, *more) for s in before), *(x[s] for s in before), x[LAGS:], y[LAGS:],
        ])  # fmt: skip
        rows = rows[np.isfinite(rows).all(axis=1)]
        split = LAGS * (1 + len(more))
        pasts.append(rows[:, :split])
        others.append(rows[:, split : -1 if now else -2])
        nexts.append(rows[:, -1:])
    if sum(map(len, nexts)) < FEWEST_ROWS:
        return 0.0
    own, other, future = (_scaled(np.concatenate(parts)) for parts in (pasts, others, nexts))
    alone, both = (_residual(parts, future) for parts in (own, np.hstack([own, other])))
    return math.log((alone + 1e-12) / (both + 1e-12)) * len(future) / other.shape[1]


def _scaled(rows: Array) -> Array:
    centred = rows - rows.mean(axis=0)
    size = np.sqrt(np.mean(np.square(centred), axis=0))
    return centred / np.where(size > 0, size, 1.0)


def _residual(rows: Array, future: Array) -> float:
    return float(np.mean(np.square(future - rows @ np.linalg.lstsq(rows, future, rcond=1e-9)[0])))


def _line(x: Array, y: Array) -> tuple[float, float, float]:
    """Slope, constant and explained share of variance of the least-squares line ``y = a x + b``."""
    x0, y0 = float(x.mean()), float(y.mean())
    xx, yy = float(np.mean((x - x0) ** 2)), float(np.mean((y - y0) ** 2))
    if not (xx > 0 and yy > 0 and math.isfinite(xx) and math.isfinite(yy)):
        return 0.0, y0, 0.0
    xy = float(np.mean((x - x0) * (y - y0)))
    return xy / xx, y0 - xy / xx * x0, xy * xy / (xx * yy)


def copy_of(one: Trait, other: Trait) -> str:
    """Kind of copy of the first column that the second one is: ``scaled``, ``cut off`` at limits, or empty if none."""
    x, y = (np.concatenate(trait.pieces) for trait in (one, other))
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    if len(x) < FEWEST_ROWS:
        return ""
    # most rows by which two columns are compared first
    few = slice(None, None, max(1, len(x) // 2000))
    return _copy(x, y) if _copy(x[few], y[few]) else ""


def _copy(x: Array, y: Array) -> str:
    span = float(np.ptp(y))
    if not (np.ptp(x) > 0 and span > 0):
        return ""

    def exact(rows: NDArray[np.bool_]) -> tuple[float, float] | None:
        slope, constant, _ = _line(x[rows], y[rows])
        rounding = 0.6 * (_digit(y) + abs(slope) * _digit(x))
        near = span * min(max(rounding / span, ROUNDED), EXACT)
        good = slope != 0 and np.abs(y[rows] - slope * x[rows] - constant).max() <= near
        return (slope, constant) if good else None

    if exact(np.ones(len(x), dtype=bool)):
        return "scaled"
    low, high = y <= y.min() + 1e-9 * span, y >= y.max() - 1e-9 * span
    inside = ~(low | high)
    if inside.mean() < INTERIOR or 1 - inside.mean() < LIMITED or np.ptp(y[inside]) < INTERIOR * span:
        return ""
    found = exact(inside)
    if found is None:
        return ""
    free = found[0] * x + found[1]
    beyond = (free[low] <= y.min() + EXACT * span).all() and (free[high] >= y.max() - EXACT * span).all()
    return "cut off" if beyond else ""


def _digit(values: Array) -> float:
    """The smallest difference of two numbers: at most the rounding of the file."""
    return float(np.diff(np.unique(values)).min(initial=math.inf))


def follows(goal: Trait, reached: Trait) -> float:
    """Measure of how well a column follows a set-point: explained share of its variance at the best lag, with gain one.

    Zero if gain or mean differ.
    """
    best = 0.0
    longest = max(map(len, goal.pieces))
    for lag in (0, *(2**i for i in range(int(math.log2(max(longest // 10, 1))) + 1))):
        x, y = _shifted(goal, reached, lag)
        if len(x) < FEWEST_ROWS:
            continue
        slope, _, share = _line(x, y)
        size = float(np.std(x))
        if abs(slope - 1) <= GAIN and abs(float(np.mean(y - x))) <= OFFSET * size:
            best = max(best, share)
    return best


def _shifted(one: Trait, other: Trait, lag: int) -> tuple[Array, Array]:
    """Pairs of a column's numbers and another column's ``lag`` samples later, where both are known."""
    whole = [np.zeros((0, 2))]
    for x, y in zip(one.pieces, other.pieces, strict=True):
        rows = max(len(x) - lag, 0)
        whole.append(np.column_stack([x[:rows], y[len(y) - rows :]]))
    pairs = np.concatenate(whole)
    pairs = pairs[np.isfinite(pairs).all(axis=1)]
    return pairs[:, 0], pairs[:, 1]


def is_rate(rate: Trait, whole: Trait) -> bool:
    """Whether a column is the rate of change of another."""
    slopes, values = [], []
    for v, x in zip(rate.pieces, whole.pieces, strict=True):
        half = max(1, len(x) // 400)
        if len(x) > 4 * half:
            slopes.append((x[2 * half :] - x[: -2 * half])[half:-half])
            sums = np.cumsum(np.concatenate([[0.0], np.nan_to_num(v)]))
            mean = (sums[2 * half :] - sums[: -2 * half]) / (2 * half)
            values.append(mean[: len(x) - 2 * half][half:-half])
    if not slopes:
        return False
    a, b = np.concatenate(slopes), np.concatenate(values)
    known = np.isfinite(a) & np.isfinite(b)
    return bool(known.sum() >= FEWEST_ROWS and _line(a[known], b[known])[2] >= RATE**2)


def driven(output: Trait, inputs: Sequence[Trait]) -> bool:
    """Whether an input helps to predict an output more than by chance.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> u = np.repeat(rng.standard_normal(40), 10)
        >>> y = np.convolve(u, 0.9 ** np.arange(60))[:400] + 0.01 * rng.standard_normal(400)
        >>> driven(Trait("y", "", (y,)), [Trait("u", "", (u,))])
        True
        >>> driven(Trait("room", "", (np.sin(np.arange(400) / 50),)), [Trait("u", "", (u,))])
        False
    """
    return _Links().into(output, inputs) >= QUIET


def judge_roles(traits: Sequence[Trait], given: Mapping[str, Kind] | None = None) -> dict[str, Verdict]:
    """The role of every column; ``given`` roles are kept and used as evidence.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> u = np.repeat(rng.standard_normal(40), 10)
        >>> y = np.convolve(u, 0.9 ** np.arange(60))[:400] + 0.01 * rng.standard_normal(400)
        >>> found = judge_roles([Trait("a", "", (y,)), Trait("b", "", (u,)), Trait("c", "", (2 * u,))])
        >>> [(name, verdict.kind) for name, verdict in found.items()]
        [('a', 'output'), ('b', 'input'), ('c', 'none')]
    """
    return _Judge(traits, given or {}).verdicts()


class _Judge:
    """Columns and the verdicts on them, step by step."""

    def __init__(self, traits: Sequence[Trait], given: Mapping[str, Kind]) -> None:
        self.traits = {trait.full: trait for trait in traits}
        self.found = {full: Verdict(kind, "given by the user") for full, kind in given.items()}
        self.given = frozenset(given)
        self.copies: set[str] = set()
        self.links = _Links()

    def verdicts(self) -> dict[str, Verdict]:
        """Verdicts in the order of the columns."""
        self._copies()
        self._named()
        self._set_points()
        self._held()
        self._by_unit()
        self._by_cause()
        self._answers()
        self._rest()
        self._something()
        return {full: self.found[full] for full in self.traits}

    def of(self, *kinds: Kind) -> list[Trait]:
        """Columns with one of these roles."""
        return [t for full, t in self.traits.items() if full in self.found and self.found[full].kind in kinds]

    @property
    def open(self) -> list[Trait]:
        """Columns without a role yet."""
        return [t for full, t in self.traits.items() if full not in self.found]

    def _say(self, trait: Trait, kind: Kind, reason: str, sure: bool = True) -> None:
        self.found[trait.full] = Verdict(kind, reason, sure)

    def _copies(self) -> None:
        """Keep one of two copies: the given one, else the acting one, else the one with the clearer name, else the
        first.
        """
        if len(self.traits) < 3:  # of only two columns, one is the output even if it equals the other
            return
        for one, other in combinations(self.traits.values(), 2):
            if any(t.full in self.found and self.found[t.full].kind == "none" for t in (one, other)):
                continue
            there, back = copy_of(one, other), copy_of(other, one)
            if not (there or back):
                continue
            kept, left, how = one, other, "a constant times {}"
            if "scaled" in (there, back):
                if other.said and not one.said:
                    kept, left = other, one
            elif {one.said, other.said} <= {"measured", "quantity"}:
                kept, left, how = *((one, other) if there else (other, one)), "{} clipped at limits"
            else:
                kept, left, how = (
                    *((other, one) if there else (one, other)),
                    "{} before clipping at limits",
                )
            if left.full in self.given:
                kept, left = left, kept
            if left.full not in self.given and len(self.traits) - len(self.of("none")) > 2:
                self._say(left, "none", how.format(repr(kept.full)))
                self.copies.add(left.full)

    def _named(self) -> None:
        kinds: dict[Role, Kind] = {
            "command": "input", "actuator": "input", "set-point": "set-point", "measured": "output",
            "quantity": "output", "disturbance": "disturbance", "flag": "none", "label": "none",
        }  # fmt: skip
        reasons = {
            "flag": "a flag by its name, with few values",
            "label": "an error, a fault, a correction or a part of a command by its name",
        }
        for trait in self.open:
            said = trait.said or (
                "set-point" if any(is_set_point_of(trait.full, name) for name in self.traits) else ""
            )
            if said in kinds:
                reason, sure = reasons.get(said, BY_NAME), said != "disturbance"
                if said == "set-point" and not self._is_followed(trait):
                    reason, sure = f"{BY_NAME}, but no column follows this set-point: may be an input", False
                self._say(trait, kinds[said], reason, sure)
        # a drive's measurement of its command, or the second of two commands in series
        inputs = [t for t in self.of("input") if t.full not in self.given]
        for one in [t for t in inputs if t.said == "actuator"]:
            for other in [t for t in self.of("input") if t is not one and t.unit == one.unit]:
                if is_command_of(other.full, one.full) or self._answers_to(one, other):
                    self._say(one, "none", f"the drive's response to {other.full!r}")
                    break

    def _is_followed(self, goal: Trait) -> bool:
        """Whether another column follows a set-point: it explains half of that column's variance, with gain one."""
        return any(follows(goal, t) >= 0.5 for t in self.traits.values() if t is not goal)

    def _answers_to(self, answer: Trait, command: Trait) -> bool:
        """Whether a column is a drive's measurement of a command."""
        if self.links.of(command, answer) < LEADS * self.links.of(answer, command):
            return False
        pairs = [_shifted(command, answer, lag) for lag in range(LAGS + 1)]
        shares = [_line(x, y)[2] for x, y in pairs if len(x) >= FEWEST_ROWS]
        # least share of variance of a drive's measurement that its command explains
        return max(shares, default=0.0) >= 0.8

    def _set_points(self) -> None:
        """Set-points: no column affects them, one follows with gain one, and the column that drives it reacts.

        A drive's torque follows its command as well, but then no third column affects it as strongly.
        """
        others = [*self.open, *self.of("input", "output")]
        if not 3 <= len(others) <= MOST_LINKED:
            return
        for goal in [t for t in self.open if t.whole]:
            reached = [t for t in [*self.open, *self.of("output")] if t is not goal]
            best = max(reached, key=lambda t: follows(goal, t), default=None)
            # least explained share of the variance of a column that follows a set-point
            if best is None or follows(goal, best) < 0.5:
                continue
            link = self.links.of(goal, best)
            if link < ACTS or self.links.into(goal, others) * LEADS > link:
                continue
            inputs = self.of("input")  # also of an integrator, whose rate is its input
            drives = [
                t for t in [*self.open, *inputs]
                if t is not goal and t is not best and (t in inputs or not (is_rate(t, best) or is_rate(best, t)))
                and self.links.of(goal, t, now=True) >= ACTS and self.links.of(t, best) * LEADS >= link
            ]  # fmt: skip
            if not drives:
                continue
            self._say(goal, "set-point", f"{best.full!r} follows this column", False)
            if best.full not in self.found:
                self._say(best, "output", f"follows {goal.full!r}", False)
            drive = max(drives, key=lambda t: (t in inputs, t.roughness))
            if drive.full not in self.found and drive.said == "":
                self._say(drive, "input", f"responds to {goal.full!r} and affects {best.full!r}", False)

    def _held(self) -> None:
        """Columns that are held and jump, next to others that do not."""
        if all(t.is_held for t in [*self.open, *self.of("output")]):
            return
        commands = self.of("input")  # next to a command by name, a held column may be a load
        named = bool(commands)
        for trait in self.open:
            if not trait.is_held or trait.is_switch:
                continue
            alike = [t for t in commands if "" in (t.unit, trait.unit) or t.unit == trait.unit]
            followed = [t.full for t in alike if self._answers_to(trait, t)]
            if followed:
                self._say(trait, "none", f"the drive's response to {followed[0]!r}", False)
            else:
                self._say(trait, "input", "constant between jumps", sure=not named)
        for trait in self.open:
            if trait.is_held:
                moved = [t for t in [*self.open, *self.of("output")] if t is not trait]
                moves = (trait.changes != 0).sum() >= SWITCHES and self.links.out_of(trait, moved) >= ACTS
                if moves or not self.of("input"):
                    why = "affects other columns" if moves else "is the only column that could be an input"
                    self._say(trait, "input", f"a switch that {why}", False)
                else:
                    self._say(trait, "none", "a switch without effect on other columns: a flag", False)

    def _by_unit(self) -> None:
        driven = [t for t in self.open if t.unit in DRIVING_UNITS and t.said == "" and t.whole]
        if not self.of("input"):
            for trait in driven:
                if len(self.open) > 1 or self.of("output"):
                    self._say(trait, "input", f"{trait.unit} is a typical unit of inputs", False)

    def _by_cause(self) -> None:
        """If there is no input yet: the column that affects the others, else the roughest."""
        if self.of("input"):
            return
        answers = [t for t in self.open if t.said == "answer"]
        for trait in answers:
            self._say(trait, "input", "the drive's measurement; no command is recorded", False)
        if answers:
            return
        free = self.open
        goals = [t for t in self.of("set-point") if t.full not in self.given]
        if goals and (not free or len(free) + len(self.of("output")) < 2):
            for goal in goals:
                self._say(
                    goal,
                    "input",
                    "a set-point, but no column acts as an input: the recorded system includes the controller",
                    False,
                )
            return
        free = free or [t for t in self.of("output") if t.full not in self.given]
        outputs = [t for t in self.of("output") if t not in free]
        if len(free) + len(outputs) < 2:
            return
        candidates = [t for t in free if t.whole] or free  # an input has a number in every row
        candidates = [t for t in candidates if t.said != "measured"] or candidates
        candidates = [t for t in candidates if t.unit not in REACHED_UNITS] or candidates
        if len(free) + len(outputs) <= MOST_LINKED:
            every = [*free, *outputs]
            causes = [
                t for t in candidates
                if self.links.out_of(t, every) >= ACTS
                and all(
                    self.links.of(o, t) < max(QUIET, self.links.of(t, o) / LEADS) for o in every if o is not t
                )
            ]  # fmt: skip
            if causes and len(causes) < len(every):
                for trait in causes:
                    self._say(trait, "input", "affects other columns, and no column affects this one", False)
                return
            if any(self.links.out_of(t, every) >= ACTS for t in candidates):
                roughest = max(candidates, key=lambda t: t.roughness)
                commands = [t for t in candidates if t is not roughest and self._answers_to(roughest, t)]
                if commands:
                    self._say(
                        roughest,
                        "none",
                        f"the drive's response to {commands[0].full!r}",
                        False,
                    )
                    roughest = commands[0]
                self._say(
                    roughest, "input", "columns affect each other, and this column is the least smooth", False
                )
                return
        self._say(
            candidates[0],
            "input",
            "nothing distinguishes inputs from outputs; this is the first column",
            False,
        )

    def _answers(self) -> None:
        for trait in [t for t in self.open if t.said == "answer"]:
            self._say(trait, "none", "the drive's measurement of a command")

    def _rest(self) -> None:
        """Other columns are measured: disturbances if nothing affects them and they affect outputs, else outputs."""
        inputs = self.of("input")
        weak = [t for t in self.of("output") if t.said == "quantity" and t.full not in self.given]
        for trait in [*self.open, *weak]:
            outputs = [t for t in [*self.open, *self.of("output")] if t is not trait]
            if not outputs or len(outputs) + len(inputs) > MOST_LINKED:
                self.found.setdefault(trait.full, Verdict("output", "not commanded"))
                continue
            # a column that no input affects is no output of the machine; an angle is always taken as an output
            strongest = max((self.links.of(trait, t, beside=inputs) for t in outputs), default=0.0)
            free = turn_in(trait.unit) is None and all(
                self.links.of(t, trait) < max(QUIET, strongest / STRONGER) for t in inputs
            )
            free = free and not any(is_rate(trait, t) or is_rate(t, trait) for t in outputs)
            moved = [t for t in outputs if self.links.of(trait, t, beside=inputs) >= ACTS] if free else []
            back = max((self.links.of(t, trait) for t in moved), default=0.0)
            there = max((self.links.of(trait, t, beside=inputs) for t in moved), default=0.0)
            if moved and back < max(QUIET, there / LEADS):
                known = trait.unit and trait.unit not in REACHED_UNITS
                alike = next((t.full for t in inputs if known and t.unit == trait.unit), "")
                if alike and trait.whole and trait.said == "":
                    self._say(trait, "input", f"affects outputs, and has the unit of {alike!r}", False)
                else:
                    self._say(
                        trait, "disturbance", "affects outputs, and no input affects this column", False
                    )
            elif (
                trait.said == "quantity"
                and trait.unit in ("degC", "degF", "K")  # of the surroundings
                and free
                and any(self.links.into(t, inputs) >= ACTS for t in outputs if t.said != "measured")
            ):
                # inputs that affect another output would show in this one, too
                self._say(trait, "disturbance", "no input affects this column", False)
            elif free and trait.said == "":
                self._say(trait, "output", "no input affects this column: may be a disturbance", False)
            else:
                self.found.setdefault(trait.full, Verdict("output", "not commanded"))

    def _something(self) -> None:
        """Ensure one output and one input, even against names; copies remain excluded."""
        inputs = self.of("input")
        if not self.of("output") and len(inputs) > 1:
            ours = [t for t in inputs if t.full not in self.given]
            ours = [t for t in ours if t.said != "command"] or ours
            if ours:
                last = max(ours, key=lambda t: self.links.into(t, inputs))
                self._say(
                    last,
                    "output",
                    "no column is named as measured, and the others affect this column most",
                    False,
                )
        spare = [
            t for t in [*self.of("disturbance"), *self.of("set-point"), *self.of("none")]
            if t.full not in self.given and t.full not in self.copies
        ]  # fmt: skip
        needed: tuple[Kind, ...] = ("output", "input")
        for kind in needed:
            if not self.of(kind) and spare:
                trait = next((t for t in spare if t.whole), spare[0])
                spare.remove(trait)
                self._say(trait, kind, f"the only column left (role by name: {trait.said or 'none'})", False)
