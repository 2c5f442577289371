"""``hybrid-mpc new``: write a first scenario from recordings; the user's decisions are marked TODO."""

from __future__ import annotations

import keyword
import tokenize
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.check.columns import COUNTED, Column, ascii_of, clock_of, columns_of, near, no_signal
from hybrid_mpc.check.first_model import CLOSED, Lag, Runs, feedback_of, first_lag, growth_of, slowest
from hybrid_mpc.check.roles import Kind, Trait, Verdict, driven, judge_roles
from hybrid_mpc.data.excitation import check_excitation
from hybrid_mpc.data.files import opened
from hybrid_mpc.data.recording import MIN_SCORED, read_recordings
from hybrid_mpc.data.scales import noise_of, robust_spread
from hybrid_mpc.data.source import Source, name_and_unit
from hybrid_mpc.data.trajectories import load_trajectories
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.files import write_text
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.specification import DataSpec
from hybrid_mpc.machine.units import per_second, turn_in
from hybrid_mpc.records import shown
from hybrid_mpc.rules import LARGEST

Array = NDArray[np.float64]
MARK = "TODO"
"""Mark of everything that the user decides."""
ACTING = "For a measured disturbance: new ... --disturbance-column NAME"
"""Remedy for a measured column that is no output."""
SMOOTHED = 7
"""Fewest sampling periods of smoothing: a polynomial of order 4 needs six samples, and stamps are rounded."""
GUESSED = 0.005
"""Assumed error of a sensor whose noise the recordings do not show, in spans of the output."""
INTEGRATES = "the recordings are too short to show a steady state"
"""Remark on the rate of an output that integrates."""
HORIZONS = 20, 100
"""Shortest and longest proposed horizon [periods]."""
KINDS: Mapping[Kind, str] = {
    "input": "an input",
    "output": "an output",
    "disturbance": "a measured disturbance",
    "set-point": "a set-point",
}
"""Names of the roles in messages."""
USED = frozenset(("Prior", "Signal", "Parameter", "Scenario", "DataSpec", "OperatingPoint", "OCP"))
"""Names that the written file uses."""


@dataclass(frozen=True)
class Draft:
    """A draft of a scenario from recordings: their time, and the roles of their columns.

    ``period`` is the sampling period [s]. ``time`` is the time's column, None without one; ``seconds`` is its unit [s],
    ``doubt`` what is uncertain about it. ``left_out`` gives, by column, the reason why it is no signal.
    ``disturbances`` are measured, act on the machine and are not commanded. ``verdicts`` give the reason of each role.
    ``loop`` describes the evidence of a closed loop, empty without one; ``growth`` [1/s] is the rate at which the
    machine diverges from its steady state, zero if it does not. ``lags`` are first models of the outputs. ``length`` is
    that of the shortest recording [s]. ``notes`` say by file how it was read. ``periods`` [s] are those of the
    recordings, in their order.
    """

    time: Column | None
    period: float
    inputs: tuple[Column, ...]
    outputs: tuple[Column, ...]
    left_out: Mapping[str, str]
    disturbances: tuple[Column, ...] = ()
    seconds: float = 1.0
    doubt: str = ""
    set_points: tuple[Column, ...] = ()
    verdicts: Mapping[str, Verdict] = field(default_factory=dict)
    loop: str = ""
    growth: float = 0.0
    length: float = 0.0
    lags: tuple[Lag, ...] = ()
    notes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    periods: tuple[float, ...] = ()

    @property
    def sampling(self) -> str:
        """The sampling periods in words, each once: ``0.01 s, 0.02 s; the longest is the model period``."""
        each = [f"{period:.4g} s" for period in sorted(self.periods or (self.period,))]
        each = list(dict.fromkeys(each))
        return ", ".join(each) + ("; the longest is the model period" if len(each) > 1 else "")

    @property
    def unsure(self) -> dict[str, str]:
        """Reasons of the uncertain roles, by column."""
        return {name: verdict.reason for name, verdict in self.verdicts.items() if not verdict.sure}

    @property
    def runs(self) -> tuple[Runs, ...]:
        """Outputs and :attr:`effects` of each recording, at the longest sampling period of all.

        A recording that is sampled faster has the inputs' means until the next sample.
        """
        y, u = (list(zip(*(c.pieces for c in group), strict=True)) for group in (self.outputs, self.effects))
        runs = [Runs(np.column_stack(a), np.column_stack(b)) for a, b in zip(y, u, strict=True)]
        periods = self.periods or (self.period,) * len(runs)
        return tuple(_thinned(run, round(self.period / p)) for run, p in zip(runs, periods, strict=True))

    @property
    def sensor_sigma(self) -> tuple[tuple[float, bool], ...]:
        """Standard deviation of each sensor's error, and whether the recordings show it; else the value is assumed.

        Noise is what remains after three differences, and a sensor's smallest step over ``sqrt(12)`` at least. The
        noise is visible if the fourth difference gives nearly the same value: every further difference reduces the part
        of a motion.
        """
        found = []
        for column in self.outputs:
            pieces = column.pieces
            sigma = float(noise_of([Runs(piece[:, None], piece[:, None]) for piece in pieces])[0])
            fourth = robust_spread(np.concatenate([np.diff(piece, 4) for piece in pieces])) / np.sqrt(70.0)
            known = column.values[np.isfinite(column.values)]
            step = float(np.diff(np.unique(known)).min(initial=np.inf)) / np.sqrt(12.0)
            guess = GUESSED * float(np.ptp(column.span))
            # least noise found by fourth differences, over that by third ones, that is noise and no motion
            shown_there = sigma > 0 and fourth > 0.6 * sigma and guess > 0
            bound = min(sigma, guess) if sigma > 0 else guess
            found.append((max(sigma, step) if shown_there else bound, shown_there))
        return tuple(found)

    @property
    def drives(self) -> tuple[Column, ...]:
        """All inputs and disturbances."""
        return (*self.inputs, *self.disturbances)

    @property
    def effects(self) -> tuple[Column, ...]:
        """Signals in which the first prior is linear: inputs and disturbances; sine and cosine of a periodic signal."""
        return (*self.inputs, *(own for c in self.disturbances for own in c.parts))

    @property
    def signals(self) -> tuple[Column, ...]:
        """All signals."""
        return (*self.drives, *self.outputs)

    @property
    def units(self) -> dict[str, float]:
        """Factors for the DataSpec: of a time that is not in seconds, and of units that cannot be read."""
        named = self.time is not None and (self.seconds != 1.0 or self.doubt == COUNTED)
        time = {self.time.full: self.seconds} if named and self.time else {}
        return time | {
            c.full: 1.0 for c in self.signals if not c.unit and name_and_unit(c.full)[1] not in ("", "1")
        }

    def data(self, smoothing: float, warm_up: float) -> DataSpec:
        """The DataSpec of the recordings; ``smoothing`` and ``warm_up`` [s]."""
        return DataSpec(
            self.time.full if self.time else float(_rounded(self.period)),
            tuple(c.full for c in self.inputs), tuple(c.full for c in self.outputs),
            dt=float(_rounded(self.period)), max_gap=float(_rounded(5 * self.period)),
            smoothing=float(_rounded(smoothing)), warm_up=float(_rounded(warm_up)), units=self.units,
            disturbances=tuple(c.full for c in self.disturbances),
        )  # fmt: skip


@dataclass(frozen=True)
class Roles:
    """Signals by role, for reading: one state per output, and a second one if the output has a speed."""

    states: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    disturbances: tuple[Signal, ...]

    @classmethod
    def of(cls, draft: Draft, names: Sequence[str] = (), speeds: Sequence[Signal] = ()) -> Roles:
        """Signals of a draft; ``names`` of the outputs (default: their own), ``speeds`` of some of them."""
        inputs, outputs, disturbances = (
            tuple(c.input_signal if group is draft.inputs else c.signal for c in group)
            for group in (draft.inputs, draft.outputs, draft.disturbances)
        )
        if names:
            outputs = tuple(replace(s, name=name) for s, name in zip(outputs, names, strict=True))
        return cls((*outputs, *speeds), inputs, outputs, disturbances)


def write_scenario(
    path: Path, data: Path | Sequence[Path], inputs: Sequence[str] = (), outputs: Sequence[str] = (), time: str = "",
    disturbances: Sequence[str] = (),
) -> Draft:  # fmt: skip
    """Write a scenario for recordings, and return its draft.

    Args:
        path: Python file to create; it must not exist.
        data: The recording, or several of one machine. Signals are the columns that all of them have.
        inputs: Columns of the inputs. Default: columns that look commanded (:mod:`hybrid_mpc.check.roles`).
        outputs: Columns of the outputs. Default: columns that look measured.
        time: Column of the time. Default: a column named as time, else one that rises evenly.
        disturbances: Columns of measured disturbances. Default: by their names and numbers.

    Raises:
        InputError: If the file exists, a recording is faulty, too short or diverges, has no input or no output, or has
            a time that cannot be used; with the reason.

    Example:
        ``write_scenario(Path("my_machine.py"), [Path("monday.csv"), Path("tuesday.csv")])``
    """
    if path.suffix != ".py":
        raise InputError(
            f"{path}: a scenario is a Python file. Give a name that ends with .py. [HM-CHECK-009]"
        )
    if path.exists():
        raise InputError(f"{path}: the file exists already. Give another name, or remove it. [HM-CHECK-010]")
    files = (data,) if isinstance(data, Path) else tuple(data)
    if not files:
        raise InputError("recordings: none given. Name at least one file with --data. [HM-CHECK-011]")
    draft = draft_scenario([opened(file) for file in files], inputs, outputs, time, disturbances)
    write_text(path, scenario_text(path, files, draft))
    return draft


def left_to_decide(path: Path) -> list[str]:
    r"""Comments in a scenario's file that begin with the mark, with line numbers; strings do not count.

    Raises:
        InputError: If the file is not valid Python.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "a.py"
        ...     _ = path.write_text("x = 1\ny = 2  # TODO: is it?\n")
        ...     left_to_decide(path)
        ['line 2: is it?']
    """
    found, mark = [], f"# {MARK}"
    try:
        with path.open("rb") as file:
            for token in tokenize.tokenize(file.readline):
                if token.type == tokenize.COMMENT and token.string.startswith(mark):
                    found.append(f"line {token.start[0]}: {token.string.removeprefix(mark).lstrip(': ')}")
    except (SyntaxError, UnicodeDecodeError, tokenize.TokenError) as error:
        raise InputError(
            f"{path}: not valid Python ({error}). Correct it, or save it as UTF-8 text. [HM-CHECK-012]"
        ) from error
    return found


def draft_scenario(
    sources: Sequence[Source],
    inputs: Sequence[str],
    outputs: Sequence[str],
    time: str,
    disturbances: Sequence[str] = (),
) -> Draft:
    """Assign roles to the recordings' columns: as given, else by names and numbers."""
    columns, left_out = columns_of(sources)
    source = sources[0]

    def named(names: Sequence[str]) -> tuple[Column, ...]:
        found = list(map(source.find, names))
        refuse(
            [
                f"{source.path}: column {shown(name)} cannot be a signal: {left_out[name]} [HM-CHECK-013]"
                for name in found
                if name in left_out
            ]
        )
        return tuple(columns[name] for name in found)

    given: dict[Kind, tuple[Column, ...]] = {
        "input": named(inputs), "output": named(outputs), "disturbance": named(disturbances),
    }  # fmt: skip
    kinds: dict[str, Kind] = {c.full: kind for kind, group in given.items() for c in group}
    clock = clock_of(sources, columns, left_out, source.find(time) if time else "", set(kinds))
    free = []
    for full, column in columns.items():
        if clock.column is not None and full == clock.column.full:
            continue
        if full not in kinds and (reason := no_signal(column)):
            left_out[full] = reason
        else:
            free.append(column)
    while True:
        verdicts = judge_roles([Trait(c.full, c.unit, c.pieces) for c in free], kinds)
        verdicts |= _left_to_user(verdicts, given)
        roles: dict[Kind, tuple[Column, ...]] = {
            kind: given.get(kind) or tuple(c for c in free if verdicts[c.full].kind == kind)
            for kind in ("input", "output", "disturbance", "set-point")
        }
        if not roles["input"] or not roles["output"]:
            reasons = "".join(f"\n  {shown(name)}: {reason}" for name, reason in left_out.items())
            raise InputError(
                f"{source.path}: no column is left for {'an output' if roles['input'] else 'an input'}; the file has "
                f"{', '.join(source.header)}. Give the roles: --input-column, --output-column, --disturbance-column."
                f"{source.note}{f' Not used:{reasons}' if reasons else ''} [HM-CHECK-014]"
            )
        draft = Draft(
            time=clock.column,
            period=clock.period,
            inputs=roles["input"],
            outputs=roles["output"],
            left_out=left_out,
            disturbances=roles["disturbance"],
            seconds=clock.seconds,
            doubt=clock.doubt,
            set_points=roles["set-point"],
            verdicts=verdicts,
            length=clock.length,
            periods=clock.periods,
        )
        draft = _unwrap([one.path for one in sources], draft)
        still = [full for full in _at_rest([one.path for one in sources], draft) if full not in kinds]
        if not still:
            break
        free = [c for c in free if c.full not in still]
        left_out |= dict.fromkeys(still, "constant in the training data")
    used = {c.full for c in (*draft.signals, *draft.set_points)}
    left_out |= {c.full: verdicts[c.full].reason for c in free if c.full not in used}
    runs = draft.runs
    acting = [Trait(c.full, c.unit, c.pieces) for c in draft.inputs]
    lags = [
        replace(
            first_lag(runs, i, draft.period, len(draft.inputs)),
            driven=driven(Trait(c.full, c.unit, c.pieces), acting),
        )
        for i, c in enumerate(draft.outputs)
    ]
    notes = {one.path.name: one.notes for one in sources if one.notes}
    return _in_loop(replace(draft, left_out=left_out, lags=tuple(lags), notes=notes))


def _thinned(run: Runs, stride: int) -> Runs:
    """A recording at every ``stride``-th sample, with the inputs' means until the next."""
    rows = len(run.y) // stride
    if stride <= 1 or rows < 2:
        return run
    return Runs(
        run.y[: stride * rows : stride], run.u[: stride * rows].reshape(rows, stride, -1).mean(axis=1)
    )


def _left_to_user(
    verdicts: Mapping[str, Verdict], given: Mapping[Kind, Sequence[Column]]
) -> dict[str, Verdict]:
    """Verdicts of columns with a role for which the user named other columns: the user's lists are complete."""
    named = {c.full for group in given.values() for c in group}
    found: dict[str, Verdict] = {}
    for full, verdict in verdicts.items():
        if full in named or not given.get(verdict.kind):
            continue
        found[full] = Verdict(
            "none", f"other columns were given as {verdict.kind}; without them: {verdict.reason}"
        )
    kept = {full: found.get(full, verdict) for full, verdict in verdicts.items()}
    if given["input"] and not given["output"] and not any(v.kind == "output" for v in kept.values()):
        found |= {
            full: Verdict("output", "the only column left", sure=False)
            for full, verdict in verdicts.items()
            if full not in named and verdict.kind in ("input", "set-point")
        }
    return found


def _depends(draft: Draft, goal: Column) -> bool:
    """Whether a set-point explains half of what the outputs alone leave unexplained of an input, in most recordings.

    This detects a loop of small gain, whose output does not follow the set-point.
    """
    explained = []
    for run, wanted in zip(draft.runs, goal.pieces, strict=True):
        if len(run.y) != len(wanted):
            continue
        known = np.isfinite(wanted) & np.isfinite(run.y).all(axis=1)
        alone = np.column_stack([np.ones(known.sum()), run.y[known]])
        both, u = np.column_stack([alone, wanted[known]]), run.u[known, : len(draft.inputs)]
        left = [u - x @ np.linalg.lstsq(x, u, rcond=None)[0] for x in (alone, both)]
        before, after = (np.sum(one**2, axis=0) for one in left)
        explained.append(bool((after < 0.5 * before).any()))
    return 2 * sum(explained) > len(explained)


def _in_loop(draft: Draft) -> Draft:
    """The draft with signs of a closed loop, and of an unstable machine in it."""
    if any(not np.isfinite(c.values).all() for c in draft.inputs):
        return draft
    # measured disturbances cannot depend on outputs
    runs = [Runs(run.y, run.u[:, : len(draft.inputs)]) for run in draft.runs]
    answered = feedback_of(runs)
    loop = ""
    if answered > CLOSED:
        loop = f"inputs respond to outputs {answered:.1f} times more than by chance"
    elif any(draft.verdicts[c.full].sure for c in draft.set_points):  # unsure: no column follows it
        loop = "a column follows a set-point"
    elif any(_depends(draft, c) for c in draft.set_points):
        loop = "an input depends on a set-point and the outputs"
    growth = growth_of(runs, draft.period) if loop else 0.0
    return replace(draft, loop=loop, growth=growth)


def _unwrap(paths: Sequence[Path], draft: Draft) -> Draft:
    """The draft with wrapped angles unwrapped; checks that the recordings can be read with it."""
    groups = (draft.outputs, draft.disturbances)
    outputs, others = (
        tuple(replace(c, periodic=turn_in(c.unit) is not None) for c in group) for group in groups
    )
    trial = replace(draft, outputs=outputs, disturbances=others)
    recordings, problems = read_recordings(
        paths, Roles.of(trial), trial.data(SMOOTHED * draft.period, 2 * draft.period)
    )
    refuse(problems)
    wrapped = {finding.channel for one in recordings for finding in one.findings if finding.kind == "wrapped"}
    lengths = tuple(len(one.y) for one in recordings)
    outputs, others = (
        tuple(
            replace(c, periodic=True, values=own, lengths=lengths) if c.full in wrapped else c
            for c, own in zip(group, np.concatenate(values).T, strict=True)
        )
        for group, values in zip(
            groups, ([one.y for one in recordings], [one.w for one in recordings]), strict=True
        )
    )
    return replace(draft, outputs=outputs, disturbances=others)


def _at_rest(paths: Sequence[Path], draft: Draft) -> list[str]:
    """Inputs and outputs that do not move in the training data, by their full names."""
    roles = Roles.of(draft)
    dataset = load_trajectories(
        paths, roles, draft.data(SMOOTHED * draft.period, 2 * draft.period), needed=("train",)
    )
    found = []
    for key, columns, signals in (("u", draft.inputs, roles.inputs), ("y", draft.outputs, roles.outputs)):
        for j, (column, signal) in enumerate(zip(columns, signals, strict=True)):
            # the column is checked as an input and as an output, alone
            train = [
                replace(piece, u=part, y=part, censored=np.zeros(part.shape, dtype=np.int8))
                for piece in dataset.by_role("train")
                for part in [getattr(piece, key)[:, [j]]]
            ]
            try:
                check_excitation(train, inputs=(signal,), outputs=(signal,))
            except InputError:
                found.append(column.full)
    return found


# The written file


def _text(text: str) -> str:
    """A string literal of Python: every text from a recording or a path is one, or is part of a comment."""
    written = repr(text)
    return f'"{written[1:-1]}"' if not {'"', "'"} & set(text) else written


def printable(text: str) -> str:
    r"""A text on one line, for a comment or a terminal: invisible characters are escaped.

    Example:
        >>> print(printable("u\n1, größe"))
        u\n1, größe
    """
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def _rounded(value: float, digits: int = 3) -> str:
    return f"{float(f'{value:.{digits}g}') + 0.0!r}"


def _signal(column: Column, name: str, *, acts: bool = False) -> tuple[str, str]:
    """A Signal as source text, and the comment behind it; ``acts``: it is an input."""
    low, high = column.span
    recorded = f"recorded: {near(low, (high - low) / 2000)} to {near(high, (high - low) / 2000)}"
    unit = f"unit from the header; {recorded}" if column.unit else f"{MARK}: give its unit; {recorded}"
    if column.asked:
        unit = f"{MARK}: check the unit, taken from the last letter of the name; {recorded}"
    signal = column.input_signal if acts else column.signal
    if acts and not column.periodic and None in column.limits:
        unit = f"{'' if unit.startswith(MARK) else f'{MARK}: '}{unit}. Give the limits of the actuator"
    ends = "periodic=True" if column.periodic else f"{signal.lower!r}, {signal.upper!r}"
    return f"Signal({_text(name)}, {_text(column.unit or '-')}, {ends})", unit


def _names(columns: Sequence[Column], taken: set[str]) -> list[str]:
    names = []
    for column in columns:
        name = _unused(column.identifier, taken)
        taken.add(name)
        names.append(name)
    return names


def _unused(name: str, taken: Iterable[str]) -> str:
    """A name that is not taken: the given one, or the given one with a number."""
    there, given, k = set(taken), name, 2
    while name in there:
        name, k = f"{given}_{k}", k + 1
    return name


def _speed_of(name: str, column: Column, lag: Lag, period: float, taken: Iterable[str]) -> tuple[str, Signal]:
    steps = np.diff(column.values) / period
    rms = float(np.sqrt(np.nanmean(steps**2))) if np.isfinite(steps).any() else 0.0
    # speeds with a larger rms are refused later: differentiated sensor noise must stay within
    fast = float(_rounded(max(10 * float(np.ptp(column.span)) / lag.seconds, 3 * rms), 2))
    speed = _unused(f"{name}_rate", taken)
    return speed, Signal(speed, per_second(column.unit or "-"), -fast, fast)


def scenario_text(path: Path, data: Sequence[Path], draft: Draft) -> str:
    """The text of the file: signals, a first prior of lags, and the DataSpec.

    Raises:
        InputError: If the recordings cannot be read with these, with the reason.
    """
    y_names = _names(draft.outputs, set())
    u_names, w_names = _names(draft.inputs, set()), _names(draft.disturbances, set())
    drives = [(f"u.{n}", n) for n in u_names]  # expressions of the effects, and names
    for name, column in zip(w_names, draft.disturbances, strict=True):
        angle = f"w.{name}" if column.signal.radians == 1 else f"{column.signal.radians!r} * w.{name}"
        turned = [(f"{key}({angle})", f"{key}_{name}") for key in ("sin", "cos")]
        drives += turned if column.periodic else [(f"w.{name}", name)]
    lags = draft.lags
    kind = "".join(part.capitalize() for part in ascii_of(path.stem).split("_")) or "Machine"
    kind = f"Machine{kind}" if kind[0].isdigit() or keyword.iskeyword(kind) or kind in USED else kind
    rates, parameters, steady = [], list[tuple[str, float, str, float, float, str]](), list[str]()
    gains, offsets = list[list[float]](), list[float]()
    taken, second = set[str](), dict[str, tuple[str, str]]()  # rates of second states by output

    def parameter(name: str, value: float, unit: str, low: float, high: float, text: str) -> str:
        name = _unused(name, taken)
        taken.add(name)
        parameters.append((name, min(max(value, low), high), unit, low, high, text))
        return f"p.{name}"

    def time_constant(name: str, value: float) -> str:
        seconds = float(_rounded(value))
        low, high = float(_rounded(seconds / 20)), float(_rounded(seconds * 20))
        return parameter(f"T_{name}", seconds, "s", low, high, "time constant")

    speeds: dict[str, tuple[str, Signal]] = {}  # second states by output: name and signal
    for name, column, lag in zip(y_names, draft.outputs, lags, strict=True):
        unit = column.unit or "-"
        span = float(np.ptp(column.span))
        low, high = column.span[0] - span, column.span[1] + span
        # the effect of the drives at their medians; what remains of the output may lie far outside its recorded range
        made = sum(
            gain * float(np.nanmedian(c.values)) for gain, c in zip(lag.gains, draft.effects, strict=True)
        )
        middle = min(max(lag.offset + made, low), high) - made
        low, high = min(low, low - made, middle), max(high, high - made, middle)
        rest = near(low, span / 20), near(middle, span / 500), near(high, span / 20)
        if lag.integrates(draft.length):
            # T y' = k u + c - y, where y stays near its median: y' = (k u + c - median) / T
            inner = lag.seconds if lag.states == 1 else 2 * lag.damping * lag.seconds
            pull = (lag.offset - float(np.nanmedian(column.values))) / inner
            pushes = [gain / inner for gain in lag.gains]
            sizes = [float(np.ptp(c.span)) for c in draft.effects]
            most = 10 * max(
                abs(pull), span / draft.length, *(abs(k * s) for k, s in zip(pushes, sizes, strict=True))
            )
            unit = per_second(unit)
            drift = parameter(
                f"drift_{name}", float(_rounded(pull)), unit, -float(_rounded(most)), float(_rounded(most)),
                "rate without inputs",
            )  # fmt: skip
            written = [drift]
            offsets.append(parameters[-1][1])
            gains.append([])
            for (acts, drive), source, push, size in zip(drives, draft.effects, pushes, sizes, strict=True):
                per, reach = f"{unit}/({source.unit or '-'})", float(_rounded(min(most / size, LARGEST)))
                k = parameter(
                    f"k_{name}_{drive}", float(_rounded(push, 4)), per, -reach, reach, f"rate per {drive}"
                )
                written.append(f"{k} * {acts}")
                gains[-1].append(parameters[-1][1])
            steady.append(f"{name}_moves = {' + '.join(written)}")
            if lag.states == 1:
                rates.append((f"{name}_moves", f"integrates: {INTEGRATES}"))
                continue
            constant = time_constant(name, lag.seconds / (2 * lag.damping))
            second[name] = f"({name}_moves - x.{{}}) / {constant}", f"{name} integrates: {INTEGRATES}"
            speeds[name] = _speed_of(
                name, column, lag, draft.period, {*y_names, *(one for one, _ in speeds.values())}
            )
            rates.append((f"x.{speeds[name][0]}", f"exact: the derivative of {name}"))
            continue
        constant = time_constant(name, lag.seconds)
        damping = ""
        if lag.states == 2:
            bounded = float(_rounded(min(max(lag.damping, 0.01), 5.0)))
            damping = parameter(f"D_{name}", bounded, "-", 0.0, 10.0, "damping")
        low, middle, high = map(float, rest)
        towards = [parameter(f"rest_{name}", middle, unit, low, high, "value without inputs")]
        offsets.append(parameters[-1][1])
        gains.append([])
        for (acts, drive), source, gain in zip(drives, draft.effects, lag.gains, strict=True):
            reach = float(_rounded(min(10 * max(abs(gain), span / float(np.ptp(source.span))), LARGEST)))
            per = f"{unit}/({source.unit})" if source.unit and source.unit != "-" else unit
            # rounded such that the output at the largest input stays the same
            value = float(near(gain, span / 500 / max(map(abs, source.span)))) or float(_rounded(gain))
            towards.append(
                f"{parameter(f'k_{name}_{drive}', value, per, -reach, reach, f'gain from {drive}')} * {acts}"
            )
            gains[-1].append(parameters[-1][1])
        steady.append(f"{name}_steady = {' + '.join(towards)}")
        if lag.states == 1:
            rates.append((f"({name}_steady - x.{name}) / {constant}", "first-order lag"))
            continue
        pull_text = f"({name}_steady - x.{name}) / {constant}**2 - 2 * {damping} / {constant} * x.{{}}"
        second[name] = pull_text, "second-order lag"
        speeds[name] = _speed_of(
            name, column, lag, draft.period, {*y_names, *(one for one, _ in speeds.values())}
        )
        rates.append((f"x.{speeds[name][0]}", f"exact: the derivative of {name}"))
    states = [_signal(column, name) for name, column in zip(y_names, draft.outputs, strict=True)]
    for name, (speed, signal) in speeds.items():
        ends = f"{signal.lower!r}, {signal.upper!r}"
        states.append((f"Signal({_text(speed)}, {_text(signal.unit)}, {ends})", "not measured"))
        rates.append((second[name][0].format(speed), second[name][1]))
    corrected = [n for n in y_names if n not in speeds] + [speed for speed, _ in speeds.values()]
    pace, _ = slowest(lags, draft.length)
    dt, length = draft.period, draft.length
    # validation and test data are a fifth each: both must hold a warm-up and the scored periods
    smoothing = max(SMOOTHED * dt, min(10 * dt, length / 40))
    warm = max(2 * dt, min(max(10 * dt, pace), length / 10, length / 5 - smoothing - (MIN_SCORED + 2) * dt))
    spec = draft.data(smoothing, warm)
    # faults of the recording that the written file would meet are reported now
    roles = Roles.of(draft, y_names, [signal for _, signal in speeds.values()])
    train = load_trajectories(data, roles, spec).by_role("train")
    check_excitation(train, inputs=roles.inputs, outputs=roles.outputs)
    x0, u0, w0 = _first_rest(draft, np.array(gains), np.array(offsets))
    still = [*(near(v, float(np.ptp(c.span)) / 1e4) for v, c in zip(x0, draft.outputs, strict=True))]
    point = f"x={_tuple([*still, *['0.0'] * (len(states) - len(still))])}, u={_tuple(map(repr, u0))}"
    point += f", w={_tuple(map(repr, w0))}" if w_names else ""
    title = printable(path.stem)
    lines = [
        _text(
            f"{title}: written from {printable(_and(file.name for file in data))} by hybrid-mpc new. "
            f"Lines marked {MARK} are for you to decide."
        ),
        "",
        *(["from casadi import cos, sin", ""] if any(c.periodic for c in draft.disturbances) else []),
        "from hybrid_mpc import OCP, DataSpec, OperatingPoint, Parameter, Prior, Scenario, Signal",
        "",
        "",
        f"class {kind}(Prior):",
        '    """A first prior: each output is a lag, or an integral, of all inputs and disturbances."""',
        "",
        f"    # {MARK}: write the machine's own equations in xdot; states need not be measured",
        "    states = (",
        *(f"        {text},  # {note}" for text, note in states),
        "    )",
        "    inputs = (",
        *(
            f"        {text},  # {note}"
            for text, note in (_signal(c, n, acts=True) for c, n in zip(draft.inputs, u_names, strict=True))
        ),
        "    )",
        f"    outputs = states[:{len(y_names)}]",
        *(["    disturbances = ("] if w_names else []),
        *(
            f"        {text},  # {note}"
            for text, note in (_signal(c, n) for c, n in zip(draft.disturbances, w_names, strict=True))
        ),
        *(["    )"] if w_names else []),
        "    parameters = (  # name, value, unit, bounds of the fit",
        *(
            f"        Parameter({_text(n)}, {v!r}, {_text(unit)}, {low!r}, {high!r}, {_text(text)}),"
            for n, v, unit, low, high, text in parameters
        ),
        "    )",
        f"    corrects = {_tuple(map(_text, corrected))}",
        f"    # {MARK}: give the operating point; your own equations have another steady state (see check)",
        f"    # operating_point = OperatingPoint({point})",
        f"    # {MARK}: write balances(self, x, u, w, p) if the machine stores energy, mass or heat",
        "",
        "    def xdot(self, x, u, w, p):",
        *(f"        {text}" for text in steady),
        "        return (",
        *(f"            {text},  # {note}" for text, note in rates),
        "        )",
        "",
        "",
        "scenario = Scenario(",
        f"    {_text(ascii_of(path.stem) or 'machine')},",
        f"    {_text(title)},  # {MARK}: give a title",
        f'    "",  # {MARK}: describe the machine in a few words for the report',
        f"    prior={kind},",
        "    data=DataSpec(",
        f"        {_text(spec.time) if isinstance(spec.time, str) else repr(spec.time)},"
        + (f"  # {MARK}: {printable(draft.doubt)}" if draft.doubt else ""),
        f"        {_tuple(map(_text, spec.inputs))},  # {MARK}: check that these are commanded",
        f"        {_tuple(map(_text, spec.outputs))},  # {MARK}: check that these are outputs. {ACTING}",
        *(
            f"        # {MARK}: check that {printable(name)} is {KINDS[draft.verdicts[name].kind]}: {printable(reason)}"
            for name, reason in draft.unsure.items()
            if draft.verdicts[name].kind in KINDS and draft.verdicts[name].kind != "set-point"
        ),
        *(
            f"        # {MARK}: not used: {printable(c.full)}, a set-point ({printable(draft.verdicts[c.full].reason)})"
            for c in draft.set_points
        ),
        *(
            f"        # {MARK}: not used: {printable(name)} ({printable(reason)})"
            for name, reason in draft.left_out.items()
        ),
        *(f"        # {MARK}: {line}" for line in loop_lines(draft)),
        f"        dt={spec.dt!r},  # s, the sampling period; a tenth of the fastest time constant is enough",
        f"        max_gap={spec.max_gap!r},",
        f"        smoothing={spec.smoothing!r},",
        f"        warm_up={spec.warm_up!r},  # s of the past that determine the initial state of a free run",
        *([f"        disturbances={_tuple(map(_text, spec.disturbances))},"] if w_names else []),
        *(
            [f"        units={{{', '.join(f'{_text(n)}: {f!r}' for n, f in spec.units.items())}}},"]
            if spec.units
            else []
        ),
        "    ),",
        *_first_control(draft, len(states)),
        ")",
        "",
    ]
    return "\n".join(line.rstrip() for line in lines)


def _first_rest(draft: Draft, gains: Array, offsets: Array) -> tuple[list[float], list[float], list[float]]:
    """Outputs, inputs and disturbances at a steady state of the lags, as close as possible to the recorded medians."""
    n_u, w0 = len(draft.inputs), [_middle(c) for c in draft.disturbances]
    y, u0 = (np.array([np.nanmedian(c.values) for c in cs]) for cs in (draft.outputs, draft.inputs))
    at_w0 = [
        float(part.values[0])
        for value, c in zip(w0, draft.disturbances, strict=True)
        for part in replace(c, values=np.array([value])).parts
    ]
    drives = np.concatenate([u0, at_w0])
    moves = np.array([lag.integrates(draft.length) for lag in draft.lags])  # steady where the rate is zero
    missing = np.where(moves, 0.0, y) - offsets - gains @ drives
    sizes = np.array([np.ptp(c.span) for c in (*draft.outputs, *draft.effects)])
    per_y, per_u = sizes[: len(y)], sizes[len(y) : len(y) + n_u]
    per_y = np.where(moves, np.abs(gains[:, :n_u]) @ per_u, per_y)
    # scaled by the recorded spans: independent of units
    drives[:n_u] += per_u * (np.linalg.pinv(gains[:, :n_u] * per_u / per_y[:, None]) @ (missing / per_y))
    held = [_within(v, c) for v, c in zip(drives, draft.inputs, strict=False)]
    y = np.where(moves, [_middle(c) for c in draft.outputs], offsets + gains @ np.array([*held, *at_w0]))
    return y.tolist(), held, w0


def _within(value: float, column: Column) -> float:
    low, high = column.span
    return float(near(min(max(value, low), high), (high - low) / 500))


def _middle(column: Column) -> float:
    """Median of a column, within the first turn of an angle that was unwrapped."""
    middle = float(np.nanmedian(column.values))
    return round(middle % column.signal.period, 6) if column.periodic else _within(middle, column)


def horizon_of(draft: Draft) -> tuple[int, str]:
    """A first horizon in periods, and the reason: twice the slowest time constant that matters, within ``HORIZONS``."""
    pace, i = slowest(draft.lags, draft.length)
    asked = max(round(2 * pace / draft.period), 1)
    periods = min(max(asked, HORIZONS[0]), HORIZONS[1])
    why = (
        f"{periods} periods of {draft.period:.3g} s; the slowest significant time constant is {pace:.3g} s, that of "
        f"{printable(draft.outputs[i].full)}"
    )
    if asked > periods:
        why += f". Twice this time is {asked} periods: use a longer dt"
    return periods, why


def first_limits(span: tuple[float, float], growth: float) -> tuple[float, float]:
    """Limits of an input in a first control problem: the recorded range.

    An unstable machine diverges if its input stays at a limit. If the recorded input has both signs, its limits are
    made symmetric: a recording from one initial state may hold mostly one sign.

    Args:
        span: Smallest and largest recorded value.
        growth: Rate [1/s] at which the machine diverges from its steady state; 0 if it does not.

    Example:
        >>> first_limits((-4.8, 14.0), 5.0), first_limits((-4.8, 14.0), 0.0), first_limits((0.0, 14.0), 5.0)
        ((-14.0, 14.0), (-4.8, 14.0), (0.0, 14.0))
    """
    low, high = span
    if growth > 0 and low < 0 < high:
        return -max(-low, high), max(-low, high)
    return low, high


def _first_control(draft: Draft, n_x: int) -> list[str]:
    """A control problem for a first loop, commented out; the user's decisions are marked.

    Weights follow Bryson's rule, ``1 / (tolerated deviation)^2``: a twentieth of the recorded span for outputs, a tenth
    for changes of inputs. For the limits of inputs see :func:`first_limits`.
    """
    horizon, why = horizon_of(draft)

    def each(columns: Sequence[Column], share: float) -> str:
        return _tuple(_rounded(share * float(np.ptp(c.span))) + "**-2" for c in columns)

    limits = [(first_limits(c.span, draft.growth), np.ptp(c.span) / 500) for c in draft.inputs]
    low, high = (_tuple(near(ends[i], step) for ends, step in limits) for i in (0, 1))
    free = f"q={_tuple(['0.0'] * n_x)}, r={_tuple(['0.0'] * len(draft.inputs))}"
    sigmas = draft.sensor_sigma
    sigma = _tuple(_rounded(value, 2) for value, _ in sigmas)
    guessed = [printable(c.full) for c, (_, known) in zip(draft.outputs, sigmas, strict=True) if not known]
    origin = "" if len(guessed) == len(sigmas) else ", estimated from the recordings"
    return [
        f"    # {MARK}: define the control problem. For a first loop, remove the # from these lines:",
        f"    # control=OCP({horizon}, {free}, u_min={low}, u_max={high},",
        f"    #             # {why}",
        "    #             # weights: 1 / (tolerated deviation)**2",
        f"    #             r_delta={each(draft.inputs, 0.1)}, q_y={each(draft.outputs, 0.05)}),",
        f"    # sensor_sigma={sigma},  # standard deviation of each sensor's error{origin}",
        *(
            [
                f"    # {MARK}: sensor_sigma of {', '.join(guessed)} is assumed: take it from the data sheet, or "
                "record at rest"
            ]
            if guessed
            else []
        ),
        "    # safe_input=(...),  # an input within these limits that is safe when a sensor fails",
    ]


def loop_lines(draft: Draft) -> list[str]:
    """Lines about a closed loop and an unstable machine; empty without either."""
    lines = []
    if draft.loop:
        lines.append(
            f"the recordings seem to come from a closed loop ({draft.loop}). Free runs are biased in a closed loop, so "
            "the prior is also fitted to predictions"
        )
    if draft.growth:
        lines.append(
            f"the machine seems to be unstable: deviations grow by a factor of e in {1 / draft.growth:.3g} s. The lags "
            "written here are stable: write the machine's equation before you build a controller"
        )
    return lines


def _and(names: Iterable[str]) -> str:
    """A list of names; of more than three, the first and the count of the others."""
    given = list(names)
    return ", ".join(given) if len(given) <= 3 else f"{given[0]} and {len(given) - 1} more"


def _tuple(written: Iterable[str]) -> str:
    """A tuple as source text, from the source texts of its items."""
    given = list(written)
    return f"({', '.join(given)},)" if len(given) == 1 else f"({', '.join(given)})"
